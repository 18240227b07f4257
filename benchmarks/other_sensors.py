"""The recordings of one array, remade as another sensor would have read them.

A *sensor* differs both when the reference is recorded and when the log is; a *drift* came in
between: the reference is the plain one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from adaptfault.data.recordings import Recordings

Frames = np.ndarray
# of readings as a share of full scale, 0..1
Change = Callable[[Frames, np.random.Generator], Frames]


def read_with(noise: float = 0.0, rest: float = 0.0, steps: int = 4095) -> Change:
    """Read with noise, cells resting at 0.5 to 1.5 times ``rest``, and a converter of so many
    steps."""

    def change(frames: Frames, rng: np.random.Generator) -> Frames:
        # the same in all recordings
        offset = rest * np.random.default_rng(0).uniform(0.5, 1.5, frames.shape[1])
        read = frames * (1 - 1.5 * rest) + offset + noise * rng.standard_normal(frames.shape)
        return np.clip(np.round(read * steps) / steps, 0, 1)

    return change


def of_each(spread: float, frames: Frames) -> Frames:
    # the same in all recordings
    return np.random.default_rng(1).uniform(0, spread, frames.shape[1])


def one_supply(moves: float = 0.0) -> Change:
    """Read two pads on one supply, which rest at 26 % and 5 %, with noise of 0.2 % and a converter
    of 10 bits.

    The rest of a pad falls by up to 0.6 % while the other one is loaded, and lies elsewhere in each
    recording, with a standard deviation of ``moves``.
    """

    def change(frames: Frames, rng: np.random.Generator) -> Frames:
        load = 0.45 * frames.reshape(len(frames), 2, -1)
        drawn = load.sum(axis=2)
        share = np.minimum(drawn / (np.quantile(drawn, 0.95) + 1e-3), 1)
        rest = np.array([0.26, 0.05]) + moves * rng.standard_normal(2) - 0.006 * share[:, ::-1]
        read = (load + rest[:, :, None]).reshape(frames.shape) + 0.002 * rng.standard_normal(
            frames.shape
        )
        return np.clip(np.round(read * 1023) / 1023, 0, 1)

    return change


SENSORS: dict[str, Change] = {
    "as it is": lambda x, rng: x,
    "noise 0.2 %, rest 5 %": read_with(0.002, 0.05),
    "noise 1 %, rest 10 %, 10 bits": read_with(0.01, 0.1, 1023),
    "8 bits": read_with(steps=255),
    "gains 0.5 to 1.5": lambda x, rng: np.minimum(x * (0.5 + of_each(1.0, x)), 1),
    "root of the load": lambda x, rng: np.sqrt(x),
    "every second frame": lambda x, rng: x[::2],
    "all wander, 0 to 2 %": lambda x, rng: np.minimum(x + rng.uniform(0, 0.02), 1),
    "each wanders, 0 to 2 %": lambda x, rng: np.minimum(x + rng.uniform(0, 0.02, x.shape[1]), 1),
    "supply sags": one_supply(),
    "supply sags, pads wander by 2 %": one_supply(0.02),
}
DRIFTS: dict[str, Change] = {
    "all +0.7 %": lambda x, rng: np.minimum(x + 0.007, 1),
    "all +3 %": lambda x, rng: np.minimum(x + 0.03, 1),
    "all -1.5 %": lambda x, rng: np.maximum(x - 0.015, 0),
    "each +0 to 2 %": lambda x, rng: np.minimum(x + of_each(0.02, x), 1),
    "other in each recording, 0 to 2 %": lambda x, rng: np.minimum(x + rng.uniform(0, 0.02), 1),
    "noise 0.2 %": lambda x, rng: np.clip(x + 0.002 * rng.standard_normal(x.shape), 0, 1),
    "gain 0.9": lambda x, rng: 0.9 * x,
    "gain 1.15": lambda x, rng: np.minimum(1.15 * x, 1),
}


def remade(recordings: Recordings, change: Change) -> Recordings:
    """Return what another sensor, of full scale 1, would have recorded."""
    rng = np.random.default_rng(0)
    full_scale = recordings.layout.full_scale
    frames = tuple(
        change(np.asarray(f, dtype=np.float64) / full_scale, rng) for f in recordings.frames
    )
    return replace(recordings, frames=frames, layout=replace(recordings.layout, full_scale=1.0))
