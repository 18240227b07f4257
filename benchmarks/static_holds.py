"""Simulated people who sit on a seat or lie on a mat, so that loads stay for a whole recording.

A healthy cell holds its load for as long as the posture lasts, as a broken cell does, and the next
recording begins with another posture. Some people breathe visibly, some shift their weight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptfault.data.recordings import Recordings
from diagnostics import SensorLayout

SITTING = ("upright", "back", "left", "right", "front", "edge", "back left", "back right")
LYING = ("on the back", "on the left", "on the right")
Array = np.ndarray
# centre, half axes, as shares of the skin; force; angle
Ellipse = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Skin:
    """A seat or a mat.

    Attributes:
        noise, rest: as shares of full scale; untouched cells rest at 0.3 to 1.7 times ``rest``.
        breath: share of the load that comes and goes with it.
        shifts: of the weight, in the mean of a recording.
    """

    rows: int = 16
    cols: int = 16
    steps: int = 255
    noise: float = 0.0
    rest: float = 0.0
    breath: float = 0.01
    shifts: float = 0.3
    rate: float = 10.0
    seconds: float = 20.0
    lying: bool = False

    def recordings(self, count: int, seed: int) -> Recordings:
        """Simulate so many people; one in ten recordings is of the empty skin."""
        rng = np.random.default_rng(seed)
        shape = (self.rows, self.cols)
        rest = self.rest * np.random.default_rng(99).uniform(0.3, 1.7, shape)
        postures = LYING if self.lying else SITTING
        labels = rng.integers(len(postures), size=count)
        read = []
        for label in labels.tolist():
            size = rng.uniform(0.75, 1.25)
            weight = rng.uniform(0.5, 1.2)
            body = lying(label, size, rng) if self.lying else sitting(label, size, rng)
            load = weight * self.held(body, rng) * (rng.random() >= 0.1)
            load = np.minimum(np.where(load > 0.03, load, 0), 1)  # foam takes the rest
            value = load + rest + self.noise * rng.standard_normal(load.shape)
            read.append(np.clip(np.round(value * self.steps), 0, self.steps).reshape(len(load), -1))
        layout = SensorLayout(1, *shape, full_scale=float(self.steps), rate=self.rate, unit="count")
        return Recordings(tuple(read), layout, labels, postures)

    def held(self, body: list[Ellipse], rng: np.random.Generator) -> Array:
        """Return the load ``[frames, rows, cols]`` of a body that breathes, and shifts its weight
        now and then."""
        t = np.arange(int(self.rate * self.seconds)) / self.rate
        shift = np.searchsorted(np.sort(rng.uniform(0, t[-1], rng.poisson(self.shifts))), t)
        load = np.zeros((len(t), self.rows, self.cols))
        for since in np.unique(shift):
            now = shift == since
            moved = since > 0
            away = moved * rng.normal(0, 0.03, (len(body), 2))
            force = np.exp(moved * rng.normal(0, 0.15, len(body)))
            phase = rng.uniform(0, 6, len(body))
            pace = rng.uniform(0.15, 0.4)
            breath = 1 + self.breath * np.sin(2 * np.pi * pace * t[now, None] + phase)
            pressed = np.stack(
                [self.pressed(*part, *by) for part, by in zip(body, away, strict=True)]
            )
            load[now] = np.tensordot(breath * force, pressed, (1, 0))
        return load

    def pressed(
        self,
        y: float,
        x: float,
        length: float,
        width: float,
        force: float,
        angle: float,
        *by: float,
    ) -> Array:
        """Return the load ``[rows, cols]`` of an ellipse that has moved ``by`` so much."""
        rows, cols = (np.arange(n) + 0.5 for n in (self.rows, self.cols))
        down, right = np.meshgrid(
            rows / self.rows - y - by[0], cols / self.cols - x - by[1], indexing="ij"
        )
        along = down * np.cos(angle) + right * np.sin(angle)
        across = right * np.cos(angle) - down * np.sin(angle)
        return force * np.maximum(0, 1 - (along / length) ** 2 - (across / width) ** 2)


SKINS = {
    "seat": Skin(),
    "nobody breathes": Skin(breath=0.0, shifts=0.0),
    "noise": Skin(steps=1023, noise=0.003, rest=0.02),
    "rests at 5 %": Skin(noise=0.0005, rest=0.05),
    "mat": Skin(64, 32, steps=1000, rate=1.0, seconds=100.0, shifts=0.5, lying=True),
}


def sitting(label: int, size: float, rng: np.random.Generator) -> list[Ellipse]:
    """Return two sit bones and, but on the edge of the seat, two thighs."""
    lean = (
        (0, 0.12, 0, 0, -0.12, 0.05, 0.1, 0.1)[label],
        (0, 0, 0.12, -0.12, 0, 0, 0.1, -0.1)[label],
    )
    y, x = 0.5 + np.array(lean) + rng.normal(0, 0.03, 2)
    turn = rng.normal(0, 0.15)
    parts = []
    for side in (-1, 1):
        force = float(np.clip(0.7 + side * 1.5 * (x - 0.5), 0.2, 1))
        at = size * side
        parts.append((y + 0.12, x + 0.17 * at, 0.16 * size, 0.16 * size, force, turn))
        if SITTING[label] != "edge":
            parts.append(
                (y - 0.2, x + 0.2 * at, 0.35 * size, 0.11 * size, 0.5 * force, turn - 0.15 * side)
            )
    return parts


def lying(label: int, size: float, rng: np.random.Generator) -> list[Ellipse]:
    """Return head, trunk and limbs."""
    x = 0.5 + rng.normal(0, 0.08)
    parts = [(0.12 * size, x + rng.normal(0, 0.05), 0.06, 0.1, 0.5, 0.0)]
    if label == 0:
        parts += [(0.3 * size, x, 0.1, 0.22, 0.6, 0.0), (0.48 * size, x, 0.09, 0.2, 0.9, 0.0)]
        for side in (-1, 1):
            parts += [
                (0.3 * size, x + 0.32 * side, 0.15, 0.05, 0.25, side * rng.normal(0.2, 0.1)),
                (0.63 * size, x + 0.1 * side, 0.12, 0.07, 0.5, side * rng.normal(0, 0.1)),
                (0.85 * size, x + 0.12 * side, 0.04, 0.05, 0.7, 0.0),
            ]
        return parts
    side = 1 if label == 1 else -1
    return [
        *parts,
        (0.27 * size, x + 0.05 * side, 0.08, 0.12, 0.9, 0.0),
        (0.47 * size, x, 0.09, 0.12, 1.0, 0.0),
        (0.6 * size, x + 0.15 * side, 0.06, 0.18, 0.5, 0.5 * side + rng.normal(0, 0.1)),
        (0.78 * size, x + 0.2 * side, 0.14, 0.06, 0.4, -0.4 * side),
        (0.33 * size, x + 0.3 * side, 0.05, 0.15, 0.3, rng.normal(0, 0.3)),
    ]
