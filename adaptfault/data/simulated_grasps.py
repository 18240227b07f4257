"""Simulated grasps of the paper's task: a soft block squeezed between opposing tactile pads
(Section VI-B).

Smooth contact makes every imputation of dead cells look perfect. Contact is therefore thresholded
here, objects have edges, and surfaces are rough, so that the statistics match those of real arrays
(``examples/simulated_vs_real.py``).

Lengths are in cell pitches; closing and heights in units of the nominal closing; loads in newtons,
5 of which are the full scale. A cell sits at s = (row, column) from the centre of its pad; odd pads
face even ones, so their columns are mirrored. The block's frame is b = R(angle) (s - offset), the
same for all pads but for a small misalignment. d(b) is the signed distance to the outline of the
block, negative inside.

1. Surface: h(b) = bow + texture - EDGE_DROP max(0, 1 + d / EDGE)**2 - dents. The texture is a sum
   of 40 plane waves, 3.2 to 7 pitches long, drawn for each face of each block. Edges are rounded:
   contact spreads as the pads close.
2. Elastic foundation (Winkler): e(s, t) = max(0, closing(t) + tilt(t) . s + h). The block shifts
   between the pads until both sides carry the same force. Stiffness k(b) = that of the object * the
   concentration of stress along the edge * (1 + A exp(-|b - c|**2 / 2 r**2)); A > 0 is a stiff
   inclusion, -1 < A < 0 a void. The nearer face is affected more.
3. Relaxation, the standard linear solid: p = k ((1 - g) e + g z), dz/dt = de/dt - z / tau, p >= 0.
4. Cover: the elastic skin of the pad blurs p over neighbouring cells (Gaussian).
5. Hysteresis of the resistive layer, the play operator in relative load:
   y(t) = min(max(y(t-1), (1 - w) p(t)), (1 + w) p(t)).
6. Readout: gain y + offset + noise of standard deviation sqrt(floor**2 + (c gain y)**2). Under the
   threshold a cell reads exactly 0, the rest is rounded to converter steps. Gain and offset belong
   to the sensor, not to the recording.

Nominal motion: the robot records while it grasps, so a recording starts at contact, at half the
closing. It closes within a tenth of the recording and holds, with tremor and at most one small
slip; a third of the grasps end in a partial release. Motion is stretched over the recording,
whatever its length; relaxation and tremor run in seconds.

Not modelled: cells coupled through the block (only the cover does that), shear, the stiffness
moving along in a slip, temperature drift, crosstalk of the wiring, wear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from adaptfault.data.recordings import Recordings
from diagnostics import SensorLayout

__all__ = ["CLASS_NAMES", "Readout", "hysteresis", "relaxing_pressure", "simulate"]

CLASS_NAMES = ("nothing", "normal", "foreign matter", "void", "deformation", "softer", "harder")

LOAD = 0.62  # newtons a cell carries under the nominal closing of a normal block, before relaxation
STIFFNESS = {"softer": 0.58, "harder": 1.65}  # relative to normal
# seconds; 3.0 where not named: soft curd flows sooner
RELAXATION_TIME = {
    "softer": 1.6,
    "harder": 5.0,
}
GLASSY = 0.35  # g: share of the force that relaxes
INCLUSION = {"foreign matter": 1.7, "void": -0.8}  # A
# width in pitches of the paper's pad; drop at the outline
EDGE = 1.2
EDGE_DROP = 0.55
COVER = 0.48  # standard deviation of the cover's blur, in pitches
PLAY = 0.05  # w of the hysteresis
CONVERTER_STEPS = 4095  # 12 bit
BATCH_READINGS = 5_000_000  # readings simulated at once: about 200 MB with what is in between

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class Readout:
    """The electrical side of one sensor: the same for all its recordings.

    Attributes:
        layout: the array.
        gain: float32 ``[pads, rows, cols]``, sensitivity left after calibration, spread 15 %.
        offset: float32 ``[pads, rows, cols]``, in newtons, far below the threshold.
    """

    layout: SensorLayout
    gain: Array
    offset: Array

    noise_floor = 0.003  # newtons; the unloaded cells of a real hand have 0.0004 of full scale
    noise_share = 0.01  # c: noise for each newton of load
    threshold = 0.06  # newtons

    @classmethod
    def draw(cls, layout: SensorLayout, seed: int = 0) -> Readout:
        """Return the sensor of a ``seed``."""
        # no class has this number: an independent random stream
        rng = np.random.default_rng([seed, len(CLASS_NAMES)])
        gain = np.exp(rng.normal(0, 0.15, layout.shape)).clip(0.65, 1.5)
        return cls(
            layout,
            gain.astype(np.float32),
            rng.uniform(-0.015, 0.015, layout.shape).astype(np.float32),
        )

    def read(self, load: Array, rng: np.random.Generator) -> Array:
        """Return the converter's readings for loads ``[..., pads, rows, cols]`` in newtons, in the
        layout's unit.

        Newtons stand for fifths of the full scale. Absent positions read 0.
        """
        value = load * self.gain
        noise = rng.standard_normal(value.shape, dtype=np.float32)
        noise *= np.sqrt(
            np.float32(self.noise_floor**2) + (np.float32(self.noise_share) * value) ** 2
        )
        value += noise
        value += self.offset
        value[(value < self.threshold) | ~self.layout.present] = 0
        value *= CONVERTER_STEPS / 5
        np.rint(value, out=value).clip(0, CONVERTER_STEPS, out=value)
        return value * np.float32(self.layout.full_scale / CONVERTER_STEPS)


def relaxing_pressure(compression: Array, stiffness: Array, tau: Array, rate: float) -> Array:
    """Return the pressure of a standard linear solid, started from rest and free of force.

    Args:
        compression: ``[T, ...]``, at least 0.
        stiffness: instantaneous stiffness, broadcast against one frame or the whole of
            ``compression``.
        tau: relaxation time in seconds, broadcast against one frame.
        rate: frames per second.

    Returns:
        float32 like ``compression``; a contact that retracts faster than the solid recovers is
        lost, never pulls.
    """
    decay = np.exp(-1 / (rate * tau)).astype(np.float32)
    glassy = np.zeros_like(compression[0])
    before = np.zeros_like(compression[0])
    pressure = np.empty_like(compression)
    for t, now in enumerate(compression):
        glassy = decay * glassy + (now - before)
        np.maximum((1 - GLASSY) * now + GLASSY * glassy, 0, out=pressure[t])
        before = now
    pressure *= compression > 0
    pressure *= stiffness.astype(pressure.dtype)
    return pressure


def hysteresis(load: Array, width: float = PLAY) -> Array:
    """Return the output of a resistive layer under ``load`` ``[T, ...]``: it lags by the share
    ``width``."""
    shown = np.empty_like(load)
    last = np.zeros_like(load[0])
    for t, now in enumerate(load):
        last = np.clip(last, (1 - width) * now, (1 + width) * now, out=shown[t])
    return shown


def simulate(
    n_per_class: int = 200,
    layout: SensorLayout | None = None,
    *,
    n_frames: int = 100,
    seed: int = 0,
    classes: Sequence[str] = CLASS_NAMES,
    sensor_seed: int = 0,
) -> Recordings:
    """Return simulated grasps, class by class.

    Args:
        n_per_class: recordings of each class, at least 1.
        layout: the array; None is the paper's, 2 x 11 x 10 cells, 0..5 N, 10 Hz. The block scales
            with the pads.
        n_frames: frames of a recording, at least 1.
        seed: draws the objects, their grasps and the noise; the same seed gives the same
            recordings, and a class does not change when others are left out.
        classes: which of :data:`CLASS_NAMES`, in the order of the labels.
        sensor_seed: draws the gain and offset of each cell. Keep it to record more grasps with the
            same sensor.

    Returns:
        ``n_per_class * len(classes)`` recordings float32 ``[n_frames, D]`` in the layout's unit,
        named "void/0003".

    Raises:
        ValueError: a number below its least, a class unknown or named twice, none at all, a layout
            with several axes.
    """
    _check(classes, n_per_class=n_per_class, n_frames=n_frames, seed=seed, sensor_seed=sensor_seed)
    layout = SensorLayout.paper() if layout is None else layout
    if layout.axes > 1:
        raise ValueError(
            f"simulate presses on cells of one axis; got a layout with {layout.axes} axes"
        )
    readout = Readout.draw(layout, sensor_seed)
    batch = max(1, BATCH_READINGS // (n_frames * layout.n_cells))
    frames: list[Array] = []
    for name in classes:
        rng = np.random.default_rng([seed, CLASS_NAMES.index(name)])
        for start in range(0, n_per_class, batch):
            # (T, n, pads, rows, cols)
            load = _grasp(rng, name, min(batch, n_per_class - start), layout, n_frames)
            read = readout.read(hysteresis(load), rng)
            frames.extend(
                np.ascontiguousarray(read.swapaxes(0, 1)).reshape(-1, n_frames, layout.n_cells)
            )
    names = tuple(f"{name}/{i:04d}" for name in classes for i in range(n_per_class))
    labels = np.repeat(np.arange(len(classes)), n_per_class)
    return Recordings(tuple(frames), layout, labels, tuple(classes), names)


def _check(classes: Sequence[str], **numbers: int) -> None:
    """Raise ValueError where :func:`simulate` cannot take classes, or a number."""
    for name, number in numbers.items():
        least = 1 if name.startswith("n_") else 0
        if not isinstance(number, int | np.integer) or isinstance(number, bool) or number < least:
            raise ValueError(f"simulate needs {name} >= {least}, a whole number; got {number!r}")
    named = [] if isinstance(classes, str) else list(classes)
    if not named or len(set(named)) < len(named) or set(named) - set(CLASS_NAMES):
        raise ValueError(
            f"classes must name some of {', '.join(CLASS_NAMES)}, each once; got {classes!r}"
        )


def _grasp(
    rng: np.random.Generator, name: str, n: int, layout: SensorLayout, n_frames: int
) -> Array:
    """Return the loads ``[T, n, pads, rows, cols]`` in newtons that ``n`` grasps put on the
    cells."""
    if name == "nothing":
        return np.zeros((n_frames, n, *layout.shape), np.float32)
    compression, slipped = _motion(rng, n, layout, n_frames)
    stiffness, before, after = _faces(rng, name, n, layout)
    before = before + _balance(before, stiffness)
    after = after + _balance(after, stiffness)
    compression += before.astype(np.float32)
    compression += slipped * (after - before).astype(np.float32)
    np.maximum(compression, 0, out=compression)
    spread = np.exp(rng.normal(0, 0.05, (2, n, 1, 1, 1)))  # no two blocks of a class are the same
    stiffness = stiffness * (LOAD * STIFFNESS.get(name, 1.0) * spread[0])
    pressure = relaxing_pressure(
        compression, stiffness, RELAXATION_TIME.get(name, 3.0) * spread[1], layout.rate
    )
    return np.asarray(_cover(layout.rows) @ pressure @ _cover(layout.cols))


def _motion(
    rng: np.random.Generator, n: int, layout: SensorLayout, n_frames: int
) -> tuple[Array, Array]:
    """Return how deep the pads reach ``[T, n, pads, rows, cols]``, and the share of the slip
    ``[T, n, 1, 1, 1]``."""
    f = np.linspace(0, 1, n_frames)[:, None, None, None, None]  # share of the recording
    one = (n, 1, 1, 1)
    start = rng.uniform(0.42, 0.55, one)
    ramp = rng.uniform(0.05, 0.09, one)
    closing = start + (1 - start) * np.minimum(1, (f + 0.01) / ramp)
    released = np.where(rng.random(one) < 0.3, rng.uniform(0.08, 0.25, one), 0)
    closing *= 1 - released * ((f - rng.uniform(0.75, 0.92, one)) / 0.05).clip(0, 1)
    closing *= rng.normal(1, 0.05, one).clip(0.8, 1.2)  # another grip, a block of another thickness
    closing *= 1 + 0.008 * _tremor(rng, (n_frames, *one), layout.rate)
    # a quarter slips after the end: never
    slipped = ((f - rng.uniform(0.2, 1.3, one)) / 0.03).clip(0, 1)
    lean = rng.normal(0, 0.05, (2, 1, n, layout.pads, 1, 1)) + 0.012 * _tremor(
        rng, (2, n_frames, *one), layout.rate
    )
    row, col = _positions(layout)
    reach = lean[0].astype(np.float32) * (row * 2 / layout.rows) + lean[1].astype(np.float32) * (
        col * 2 / layout.cols
    )
    return np.add(reach, closing, dtype=np.float32, casting="same_kind"), slipped.astype(np.float32)


def _tremor(rng: np.random.Generator, shape: tuple[int, ...], rate: float) -> Array:
    """Return noise ``[..., T, n, 1, 1, 1]`` of unit variance that forgets within half a second."""
    keep = float(np.exp(-2 / rate))
    steps = rng.standard_normal(shape)
    steps[..., 1:, :, :, :, :] *= np.sqrt(1 - keep**2)
    return np.asarray(lfilter([1], [1, -keep], steps, axis=-5))


def _positions(layout: SensorLayout) -> tuple[Array, Array]:
    """Return where the block sees each cell, from the centre: row ``[1, rows, 1]`` and column
    ``[pads, 1, cols]``."""
    row = np.arange(layout.rows, dtype=np.float32) - np.float32((layout.rows - 1) / 2)
    col = np.arange(layout.cols, dtype=np.float32) - np.float32((layout.cols - 1) / 2)
    return row[None, :, None], _facing(layout.pads) * col


def _facing(pads: int) -> Array:
    """Return 1 for even and -1 for odd pads, ``[pads, 1, 1]``."""
    return np.where(np.arange(pads) % 2, -1, 1).astype(np.float32)[:, None, None]


def _faces(
    rng: np.random.Generator, name: str, n: int, layout: SensorLayout
) -> tuple[Array, Array, Array]:
    """Return relative stiffness and the heights before and after the slip,
    ``[n, pads, rows, cols]``, of new blocks."""
    # drawn once for a block, and for each face
    one = (n, 1, 1, 1)
    face = (n, layout.pads, 1, 1)
    unit = np.sqrt(layout.rows * layout.cols / 110)  # one pitch on the paper's pad
    row, col = _positions(layout)
    # the softer it is, the further it bulges between the pads
    softness = STIFFNESS.get(name, 1.0) ** -0.08
    a = 0.34 * layout.rows * rng.normal(1, 0.03, one) * softness
    b = 0.34 * layout.cols * rng.normal(1, 0.03, one) * softness
    x0 = rng.normal(0, 0.06 * layout.rows, one) + rng.normal(0, 0.15 * unit, face)
    y0 = rng.normal(0, 0.06 * layout.cols, one) + rng.normal(0, 0.15 * unit, face)
    angle = rng.normal(0, 0.12, one)
    bow = rng.normal(0.05, 0.04, face)
    many = (40, *face)
    length = rng.uniform(3.2, 7, many)
    heading = rng.uniform(0, 2 * np.pi, many)
    phase = rng.uniform(0, 2 * np.pi, many)
    texture = rng.uniform(0.10, 0.14, face) * np.sqrt(2 / len(length))
    defect_x = a * rng.uniform(-0.55, 0.55, one)
    defect_y = b * rng.uniform(-0.55, 0.55, one)
    radius = unit * rng.uniform(1.1, 1.6, one)
    strength = rng.uniform(0.9, 1.2, one)
    kind = rng.integers(0, 3, one)
    nearness = 1 + _facing(layout.pads) * rng.uniform(-0.2, 0.2, one)

    def surface(dx: Array, dy: Array, turn: Array) -> tuple[Array, Array]:
        r = row - x0 - dx
        c = col - y0 - dy
        x = np.cos(angle + turn) * r + np.sin(angle + turn) * c
        y = np.cos(angle + turn) * c - np.sin(angle + turn) * r
        height = bow * (1 - (x / a) ** 2 - (y / b) ** 2)
        for wave, h, p in zip(length, heading, phase, strict=True):
            height += texture * np.cos(2 * np.pi / wave * (np.cos(h) * x + np.sin(h) * y) + p)
        outline = _outline(np.abs(x) - a + unit, np.abs(y) - b + unit) - unit
        stiffness = np.ones_like(x)
        if name in INCLUSION:
            spot = np.exp(-((x - defect_x) ** 2 + (y - defect_y) ** 2) / (2 * radius**2))
            stiffness += (INCLUSION[name] * strength * nearness * spot).clip(-0.95)
        # a corner cut off, a groove along one axis, or a bend, hollow on one side
        if name == "deformation":
            cut = np.sign(defect_x) * x / a + np.sign(defect_y) * y / b - (1.35 - 0.5 * strength)
            outline = np.where(kind == 0, np.maximum(outline, cut * np.minimum(a, b)), outline)
            across = np.where(strength > 1.05, x - defect_x, y - defect_y)
            height -= (kind == 1) * strength * np.exp(-(across**2) / (2 * radius**2))
            side = np.sign(defect_x) * _facing(layout.pads)
            height += (kind == 2) * 0.55 * strength * side * (1 - 2 * (x / a) ** 2)
        edge = outline / (EDGE * unit)
        height -= EDGE_DROP * (edge + 1).clip(0) ** 2
        return stiffness * (1 + 0.3 * np.exp(-2 * (edge + 0.8) ** 2)), height

    still = np.zeros(one)
    stiffness, before = surface(still, still, still)
    slip = rng.normal(0, 0.3 * unit, one), rng.normal(0, 0.3 * unit, one), rng.normal(0, 0.03, one)
    return stiffness, before, surface(*slip)[1]


def _outline(x: Array, y: Array) -> Array:
    """Return how far places are outside a corner at 0, which is round; negative: inside."""
    return np.asarray(np.hypot(x.clip(0), y.clip(0)) + np.maximum(x, y).clip(None, 0))


def _balance(height: Array, stiffness: Array) -> Array:
    """Return the shift of the block, as height ``[n, pads, 1, 1]``, that loads even and odd pads
    alike when closed."""
    odd = _facing(height.shape[1]).ravel() < 0
    if not odd.any():  # one pad presses against a bare finger
        return np.zeros((1, 1, 1, 1))
    low = np.full((len(height), 1, 1, 1), -1.0)
    high = np.full((len(height), 1, 1, 1), 1.0)
    for _ in range(12):  # the difference of the forces rises with the shift: halve the interval
        shift = (low + high) / 2
        force = (stiffness * (1 + height - _facing(len(odd)) * shift).clip(0)).sum((2, 3))
        over = (force[:, odd].mean(1) > force[:, ~odd].mean(1))[:, None, None, None]
        low = np.where(over, low, shift)
        high = np.where(over, shift, high)
    return np.asarray(-_facing(len(odd)) * (low + high) / 2)


def _cover(size: int) -> Array:
    """Return the blur of the cover along one axis, ``[size, size]`` and symmetric; beyond the pad
    load is lost."""
    apart = np.subtract.outer(np.arange(size), np.arange(size))
    whole = np.exp(-(np.arange(-5, 6) ** 2) / (2 * COVER**2)).sum()
    return np.asarray(np.exp(-(apart**2) / (2 * COVER**2)) / whole, np.float32)
