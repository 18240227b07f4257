"""Cuts recordings into windows on the 0..1 scale, and splits them by recording (Section VI-C)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics import SensorLayout
from diagnostics.preprocessing.array_likes import plain_array
from diagnostics.preprocessing.copies import find_copies
from diagnostics.preprocessing.readings import held
from diagnostics.shown import shown

CONVERTER_STEP = 1 / 4095
"""Step of a 12-bit converter, as the paper's ESP32 has, on the scale of windows."""


@shown
@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of T frames, the input of every model.

    Attributes:
        x: float32 ``[N, T, D]``, readings divided by the layout's full scale: 0..1.
        y: int64 ``[N]``, class of each window, -1 where there is no label; or float32 ``[N, k]``,
            the target values of a regression; or float32 ``[N, H, A]``, or of any other shape, the
            actions of a policy.
        recording: int64 ``[N]``, which recording or episode a window came from; splits keep these
            together.
        extra: what a policy sees beside touch, by name: ``[N, ...]`` each, as joint positions. No
            repair changes it.

    Raises:
        ValueError: ``x`` is not three-dimensional, or ``y``, ``recording`` or another input has
            another length.
    """

    x: NDArray[np.float32]
    y: NDArray[Any]
    recording: NDArray[np.int64]
    extra: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        x = plain_array(self.x).astype(np.float32, copy=False)
        if x.ndim != 3:
            raise ValueError(f"windows need x of shape [N, T, D], got {list(x.shape)}")
        object.__setattr__(self, "x", x)
        for name in ("y", "recording"):
            values = np.asarray(getattr(self, name))
            if name == "y" and values.ndim >= 2 and len(values) == len(x):
                object.__setattr__(self, name, values.astype(np.float32, copy=False))
                continue
            if values.shape != (len(x),):
                raise ValueError(
                    f"{len(x)} windows need {name} of shape [{len(x)}], got {list(values.shape)}"
                )
            object.__setattr__(self, name, values.astype(np.int64, copy=False))
        extra = {name: np.asarray(values) for name, values in self.extra.items()}
        for name, values in extra.items():
            if values.ndim < 1 or len(values) != len(x):
                raise ValueError(
                    f"{len(x)} windows need the input {name!r} of shape [{len(x)}, ...], got"
                    f" {list(values.shape)}"
                )
        object.__setattr__(self, "extra", extra)

    def __len__(self) -> int:
        return len(self.x)

    @cached_property
    def sources(self) -> NDArray[np.int64]:
        """The recording that a window is an observation of, int64 ``[N]``: its own, or the one that
        its recording is a copy of (:mod:`diagnostics.preprocessing.copies`)."""
        numbers, inverse = np.unique(self.recording, return_inverse=True)
        frames = [self.x[inverse == i].reshape(-1, self.x.shape[2]) for i in range(len(numbers))]
        return np.asarray(numbers[find_copies(frames)][inverse], np.int64)

    @property
    def independent(self) -> Windows:
        """The windows without those of copies of a recording; the longest is kept."""
        original = self.recording == self.sources
        return self if original.all() else self.select(original)

    def __str__(self) -> str:
        n, t, d = self.x.shape
        told = f"{len(np.unique(self.y[self.y >= 0]))} classes"
        if self.y.ndim == 2:
            told = "1 value" if self.y.shape[1] == 1 else f"{self.y.shape[1]} values"
        elif self.y.ndim > 2:
            told = f"actions {list(self.y.shape[1:])}"
        recordings = len(np.unique(self.recording))
        return f"{n} windows of {t} frames x {d} cells, {recordings} recordings, {told}"

    def select(self, which: NDArray[Any] | Sequence[int] | slice) -> Windows:
        """Return the windows of a bool mask ``[N]``, of indices in their order, or of a slice."""
        if not isinstance(which, slice):
            which = np.asarray(which)
            which = which if which.dtype == bool else which.astype(np.intp)
        extra = {name: values[which] for name, values in self.extra.items()}
        return Windows(self.x[which], self.y[which], self.recording[which], extra)

    @property
    def flat(self) -> Windows:
        """The windows with the actions ``[N, ...]`` of a policy as values ``[N, k]``."""
        return self if self.y.ndim <= 2 else replace(self, y=self.y.reshape(len(self), -1))


def evenly(n: int, most: int) -> NDArray[np.intp]:
    """Return at most ``most`` of the indices 0 to n - 1, the first and the last among them where
    there are two."""
    return np.linspace(0, n - 1, min(n, most)).astype(np.intp)


def scale(frames: ArrayLike, layout: SensorLayout) -> NDArray[np.float32]:
    """Convert readings from the layout's unit to 0..1. No other function does.

    Divides by the full scale (5 N in Section VI-C). Nothing is clipped, and NaN stays NaN.
    """
    return (np.asarray(frames, dtype=np.float64) / layout.full_scale).astype(np.float32)


def hold_missing(frames: NDArray[Any]) -> NDArray[Any]:
    """Return ``frames [T, D]`` with each NaN replaced by the last reading of that cell, 0 before
    its first.

    A single NaN would turn the whole output of the network into NaN.
    """
    return (
        held(frames, np.zeros(frames.shape[1], frames.dtype))[1:]
        if np.isnan(frames).any()
        else frames
    )


def finite_windows(x: NDArray[Any]) -> NDArray[np.float32]:
    """Return windows ``[N, T, D]`` on the 0..1 scale without missing or invalid readings."""
    x = plain_array(x).astype(np.float32, copy=False)
    if x.ndim != 3 or not x.size or bool(((x >= -1) & (x <= 2)).all()):  # NaN compares as False
        return x
    missing = ~((x >= -1) & (x <= 2))  # as for a layout of full scale 1
    held: NDArray[np.float32] = np.stack(
        [hold_missing(window) for window in np.where(missing, np.float32(np.nan), x)]
    )
    return held


def make_windows(
    recordings: Sequence[ArrayLike],
    targets: ArrayLike | Sequence[ArrayLike] | None,
    layout: SensorLayout,
    *,
    length: int = 10,
    stride: int | None = None,
    extra: Mapping[str, Sequence[ArrayLike]] = MappingProxyType({}),
) -> Windows:
    """Cut recordings into windows on the 0..1 scale.

    Missing readings (NaN) are held from the last frame of their recording (:func:`hold_missing`).
    Frames after the last whole window are dropped; a recording shorter than one window gives none.

    Args:
        recordings: in the layout's unit, as :meth:`SensorLayout.recordings` takes them; lengths may
            differ.
        targets: of a classification, int ``[n]``, one class a recording; None gives y = -1. Of a
            regression, float ``[n, k]``, values of each recording, or a list of float ``[T, k]``,
            values of each frame (``[T]``, as long as its recording: one value). Of a policy, a list
            of float ``[T, H, A]``, the chunk of actions that begins at each frame. A window has
            those of its last frame, which is the present when a robot has read the window.
        layout: the array they come from.
        length: frames in a window, 10 in Section VI-C.
        stride: frames between the starts of two windows; None means ``length``, windows that do not
            overlap.
        extra: what a policy sees beside touch, by name: for each recording an array ``[T, ...]``. A
            window has the frames of its readings, ``[N, length, ...]``.

    Raises:
        ValueError: a recording that does not fit the layout, another number of targets, a value
            that is not finite, no window at all; another input of another number of frames.
    """
    recordings = layout.recordings(recordings)
    stride = length if stride is None else stride
    if length < 1 or stride < 1:
        raise ValueError(f"windows need length >= 1 and stride >= 1, got {length} and {stride}")
    checked = [
        layout.check_recording(recording, f"recording {i}")
        for i, recording in enumerate(recordings)
    ]
    lengths = [len(recording) for recording in checked]
    of_frames = _targets_of_frames(targets, lengths)
    others = {name: _as_long(name, inputs, lengths) for name, inputs in extra.items()}
    longest = max(lengths, default=0)
    if longest < length:
        raise ValueError(
            f"no windows: a window needs {length} frames, the longest of {len(recordings)}"
            f" recordings has {longest}"
        )
    x = _cut([hold_missing(scale(recording, layout)) for recording in checked], length, stride)
    y = np.concatenate([of[length - 1 :: stride] for of in of_frames])
    counts = [len(range(length, frames + 1, stride)) for frames in lengths]
    cut = {name: _cut(inputs, length, stride) for name, inputs in others.items()}
    return Windows(np.ascontiguousarray(x), y, np.repeat(np.arange(len(recordings)), counts), cut)


def _cut(each: Sequence[NDArray[Any]], length: int, stride: int) -> NDArray[Any]:
    """Return the windows ``[n, length, ...]`` of the frames ``[T, ...]`` of each recording."""
    long = [frames for frames in each if len(frames) >= length]
    views = [np.lib.stride_tricks.sliding_window_view(frames, length, axis=0) for frames in long]
    return np.concatenate([np.moveaxis(view[::stride], -1, 1) for view in views])


def _as_long(name: str, inputs: Sequence[ArrayLike], lengths: Sequence[int]) -> list[NDArray[Any]]:
    """Return an input of each recording, ``[T, ...]``; refuse one of another number of frames."""
    each = [np.asarray(of) for of in inputs]
    if [len(of) for of in each] != list(lengths):
        raise ValueError(
            f"the input {name!r} has {[len(of) for of in each][:5]} frames, the recordings"
            f" {list(lengths)[:5]}: give an array [T, ...] for each recording"
        )
    return each


def _targets_of_frames(
    targets: ArrayLike | Sequence[ArrayLike] | None, lengths: Sequence[int]
) -> list[NDArray[Any]]:
    """Return for each recording the class of its frames, int ``[T]``, or their values, float32
    ``[T, k]``."""
    given = [-1] * len(lengths) if targets is None else list(cast(Iterable[ArrayLike], targets))
    if len(given) != len(lengths):
        raise ValueError(f"{len(lengths)} recordings need as many targets, got {len(given)}")
    each = [np.asarray(of) for of in given]
    kinds = {of.dtype.kind for of in each}
    if kinds <= set("iub") and all(of.ndim == 0 for of in each):
        return [np.full(frames, int(of)) for frames, of in zip(lengths, each, strict=True)]
    if not kinds <= set("iubf"):
        raise ValueError("targets are whole numbers (classes) or floats (values), nothing else")
    each = [np.atleast_1d(of).astype(np.float32) for of in each]
    for i, of in enumerate(each):
        if not np.isfinite(of).all():
            raise ValueError(f"the targets of recording {i} are not all finite")
    if all(of.ndim > 2 for of in each):
        return _chunks_of_frames(each, lengths)
    if all(of.shape == (frames,) for of, frames in zip(each, lengths, strict=True)):
        each = [of[:, None] for of in each]
    widths = {of.shape[-1] for of in each}
    if len(widths) > 1:
        raise ValueError(
            f"every recording needs as many values, got {sorted(widths)}; values of each frame are"
            " [T, k]"
        )
    (k,) = widths
    for i, (of, frames) in enumerate(zip(each, lengths, strict=True)):
        if of.shape not in ((k,), (frames, k)):
            raise ValueError(
                f"recording {i} has {frames} frames: expected targets [{k}] or [{frames}, {k}], got"
                f" {list(of.shape)}"
            )
    return [np.broadcast_to(of, (frames, k)) for of, frames in zip(each, lengths, strict=True)]


def _chunks_of_frames(
    each: Sequence[NDArray[np.float32]], lengths: Sequence[int]
) -> list[NDArray[np.float32]]:
    """Return the chunks of actions of the frames of each recording, ``[T, H, A]``."""
    for i, (of, frames) in enumerate(zip(each, lengths, strict=True)):
        if of.shape != (frames, *each[0].shape[1:]):
            raise ValueError(
                f"recording {i} has {frames} frames: expected actions"
                f" {[frames, *each[0].shape[1:]]}, got {list(of.shape)}"
            )
    return list(each)


def recordings_of(windows: Windows, layout: SensorLayout) -> list[NDArray[np.float64]]:
    """Return the frames of the windows of each recording, one after the other, ``[T, D]`` in the
    layout's unit."""
    return [
        windows.x[windows.recording == number].reshape(-1, layout.n_cells)
        * float(layout.full_scale)
        for number in np.unique(windows.recording)
    ]


def split(
    windows: Windows, *, test: float = 0.2, validation: float = 0.2, seed: int = 0
) -> tuple[Windows, Windows, Windows]:
    """Return ``(train, validation, test)``, split by recording and stratified by class; those of a
    regression by recording alone. Copies of a recording lie on its side.

    ``validation`` is a share of the recordings outside the test set, so the defaults give 64 %, 16
    % and 20 % (Section VI-C). Every class has a recording on each side, which plain stratification
    does not guarantee for small classes; a share of 0 leaves that side empty.

    Raises:
        ValueError: a share outside [0, 1), a class with too few recordings, a recording with two
            labels.
    """
    for name, share in (("test", test), ("validation", validation)):
        if not 0 <= share < 1:
            raise ValueError(f"the {name} share must lie in [0, 1), got {share}")
    of_class = windows.y if windows.y.ndim == 1 else np.zeros(len(windows), np.int64)
    _, first, own = np.unique(windows.recording, return_index=True, return_inverse=True)
    if (mixed := of_class[first][own] != of_class).any():
        raise ValueError(
            f"recording {windows.recording[mixed][0]} has windows of two classes: give each its own"
            " number"
        )
    recordings, first, inverse = np.unique(windows.sources, return_index=True, return_inverse=True)
    classes = of_class[first]  # of each recording
    sides = 1 + (test > 0) + (validation > 0)
    for label, count in zip(*np.unique(classes, return_counts=True), strict=True):
        if count < sides:
            found = f"class {label} has {count} recordings"
            if windows.y.ndim == 2:
                found = f"there are {count} recordings"
            if len(recordings) < len(np.unique(windows.recording)):
                found += " (copies count once)"
            raise ValueError(f"{found}: a split into {sides} parts needs at least {sides}")
    rng = np.random.default_rng(seed)
    rest = np.arange(len(recordings))
    chosen = _draw(rest, classes, test, 1 + (validation > 0), rng)
    rest = np.setdiff1d(rest, chosen)
    held_out = _draw(rest, classes, validation, 1, rng)
    side = np.zeros(len(recordings), dtype=np.int64)
    side[held_out] = 1
    side[chosen] = 2
    side = side[inverse]
    return windows.select(side == 0), windows.select(side == 1), windows.select(side == 2)


def _draw(
    candidates: NDArray[np.intp],
    classes: NDArray[np.int64],
    share: float,
    leave: int,
    rng: np.random.Generator,
) -> NDArray[np.intp]:
    """Draw ``share`` of the candidates: of each class at least one, and at least ``leave`` left
    over."""
    if share == 0:
        return candidates[:0]
    _, of, counts = np.unique(classes[candidates], return_inverse=True, return_counts=True)
    take = np.clip(np.floor(share * counts), 1, counts - leave).astype(int)
    # Largest remainders first: the total then matches the share although recordings are
    # indivisible.
    for i in np.argsort(take - share * counts, kind="stable"):
        if take.sum() < round(share * len(candidates)) and take[i] < counts[i] - leave:
            take[i] += 1
    return np.concatenate([rng.permutation(candidates[of == i])[:n] for i, n in enumerate(take)])
