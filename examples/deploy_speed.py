"""What a model costs on a robot: latency of one window, share of a core in a 10 Hz loop with the
monitor, resident memory, on ONNX Runtime and on torch; and what it costs to read the adapter and to
export a repair. The paper's network, one thread; bare, and with fill and head for 20 dead cells.
Needs Linux and pip install 'adaptfault[deploy]'. Run: python examples/deploy_speed.py [--seconds
20]
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from adaptfault import Bundle, Inference, Predictor
from diagnostics import FaultSet, SelfDiagnosis

RUNS = 100


def prepare(folder: Path) -> None:
    """Make two bundles and a recording; the weights are untrained, which costs the same."""
    import torch

    import adaptfault as af
    from adaptfault.prediction.export import to_onnx

    torch.set_num_threads(1)
    grasps = af.simulate(n_per_class=10, seed=0)
    windows = af.make_windows(grasps.frames, grasps.labels, grasps.layout)
    training, validation, test = af.split(windows)
    model = af.TactileTransformer(grasps.layout, 7).eval()
    adapter = af.Adapter(model, training, validation)
    af.Bundle.create(
        folder / "bare", model, adapter, SelfDiagnosis(grasps.layout).fit(grasps.frames), check=test
    )
    shutil.copytree(folder / "bare", folder / "adapted")
    adapted = af.Bundle.open(folder / "adapted")
    dead = FaultSet(tuple(range(0, 220, 11)), 220)
    repair = adapter.adapt(dead, method="head", progress=False)
    seconds = {
        "adapter read": cpu_seconds(adapted.parts.adapter),
        "head exported": cpu_seconds(lambda: to_onnx(repair.model)),
        "with the graph of the bundle": cpu_seconds(
            lambda: to_onnx(repair.model, adapted.parts.graph)
        ),
    }
    print("; ".join(f"{what} in {took:.1f} s CPU" for what, took in seconds.items()))
    version = adapted.write_version(repair, {"reason": "measured"})
    adapted.deploy(version.number)
    adapted.confirm()
    np.save(folder / "frames.npy", np.concatenate(grasps.frames[:20]))


def cpu_seconds(call: Callable[[], object]) -> float:
    began = time.process_time()
    call()
    return time.process_time() - began


def latency(folder: Path) -> None:
    """Run both in turn on single windows, and print the medians."""
    import torch

    torch.set_num_threads(1)
    version = Bundle.open(folder).active().folder
    models = {runtime: Inference.load(version, runtime=runtime) for runtime in ("onnx", "torch")}
    x = np.random.default_rng(0).random((1, 10, 220), np.float32)
    seconds: dict[str, list[float]] = {runtime: [] for runtime in models}
    for _ in range(RUNS):
        for runtime, model in models.items():
            began = time.perf_counter()
            model.predict_proba(x)
            seconds[runtime].append(time.perf_counter() - began)
    onnx, eager = (1000 * float(np.median(seconds[runtime][10:])) for runtime in ("onnx", "torch"))
    print(
        f"{folder.name:8} one window: {onnx:.2f} ms on ONNX Runtime, {eager:.2f} ms on torch:"
        f" {onnx / eager:.2f} of it"
    )


def loop(folder: Path, runtime: str, seconds: float) -> None:
    """Stream at 10 Hz in this process alone, and print what it takes."""
    if runtime == "torch":
        sys.modules["onnxruntime"] = None  # type: ignore[assignment]  # as if it were not installed
    predictor = Predictor.load(folder)
    if runtime == "torch":
        sys.modules["torch"].set_num_threads(1)
    assert predictor.runtime == runtime
    frames = np.load(folder.parent / "frames.npy")
    longest = 0.0
    n = round(10 * seconds)
    used = time.process_time()
    began = time.perf_counter()
    for i in range(n):
        tick = time.perf_counter()
        predictor.stream(frames[i % len(frames)], time=i / 10)
        longest = max(longest, time.perf_counter() - tick)
        time.sleep(max(0.0, began + (i + 1) / 10 - time.perf_counter()))
    share = (time.process_time() - used) / (time.perf_counter() - began)
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    print(
        f"{folder.name:8} 10 Hz on {runtime:5} for {seconds:g} s: {100 * share:.1f} % of a core,"
        f" longest frame {1000 * longest:.0f} ms, {resident / 1e6:.0f} MB resident"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=2, help="length of each 10 Hz loop")
    parser.add_argument(
        "--measure", nargs=2, metavar=("FOLDER", "WHAT"), help="in a process of its own"
    )
    arguments = parser.parse_args()
    if arguments.measure:
        folder = Path(arguments.measure[0])
        what = arguments.measure[1]
        return latency(folder) if what == "latency" else loop(folder, what, arguments.seconds)
    with tempfile.TemporaryDirectory() as temporary:
        prepare(Path(temporary))
        for name in ("bare", "adapted"):
            for what in ("latency", "onnx", "torch"):
                command = [sys.executable, __file__, "--seconds", str(arguments.seconds)]
                environment = {**os.environ, "OMP_NUM_THREADS": "1"}
                subprocess.run(
                    [*command, "--measure", f"{temporary}/{name}", what],
                    check=True,
                    env=environment,
                )


if __name__ == "__main__":
    main()
