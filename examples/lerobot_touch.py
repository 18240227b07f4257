"""Touch for a policy of LeRobot while a row of cells is broken: what the step fills, and what it
costs a frame.

    python examples/lerobot_touch.py [robot.bundle] [--frames 2000] [--rate 50]

Without a bundle, one is made from simulated grasps (a minute). The step is saved with a pipeline,
read again, and timed frame by frame in turn with LeRobot's step that does nothing. Needs LeRobot
0.4.4; without it the example says so, and ends.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

import adaptfault as af
from diagnostics import FaultKind, Line, SelfDiagnosis, line_fault

ROW = Line(0, "row", 4)


def make_bundle(path: Path) -> None:
    """Write a bundle of a briefly trained network."""
    grasps = af.simulate(6, seed=0)
    train, validation, test = af.split(af.make_windows(grasps.frames, grasps.labels, grasps.layout))
    model = af.TactileTransformer(grasps.layout, len(grasps.class_names))
    af.train(model, train, validation, epochs=1)
    diagnoser = SelfDiagnosis(grasps.layout).fit(grasps.frames)
    adapter = af.Adapter(model, train, validation)
    af.Bundle.create(path, model, adapter, diagnoser, check=test)


def observations(frames: np.ndarray) -> Iterator[dict[str, torch.Tensor]]:
    """Yield each frame ``[pads, rows, cols]`` as an observation with a feature for each pad."""
    for frame in torch.from_numpy(frames.astype(np.float32)):
        yield {f"observation.tactile.{pad}": cells for pad, cells in enumerate(frame)}


def timed(pipelines: dict, frames: np.ndarray, rate: float) -> dict[str, np.ndarray]:
    """Return the milliseconds that each pipeline takes for each frame, one after the other, at a
    rate of frames a second."""
    taken: dict[str, list[float]] = {name: [] for name in pipelines}
    due = time.perf_counter()
    for observation in observations(frames):
        due += 1 / rate
        time.sleep(max(0.0, due - time.perf_counter()))
        for name, pipeline in pipelines.items():
            began = time.perf_counter()
            pipeline(observation)
            taken[name].append(1e3 * (time.perf_counter() - began))
    return {name: np.array(each) for name, each in taken.items()}


def joined(observation: dict[str, torch.Tensor], ending: str = "") -> np.ndarray:
    """Return the pads of an observation, one after the other."""
    names = [name for name in observation if name.rpartition(".")[2].isdigit()]
    return np.stack([observation[name + ending].numpy() for name in names])


def show(folder: Path, bundle: Path, n_frames: int, rate: float) -> None:
    """Print what the step does to a broken row."""
    from lerobot.processor import IdentityProcessorStep, PolicyProcessorPipeline

    from adaptfault.lerobot import TouchProcessorStep

    layout = af.Bundle.open(bundle).layout
    step = TouchProcessorStep(bundle)
    PolicyProcessorPipeline([step], name="policy_preprocessor").save_pretrained(folder / "policy")
    touch = PolicyProcessorPipeline.from_pretrained(folder / "policy", "policy_preprocessor.json")
    print(f"saved with the policy and read again: {', '.join(p.name for p in saved(folder))}")

    grasps = af.simulate(6, layout, seed=1)
    healthy = np.concatenate(grasps.frames).reshape(-1, *layout.shape)
    healthy = np.resize(healthy, (n_frames, *layout.shape))
    row = line_fault(layout, ROW, FaultKind.SHORT)
    broken = healthy.reshape(n_frames, -1).copy()
    broken[:, row.cells] = layout.full_scale
    broken = broken.reshape(healthy.shape)

    pipelines = {
        "nothing": PolicyProcessorPipeline([IdentityProcessorStep()]),
        "filled": PolicyProcessorPipeline([TouchProcessorStep(bundle, watch=False)]),
        "filled and monitored": touch,
    }
    times = timed(pipelines, broken, rate)
    idle = times.pop("nothing")
    print(f"a step that does nothing: {np.median(idle):.2f} ms a frame, in the median")
    for name, each in times.items():
        more = each - idle
        low, high = np.percentile(more, [50, 99])
        print(f"{name}: {low:.2f} ms a frame more than nothing; 99 % of them less than {high:.2f}")

    last = [touch(one) for one in observations(broken[-50:])]
    filled = np.array([joined(one) for one in last])
    marked = ~np.array([joined(one, ".valid") for one in last]).all(0)
    print(f"{marked.sum()} cells are marked, {len(row.cells)} are dead")
    error = np.abs(filled - healthy[-50:])[:, marked].mean()
    before = np.abs(broken - healthy)[-50:, marked].mean()
    print(f"their mean error: {before:.2f} {layout.unit} as read, {error:.2f} as filled")


def saved(folder: Path) -> list[Path]:
    """Return the files of the pipeline."""
    return sorted((folder / "policy").iterdir())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bundle", nargs="?", type=Path)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--rate", type=float, default=50.0, help="frames a second")
    args = parser.parse_args()
    try:
        from adaptfault.lerobot import TouchProcessorStep  # noqa: F401
    except ImportError as error:
        print(f"skipped: {error}")
        return 0
    with tempfile.TemporaryDirectory() as folder:
        bundle = args.bundle
        if bundle is None:
            bundle = Path(folder) / "robot.bundle"
            make_bundle(bundle)
        show(Path(folder), bundle, args.frames, args.rate)
    return 0


if __name__ == "__main__":
    sys.exit(main())
