"""Takes a data set that LeRobot itself writes through the commands, and back: python
tests/check_lerobot.py

LeRobot has to be installed, 0.4.4 as it was written for. Not a test of pytest's: LeRobot brings
gigabytes, and other versions of packages. ``make lerobot-check`` makes an environment for it.
"""

from __future__ import annotations

import json
import tempfile
import warnings
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

import adaptfault as af
from adaptfault.cli import main
from diagnostics import SensorLayout

LAYOUT = SensorLayout(2, 6, 5, full_scale=3.3, unit="V", rate=20.0)
SIDES = ("observation.tactile.left", "observation.tactile.right")
DEAD = (2, 3)  # row and column on the left pad, in the later half of the episodes
VALUE = 1.25
EPISODES = 24


def grasps() -> tuple[list[np.ndarray], np.ndarray]:
    """Return episodes ``[T, 2, 6, 5]`` in which a cell fails in the middle, and their tasks."""
    made = af.simulate(12, LAYOUT, n_frames=40, seed=1, classes=("normal", "harder"))
    order = np.argsort(np.arange(EPISODES) % 12, kind="stable")
    frames = [np.asarray(made.frames[i], np.float32).reshape(-1, 2, 6, 5) for i in order]
    for one in frames[EPISODES // 2 :]:
        one[:, 0, DEAD[0], DEAD[1]] = VALUE
    return frames, np.asarray(made.labels)[order]


def written(root: Path) -> None:
    """Write the data set as LeRobot does."""
    touch = {"dtype": "float32", "shape": (6, 5), "names": ["row", "column"]}
    action = {"dtype": "float32", "shape": (4,), "names": None}
    features = {**dict.fromkeys(SIDES, touch), "action": action}
    dataset = LeRobotDataset.create("me/touch", 20, features, root=root, use_videos=False)
    for frames, task in zip(*grasps(), strict=True):
        for frame in frames:
            sides = dict(zip(SIDES, frame, strict=True))
            dataset.add_frame({**sides, "action": np.zeros(4, np.float32), "task": f"task{task}"})
        dataset.save_episode()
    dataset.finalize()


def expected(copy: LeRobotDataset) -> None:
    """Check what LeRobot reads from the copy; of a feature with rows and columns its statistics are
    those of each column."""
    assert len(copy) == EPISODES * 40
    valid = []
    for index, frame in enumerate(copy):
        masks = [frame[f"{side}.valid"].numpy() for side in SIDES]
        truth = np.ones((6, 5), bool)
        truth[DEAD] = index < len(copy) // 2
        np.testing.assert_array_equal(masks, [truth, np.ones((6, 5), bool)])
        valid.append(np.where(masks[0], frame[SIDES[0]].numpy(), np.nan))
    largest = np.nanmax(valid, axis=(0, 1))
    np.testing.assert_allclose(copy.meta.stats[SIDES[0]]["max"], largest, rtol=1e-6)


def run(*arguments: str, code: int = 0) -> None:
    """Run a command."""
    print("adaptfault", *arguments)
    assert main([*arguments, "--quiet"]) == code


def passed(folder: Path) -> None:
    """Take the data set through the commands."""
    root = folder / "set"
    written(root)
    stated = ("--full-scale", "3.3", "--unit", "V")
    run("info", str(root), *stated)
    run("check", str(root), *stated, "--quick", "--out", str(folder / "quick.json"), code=1)
    masks = ("--write-valid", str(folder / "valid.parquet"))
    copy = ("--write-copy", str(folder / "copy"))
    out = ("--out", str(folder / "check.json"), "--no-cache")
    run("check", str(root), *stated, *masks, *copy, *out, code=1)
    (fault,) = json.loads((folder / "check.json").read_text())["inspection"]["diagnosis"]["faults"]
    assert fault["cells"] == [LAYOUT.cell(0, *DEAD)], fault
    expected(LeRobotDataset("me/touch", root=folder / "copy"))
    frames = af.load(folder / "copy", full_scale=3.3, unit="V").recordings.frames
    missing = np.isnan(np.concatenate(frames))
    assert np.flatnonzero(missing.any(axis=0)).tolist() == [LAYOUT.cell(0, *DEAD)]
    assert missing.sum() == 40 * EPISODES // 2
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = af.guard(LeRobotDataset("me/touch", root=root), on="never", full_scale=3.3)
    assert any(one.name == "fault" for one in found)
    run("train", str(folder / "copy"), *stated, "--out", str(folder / "model"), "--epochs", "1")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        passed(Path(place))
    print("LeRobot reads what the commands write, and they read what it writes")
