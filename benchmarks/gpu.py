"""Training steps and predictions of the paper's network on a GPU and on the CPU, and how far the
outputs differ.

Run: python benchmarks/gpu.py
"""

from __future__ import annotations

import statistics
import time

import numpy as np
import torch
import torch.nn.functional as F

from adaptfault.models.network import TactileTransformer, logits_of
from adaptfault.models.training_run import Optimisation
from diagnostics import SensorLayout

CLASSES = 7
WARM_UP = 3


def network(device: str) -> TactileTransformer:
    torch.manual_seed(0)
    return TactileTransformer(SensorLayout.paper(), CLASSES).to(device)


def step_ms(device: str, x: np.ndarray, y: np.ndarray, steps: int) -> float:
    """Return the median time of a training step, that of the first ones left out."""
    model = network(device).train()
    taken = []
    windows = torch.from_numpy(x).to(device)
    labels = torch.from_numpy(y).to(device)
    run = Optimisation(model, 1e-4, 0.995)
    for _ in range(WARM_UP + steps):
        began = time.perf_counter()
        loss = F.cross_entropy(model(windows), labels)
        run.step(loss)
        loss.item()  # waits for the device
        taken.append(1000 * (time.perf_counter() - began))
    return statistics.median(taken[WARM_UP:])


def main() -> None:
    rng = np.random.default_rng(0)
    x = rng.random((512, 10, SensorLayout.paper().n_cells), dtype=np.float32)
    y = rng.integers(0, CLASSES, len(x))
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    print(
        f"torch {torch.__version__}, {torch.get_num_threads()} threads",
        *map(torch.cuda.get_device_name, devices[1:]),
    )
    logits = []
    for device in devices:
        for size in (32, 256):
            print(
                f"{device}: a step of {size} windows"
                f" {step_ms(device, x[:size], y[:size], 20):.2f} ms"
            )
        model = network(device).eval()
        taken = []
        windows = x if device == "cpu" else np.concatenate([x] * 8)
        for _ in range(WARM_UP):
            began = time.perf_counter()
            logits.append(logits_of(model, windows)[: len(x)].numpy())
            taken.append(1000 * (time.perf_counter() - began))
        print(f"{device}: prediction of {len(windows)} windows {min(taken):.1f} ms")
    print(
        f"logits differ by at most {np.abs(logits[-1] - logits[0]).max():.1e}; their deviation is"
        f" {logits[0].std():.2f}"
    )


if __name__ == "__main__":
    main()
