"""Simulated social touch on fabric skins: presses, pats, strokes and scratches.

One recording repeats the same pat many times, fingers leave a cell and return within a tenth of a
second, and contacts are one or two cells wide. The skins have noise, crosstalk and rest levels that
wander.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptfault.data.recordings import Recordings
from diagnostics import SensorLayout

GESTURES = ("nothing", "press", "pat", "rub", "stroke", "scratch", "tickle")
STEPS = 1023
Array = np.ndarray


@dataclass(frozen=True)
class Skin:
    """A fabric skin; shares are of full scale.

    Attributes:
        side: rows, and columns.
        noise: standard deviation.
        rest: of untouched cells, 0.3 to 1.7 times that.
        wander: of each cell's rest from one recording to the next, standard deviation; half as much
            within one.
        crosstalk: of the mean load of a line that its other cells read.
        decades: standard deviation of log10 of the gains, beside 0.7 to 1.3; dull: share of cells
            that hardly react.
    """

    side: int = 10
    noise: float = 0.002
    rest: float = 0.02
    wander: float = 0.002
    crosstalk: float = 0.05
    decades: float = 0.0
    dull: float = 0.0

    rate = 54.0
    seconds = 8.0

    def recordings(self, count: int, seed: int) -> Recordings:
        """Simulate so many gestures."""
        rng = np.random.default_rng(seed)
        own = np.random.default_rng(99)
        shape = self.side, self.side
        gain = own.uniform(0.7, 1.3, shape)
        rest = self.rest * own.uniform(0.3, 1.7, shape)
        if self.decades or self.dull:
            gain = (
                gain
                * 10 ** (self.decades * own.standard_normal(shape))
                * np.where(own.random(shape) < self.dull, 0.02, 1)
            )
        frames = int(self.seconds * self.rate)
        labels = rng.integers(len(GESTURES), size=count)
        read = []
        for label in labels.tolist():
            load = np.minimum(touched(GESTURES[label], self.side, frames, self.rate, rng), 1.1)
            load += self.crosstalk * (
                load.mean(axis=1, keepdims=True) + load.mean(axis=2, keepdims=True)
            )
            now, later = self.wander * rng.standard_normal((2, *shape))
            wander = now + 0.5 * later * np.linspace(0, 1, frames)[:, None, None]
            value = load * gain + rest + wander + self.noise * rng.standard_normal(load.shape)
            read.append(np.clip(np.round(value * STEPS), 0, STEPS).reshape(frames, -1))
        layout = SensorLayout(1, *shape, full_scale=float(STEPS), rate=self.rate, unit="count")
        return Recordings(tuple(read), layout, labels, GESTURES)


SKINS = {
    "10 x 10": Skin(),
    "no crosstalk": Skin(crosstalk=0.0),
    "noise 0.4 %, crosstalk 15 %": Skin(noise=0.004, rest=0.05, crosstalk=0.15),
    "rest wanders by 0.6 %": Skin(noise=0.001, rest=0.1, wander=0.006),
    "rest wanders by 1 %": Skin(rest=0.05, wander=0.01),
    "rests at 0": Skin(rest=0.0, wander=0.0),
    "16 x 16": Skin(16),
    "gains over a decade": Skin(16, crosstalk=0.01, decades=0.4),
    "a third hardly reacts": Skin(16, crosstalk=0.01, dull=0.33),
}


def touched(gesture: str, side: int, frames: int, rate: float, rng: np.random.Generator) -> Array:
    """Return the load ``[frames, side, side]`` of a gesture, somewhere, in any direction, as hard
    as it happens."""
    t = np.arange(frames) / rate
    size = side / 10
    load = np.zeros((frames, side, side))
    places = np.moveaxis(np.indices((side, side)), 0, -1)
    centre = rng.uniform(0.15, 0.85, 2) * side
    angle = rng.uniform(0, np.pi)
    force = rng.uniform(0.3, 1)
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    fingers = int(rng.integers(2, 6))

    def press(where: Array, force: Array, length: float, width: float) -> None:
        """Press an ellipse, long across the row of fingers, at ``where`` (``[frames, 2]``)."""
        away = places - where[:, None, None]
        far = (away @ across / length) ** 2 + (away @ along / width) ** 2
        load[:] += force[:, None, None] * np.maximum(0, 1 - far)

    still = np.zeros((frames, 2)) + centre
    period = rng.uniform(1, 3.5)
    # of each pat
    jitter = rng.normal(0, 0.5 * size, (int(period * t[-1]) + 2, 2))[(period * t).astype(int)]
    sway = np.sin(2 * np.pi * rng.uniform(0.5, 2) * t)
    sweep = 2 * ((rng.uniform(0.3, 0.8) * t + rng.random()) % 1) - 1
    fast = rng.uniform(2, 6)
    for k in range(fingers):
        own = force * rng.uniform(0.5, 1)
        at = still + 1.8 * size * (k - fingers / 2) * along
        if gesture == "press":
            breath = 1 + 0.03 * np.sin(2 * np.pi * rng.uniform(0.1, 0.5) * t)
            press(at, own * np.clip(t / 0.5, 0, 1) * breath, 2.6 * size, 1.3 * size)
        elif gesture == "pat":
            press(
                at + jitter,
                own * np.maximum(0, np.sin(2 * np.pi * period * t)) ** 2,
                2.8 * size,
                1.1 * size,
            )
        elif gesture == "rub":
            press(
                at + 2 * size * sway[:, None] * across,
                0.6 * own * np.ones(frames),
                2.2 * size,
                1.2 * size,
            )
        elif gesture == "stroke":
            lifted = np.clip(1.3 - 1.2 * np.abs(sweep), 0, 1)
            press(
                at + 3.5 * size * sweep[:, None] * across,
                0.6 * own * lifted,
                2.2 * size,
                1.2 * size,
            )
        elif gesture in ("scratch", "tickle"):
            phase = 2 * np.pi * fast * rng.uniform(0.9, 1.1) * t + rng.uniform(0, 6)
            scratches = gesture == "scratch"
            down = (
                np.clip(0.6 + 0.6 * np.cos(phase), 0, 1)
                if scratches
                else np.maximum(0, np.sin(phase + 1))
            )
            drift = np.cumsum(rng.normal(0, 0.03 * size, (frames, 2)), axis=0)
            tip = 0.9 * size + 0.4
            where = at + 0.8 * size * np.sin(phase)[:, None] * across + drift
            press(where, (0.5 if scratches else 0.3) * own * down, tip, tip)
    load[: int(rng.uniform(0, 0.12) * frames)] = 0
    load[int(rng.uniform(0.88, 1) * frames) :] = 0
    return load
