"""Write simulated grasps of a two-finger hand as a LeRobot 3.0 data set: ``python
examples/lerobot_set.py [FOLDER]``.

Each finger is a feature, each grasp an episode, and its class is the task. Needs the extra
"datasets". Every command of adaptfault reads the folder as it is; ``first_hour.sh`` does so.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import adaptfault as af
from diagnostics import SensorLayout

FINGERS = ("observation.tactile.left", "observation.tactile.right")
LAYOUT = SensorLayout(2, 10, 8, full_scale=3.3, unit="V", rate=20.0)
FRAMES = 60
CLASSES = ("nothing", "normal", "softer", "harder")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("lerobot-set"))
    parser.add_argument("--grasps", type=int, default=6, help="of each class")
    args = parser.parse_args()
    recordings = af.simulate(args.grasps, LAYOUT, n_frames=FRAMES, seed=0, classes=CLASSES)
    write_information(args.folder / "meta")
    data = args.folder / "data/chunk-000"
    data.mkdir(parents=True, exist_ok=True)
    pq.write_table(episodes(recordings), data / "file-000.parquet")
    print(f"{args.folder}: {len(recordings)} episodes of {LAYOUT}")


def write_information(folder: Path) -> None:
    """Write the features, the rate and the tasks."""
    folder.mkdir(parents=True, exist_ok=True)
    features = {
        name: {"dtype": "float32", "shape": [LAYOUT.rows, LAYOUT.cols], "names": None}
        for name in FINGERS
    }
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    about = {"codebase_version": "v3.0", "fps": LAYOUT.rate, "features": features}
    (folder / "info.json").write_text(json.dumps(about))
    tasks = {"task_index": range(len(CLASSES)), "__index_level_0__": CLASSES}
    pq.write_table(
        pa.table({name: list(of) for name, of in tasks.items()}), folder / "tasks.parquet"
    )


def episodes(recordings: af.Recordings) -> pa.Table:
    """Return one row a frame."""
    assert recordings.labels is not None
    tables = []
    for number, frames in enumerate(recordings):
        fingers = LAYOUT.grid(frames)
        rows = len(frames)
        columns = {name: fingers[:, pad].tolist() for pad, name in enumerate(FINGERS)}
        columns["timestamp"] = (np.arange(rows) / LAYOUT.rate).tolist()
        columns["frame_index"] = list(range(rows))
        columns["episode_index"] = [number] * rows
        columns["task_index"] = [int(recordings.labels[number])] * rows
        tables.append(pa.table(columns))
    return pa.concat_tables(tables)


if __name__ == "__main__":
    main()
