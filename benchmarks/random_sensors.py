"""Sensors drawn at random: what the diagnosis does on arrays for which no rule was chosen.

A number determines the sensor: real recordings remade (other noise, baselines, gains, converter
steps, power law, lag, frame rate, crosstalk), simulated grasps on pads of any size, and fabric
skins, seats and mats of any size and noise. The number of recordings is drawn too, from few to
many.
"""

from __future__ import annotations

from collections.abc import Callable

import gestures
import numpy as np
import static_holds
from scipy.signal import lfilter

from adaptfault.bench.changes import Change, Frames, remade
from adaptfault.data.recordings import Recordings
from adaptfault.data.simulated_grasps import CLASS_NAMES, simulate
from diagnostics import SensorLayout

FEWEST_FRAMES = 20  # of a recording at a lower frame rate


def draw(seed: int, real: list[Callable[[], Recordings]]) -> Recordings:
    """Return the recordings of sensor ``seed``; ``real`` recordings are remade."""
    rng = np.random.default_rng(seed)
    kinds = (
        fabric,
        posture,
        grasps,
        *(lambda rng, seed, load=load: some(load(), rng) for load in real),
    )
    kind = int(rng.integers(len(kinds)))
    recordings = kinds[kind](rng, seed)
    # Fabric skins and seats have a noise and a baseline of their own.
    return recordings if kind < 2 else remade(recordings, reading(rng, recordings.layout.n_cells))


def fabric(rng: np.random.Generator, seed: int) -> Recordings:
    skin = gestures.Skin(
        side=int(rng.integers(6, 17)),
        noise=10 ** rng.uniform(-3.5, -2),
        rest=rng.choice([0.02, 0.05, 0.1]),
        wander=rng.choice([0.0, 0.002, 0.005]),
        crosstalk=rng.choice([0.0, 0.01, 0.05, 0.1]),
        decades=rng.choice([0.0, 0.0, 0.2]),
        dull=rng.choice([0.0, 0.0, 0.2]),
    )
    return skin.recordings(int(rng.integers(24, 160)), seed)


def posture(rng: np.random.Generator, seed: int) -> Recordings:
    rows, cols = rng.integers(8, 25, 2).tolist()
    skin = static_holds.Skin(
        rows,
        cols,
        steps=int(rng.choice([255, 1023, 4095])),
        noise=rng.choice([0.0, 0.001, 0.004]),
        rest=rng.choice([0.0, 0.03, 0.08]),
        breath=rng.choice([0.0, 0.01, 0.05]),
        shifts=rng.choice([0.0, 0.3, 1.0]),
        seconds=rng.choice([10.0, 20.0, 40.0]),
        lying=bool(rng.random() < 0.3),
    )
    return skin.recordings(int(rng.integers(24, 160)), seed)


def grasps(rng: np.random.Generator, seed: int) -> Recordings:
    pads, rows, cols = rng.integers((1, 3, 3), (4, 14, 14)).tolist()
    count = int(rng.integers(24, 160))
    frames = int(rng.choice([40, 60, 100]))
    layout = SensorLayout(pads, rows, cols)
    return simulate(
        -(-count // len(CLASS_NAMES)), layout, n_frames=frames, seed=seed, sensor_seed=seed
    )


def some(recordings: Recordings, rng: np.random.Generator) -> Recordings:
    """Return some of the recordings, at least 30."""
    count = int(rng.integers(30, min(400, len(recordings)) + 1))
    return recordings.select(rng.choice(len(recordings), count, replace=False))


def reading(rng: np.random.Generator, n_cells: int) -> Change:
    """Return how a sensor drawn at random reads, of which ``rng`` draws the noise too."""
    noise = rng.choice([0.0, 0.001, 0.004, 0.01])
    steps = rng.choice([100, 255, 1023, 4095])
    rest = rng.choice([0.0, 0.0, 0.03, 0.1]) * rng.uniform(0.5, 1.5, n_cells)
    gain = 1 + rng.choice([0.0, 0.3, 0.6]) * rng.uniform(-1, 1, n_cells)
    power = rng.choice([0.5, 1.0, 1.0, 1.5])
    lag = rng.choice([0.0, 0.0, 0.5])
    wander = rng.choice([0.0, 0.0, 0.01])
    crosstalk = rng.choice([0.0, 0.0, 0.05])
    every = int(rng.choice([1, 1, 2, 3]))

    def read(frames: Frames, _: np.random.Generator) -> Frames:
        load = np.nan_to_num(frames)
        if len(load) >= FEWEST_FRAMES * every:
            load = load[::every]
        load = np.maximum(lfilter([1 - lag], [1, -lag], load, axis=0), 0) ** power * gain
        load += crosstalk * load.mean(axis=1, keepdims=True)
        value = (
            load * (1 - 1.5 * rest.max())
            + rest
            + rng.uniform(0, wander)
            + noise * rng.standard_normal(load.shape)
        )
        return np.clip(np.round(value * steps) / steps, 0, 1)

    return read
