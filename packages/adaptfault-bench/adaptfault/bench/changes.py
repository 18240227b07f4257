"""What is done to simulated recordings: another sensor reads them, a disturbance comes, cells
die."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings import Recordings
from diagnostics import Fault, FaultKind, FaultSet, SensorLayout, inject

Frames = NDArray[Any]
Log = list[Frames]
# of readings as a share of full scale, 0..1
Change = Callable[[Frames, np.random.Generator], Frames]

STUCK_KINDS = ("open", "short", "stuck")
# of full scale; frames
VISIBLE = 0.05
TESTABLE = 10
HELD = 300  # frames of a static hold
HUM = 0.004  # of full scale
PERIOD = 7.3  # frames of the hum


def of_each(spread: float, frames: Frames) -> Frames:
    """Return a number from 0 to ``spread`` for each cell, the same in all recordings."""
    return np.asarray(np.random.default_rng(1).uniform(0, spread, frames.shape[1]))


def read_with(noise: float = 0.0, rest: float = 0.0, steps: int = 4095) -> Change:
    """Read with noise, cells resting at 0.5 to 1.5 times ``rest``, and a converter of so many
    steps."""

    def change(frames: Frames, rng: np.random.Generator) -> Frames:
        # the same in all recordings
        offset = rest * np.random.default_rng(0).uniform(0.5, 1.5, frames.shape[1])
        read = frames * (1 - 1.5 * rest) + offset + noise * rng.standard_normal(frames.shape)
        return np.clip(np.round(read * steps) / steps, 0, 1)

    return change


def counted(share: float) -> Change:
    """Read a share of full scale in counts of 10 bits, with rests and gains of their own."""

    def change(x: Frames, rng: np.random.Generator) -> Frames:
        gained = np.minimum(x * (0.5 + of_each(1.0, x)), 1)
        return read_with(0.002, 0.1, 1023)(share * gained, rng)

    return change


def wandering(x: Frames, rng: np.random.Generator) -> Frames:
    """Let the rest of each cell lie elsewhere in each recording, up to 2 % higher."""
    return np.minimum(x + rng.uniform(0, 0.02, x.shape[1]), 1)


def hum(x: Frames, rng: np.random.Generator) -> Frames:
    """Add the same sine to all cells."""
    turns = np.arange(len(x)) / PERIOD + rng.uniform()
    return np.clip(x + HUM * np.sin(2 * np.pi * turns)[:, None], 0, 1)


def held(x: Frames, rng: np.random.Generator, full_scale: float = 1.0) -> Frames:
    """Hold the last frame of a recording, the loaded cells within +-1 converter count."""
    count = full_scale / 4095
    jitter = count * rng.integers(-1, 2, (HELD, x.shape[1])) * (x[-1] > count)
    return np.concatenate([x, np.clip(x[-1] + jitter, 0.0, full_scale)])


def remade(recordings: Recordings, change: Change) -> Recordings:
    """Return what another sensor, of full scale 1, would have recorded."""
    rng = np.random.default_rng(0)
    full_scale = recordings.layout.full_scale
    frames = tuple(
        change(np.asarray(f, dtype=np.float64) / full_scale, rng) for f in recordings.frames
    )
    return replace(recordings, frames=frames, layout=replace(recordings.layout, full_scale=1.0))


def draw_cells(
    layout: SensorLayout, share: float, rng: np.random.Generator
) -> NDArray[np.integer[Any]]:
    """Return a share of the cells, at least one."""
    present = np.flatnonzero(layout.present)
    return rng.choice(present, max(1, round(share * len(present))), replace=False)


def faults_of(
    cells: NDArray[np.integer[Any]],
    kinds: Sequence[str],
    layout: SensorLayout,
    rng: np.random.Generator,
) -> list[Fault]:
    """Return a fault of each cell, of kinds drawn at random."""
    drawn = rng.choice([FaultKind(k) for k in kinds], len(cells))
    return [
        Fault(
            kind,
            (int(cell),),
            value=rng.uniform(0.1, 0.9) * layout.full_scale if kind == "stuck" else None,
        )
        for cell, kind in zip(cells, drawn, strict=True)
    ]


def broken(
    log: Log, faults: Iterable[Fault], layout: SensorLayout, onset: float, dither: float, seed: int
) -> Iterator[Frames]:
    """Yield the recordings of a log that breaks after a share ``onset`` of its frames."""
    start = round(onset * sum(map(len, log)))
    for i, frames in enumerate(log):
        here = [
            Fault(f.kind, f.cells, line=f.line, value=f.value, onset=max(0, start)) for f in faults
        ]
        yield inject(frames, here, layout, seed=1000 * seed + i, dither=dither)
        start -= len(frames)


def parted(whole: Frames, log: Log) -> Log:
    """Return the frames ``[T, D]`` of a whole log as its recordings."""
    return np.split(whole, np.cumsum([len(frames) for frames in log])[:-1])


def differs(a: Frames, b: Frames, layout: SensorLayout) -> NDArray[np.bool_]:
    """Return where readings differ by more than 5 % of full scale."""
    return np.asarray(np.abs(np.nan_to_num(a - b)) > VISIBLE * layout.full_scale)


def fault_sets(layout: SensorLayout, seed: int) -> dict[str, FaultSet]:
    """Return sets of dead cells by name: none, 10 %, 50 %, a pad, a line."""
    rng = np.random.default_rng(100 + seed)
    present = np.flatnonzero(layout.present)
    index = np.arange(layout.n_cells).reshape(layout.shape)
    sets = {
        "none": np.array([], int),
        "10 %": rng.choice(present, max(1, round(0.1 * len(present))), replace=False),
        "50 %": rng.choice(present, len(present) // 2, replace=False),
    }
    if layout.pads > 1:
        sets["a pad"] = index[seed % layout.pads].ravel()
    if layout.rows > 1:
        sets["a line"] = index[seed % layout.pads, layout.rows // 2].ravel()
    return {
        name: FaultSet(tuple(int(c) for c in cells if layout.present.flat[c]), layout.n_cells)
        for name, cells in sets.items()
    }
