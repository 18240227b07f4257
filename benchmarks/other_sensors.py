"""The recordings of one array, remade as another sensor would have read them.

A *sensor* differs both when the reference is recorded and when the log is; a *drift* came in
between: the reference is the plain one.
"""

from __future__ import annotations

import numpy as np

from adaptfault.bench.changes import Change, Frames, of_each, read_with, wandering


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
    "each wanders, 0 to 2 %": wandering,
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
