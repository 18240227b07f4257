"""Somebody else's network repaired: python examples/iclabel.py [--components 60]

ICLabelNet names the source of a component of an EEG. Its weights come with ``pip install
mne-icalabel``, and none of them was trained here. The cells are 64 electrodes, a window is 4 s of
one component. Components are simulated from their physics: a dipole in the brain, a muscle, the
eyes, the heart, the mains, one bad contact. A dead electrode floats: it reads hum.
"""

from __future__ import annotations

import argparse
from importlib.resources import files

import mne
import numpy as np
import torch
from mne_icalabel.iclabel.features import _topoplotFast
from mne_icalabel.iclabel.network.torch import ICLabelNet
from numpy.typing import NDArray
from torch import nn

from adaptfault import Adapter, Windows, evaluate, split
from diagnostics import FaultSet, SensorLayout

Floats = NDArray[np.floating]
RATE = 200
LENGTH = 4 * RATE
CLASSES = ("brain", "muscle", "eye", "heart", "line noise", "channel noise")  # as ICLabel has them
MONTAGE = mne.channels.make_standard_montage("biosemi64").get_positions()["ch_pos"]
ELECTRODES = np.array([at / np.linalg.norm(at) for at in MONTAGE.values()])  # right, front, up
LAYOUT = SensorLayout(1, 1, len(ELECTRODES), full_scale=200.0, unit="uV", rate=RATE)


def dipole(at: Floats, moment: Floats) -> Floats:
    """Return the potential of a dipole at the electrodes, in a medium without bounds."""
    away = ELECTRODES - at
    return away @ moment / np.linalg.norm(away, axis=1) ** 3


def noise(rng: np.random.Generator, slope: float, lowest: float = 0.5) -> Floats:
    """Return noise ``[T]`` of power ``1 / f**slope`` from ``lowest`` hertz on."""
    frequency = np.fft.rfftfreq(LENGTH, 1 / RATE)
    spectrum = np.fft.rfft(rng.standard_normal(LENGTH))
    spectrum *= np.maximum(frequency, lowest) ** (-slope / 2) * (frequency >= lowest)
    found = np.fft.irfft(spectrum, LENGTH)
    return found / found.std()


def pulses(rng: np.random.Generator, period: float, width: float) -> Floats:
    """Return bumps ``[T]`` that come every ``period`` seconds, more or less."""
    gaps = period * rng.uniform(0.9, 1.1, 2 + int(LENGTH / RATE / period))
    at = np.cumsum(gaps) - rng.uniform(0, period)
    seconds = np.arange(LENGTH) / RATE
    found = np.exp(-(((seconds[:, None] - at) / width) ** 2)).sum(axis=1)
    return found / found.std()


def component(name: str, rng: np.random.Generator) -> Floats:
    """Return the readings ``[T, D]`` of one component, scaled to 0..1."""
    direction = rng.standard_normal(3)
    seconds = np.arange(LENGTH) / RATE
    match name:
        case "brain":
            at = rng.uniform(-0.5, 0.5, 3) + np.array([0, 0, 0.35])
            weights = dipole(at, direction)
            alpha = np.sin(2 * np.pi * rng.uniform(8, 12) * seconds) * noise(rng, 2)
            course = noise(rng, 1) + 1.5 * alpha
        case "muscle":
            at = np.array([rng.choice([-0.9, 0.9]), rng.uniform(-0.4, 0.5), rng.uniform(-0.1, 0.3)])
            weights = dipole(at, direction)
            course = noise(rng, 0, lowest=20)
        case "eye":
            moment = np.array([0, 0.3, 1.0]) + 0.2 * direction
            weights = sum(dipole(np.array([side, 1.0, -0.35]), moment) for side in (-0.3, 0.3))
            course = 3 * pulses(rng, rng.uniform(0.9, 2), 0.12) + 0.3 * noise(rng, 1)
        case "heart":
            weights = dipole(np.array([-0.3, 0.2, -3.0]), direction)
            course = 3 * pulses(rng, rng.uniform(0.7, 1.0), 0.03) + 0.3 * noise(rng, 1)
        case "line noise":
            weights = dipole(2 * direction, rng.standard_normal(3))
            hum = np.sin(2 * np.pi * rng.choice([50, 60]) * seconds + rng.uniform(0, 7))
            course = hum + 0.1 * noise(rng, 1)
        case _:
            weights = np.eye(len(ELECTRODES))[rng.integers(len(ELECTRODES))]
            course = noise(rng, 1.5)
    weights = weights / np.abs(weights).max()
    sensors = 0.02 * rng.standard_normal((LENGTH, len(ELECTRODES)))
    return np.clip(0.5 + 0.1 * (course[:, None] * weights + sensors), 0, 1)


class OfReadings(nn.Module):
    """ICLabelNet behind its features: readings ``[N, T, D]`` to the logits of seven labels."""

    def __init__(self) -> None:
        super().__init__()
        self.net = ICLabelNet().float()
        weights = files("mne_icalabel.iclabel.network") / "assets" / "ICLabelNet.pt"
        self.net.load_state_dict(torch.load(str(weights), weights_only=True))
        right, front, up = ELECTRODES.T
        maps = [
            np.nan_to_num(
                _topoplotFast(unit, 0.5 - np.arcsin(up) / np.pi, np.arctan2(right, front))
            )
            for unit in np.eye(len(ELECTRODES))
        ]
        self.register_buffer("maps", torch.tensor(np.array(maps), dtype=torch.float32))

    def inputs(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return scalp map, spectrum in decibels and autocorrelation, as ICLabel scales them."""
        moved = x - x.mean(dim=1, keepdim=True)
        moved = moved - moved.mean(dim=2, keepdim=True)  # against the mean of the electrodes
        weights = torch.linalg.eigh(moved.transpose(1, 2) @ moved).eigenvectors[..., -1]
        course = (moved @ weights[..., None])[..., 0]
        image = torch.einsum("nd,dhw->nhw", weights, self.maps)
        image = image / image.abs().amax(dim=(1, 2), keepdim=True)
        parts = course.unfold(1, RATE, RATE // 2) * torch.hamming_window(RATE, periodic=False)
        power = torch.fft.rfft(parts).abs().square().median(dim=1).values[:, 1:101]
        spectrum = 20 * torch.log10(power + 1e-12)
        spectrum = spectrum / spectrum.abs().amax(dim=1, keepdim=True)
        whole = torch.fft.irfft(torch.fft.rfft(course, 2 * LENGTH).abs().square())
        lags = torch.arange(2, RATE + 1, 2)
        likeness = whole[:, lags] / whole[:, :1] * (LENGTH / (LENGTH - lags))
        return 0.99 * image[:, None], 0.99 * spectrum[:, None, None], 0.99 * likeness[:, None, None]

    def features(self, x: torch.Tensor) -> torch.Tensor:
        """Return what the last layer of ICLabelNet sees, ``[N, 712, 4, 4]``."""
        image, spectrum, likeness = self.inputs(x)
        spread = [
            self.net.reshape_concat(branch(of))
            for branch, of in (
                (self.net.psds_conv, spectrum),
                (self.net.autocorr_conv, likeness),
            )
        ]
        return torch.cat([self.net.img_conv(image), *spread], dim=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the logits ``[N, 7]``, the mean over both signs of the component."""
        return self.net.conv(self.features(x))[..., 0, 0]


def windows(components: int, seed: int) -> Windows:
    """Return as many components of each class; each is a recording of its own."""
    rng = np.random.default_rng(seed)
    y = np.repeat(np.arange(len(CLASSES)), components)
    x = np.array([component(CLASSES[label], rng) for label in y], np.float32)
    return Windows(x, y, np.arange(len(y)))


def floating(healthy: Windows, dead: FaultSet, rng: np.random.Generator) -> Windows:
    """Return windows in which the dead electrodes read hum."""
    x = healthy.x.copy()
    seconds = np.arange(LENGTH)[:, None] / RATE
    phase = rng.uniform(0, 2 * np.pi, (len(x), 1, len(dead)))
    x[..., dead.mask] = 0.5 + 0.3 * np.sin(2 * np.pi * 50 * seconds + phase)
    return Windows(x, healthy.y, healthy.recording)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--components", type=int, default=60, help="of each class")
    args = parser.parse_args()
    training, validation, test = split(windows(args.components, seed=0), test=0.4)
    model = OfReadings().eval()
    adapter = Adapter(
        model,
        training,
        validation,
        layout=LAYOUT,
        features=lambda of, x: of.features(x).mean((2, 3)),
    )
    print("healthy:          ", evaluate(model, test), flush=True)
    print("healthy, own head:", evaluate(adapter.healthy, test), flush=True)
    rng = np.random.default_rng(0)
    print(f"{'dead':6}{'broken':>8}" + "".join(f"{name:>8}" for name in ("fill", "head", "auto")))
    for count in (6, 16, 32):
        dead = FaultSet(rng.choice(LAYOUT.n_cells, count, replace=False).tolist(), LAYOUT.n_cells)
        broken = floating(test, dead, rng)
        row = [evaluate(model, broken).accuracy]
        for method in ("fill", "head", "auto"):
            budget = {"budget": 30} if method == "auto" else {}
            row.append(evaluate(adapter.adapt(dead, method=method, **budget), broken).accuracy)
        print(f"{count:<6}" + "".join(f"{accuracy:8.3f}" for accuracy in row), flush=True)


if __name__ == "__main__":
    main()
