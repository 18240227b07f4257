"""What linters of robots' data sets say of dead cells, beside ``adaptfault check``, and what that
costs: ``python examples/compare/linters.py --out examples/compare/LINTERS.md``

Three LeRobot sets of simulated grasps are made: a healthy one; one in which a row and four cells
fail in the middle; and one in which six cells are frozen in one task. Each tool reads each set from
the command line as it is shipped, in an environment of its own with the versions below. Counted are
cells that a tool names: faulty ones, and healthy ones. Processor time is the least of some runs
(``--runs``), one thread, the tools in turn. lerobot-doctor, robovet, physlint and robot-data-audit
look at features; what is a cell they do not know.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import adaptfault as af
from diagnostics import SensorLayout

VERSIONS = (
    "lerobot-doctor==0.2.0",
    "robovet==0.2.2",
    "physlint==0.4.0",
    "robot-data-audit==0.11.0",
)
LAYOUT = SensorLayout(2, 10, 8, full_scale=3.3, unit="V", rate=20.0)
FEATURES = ("observation.tactile.left", "observation.tactile.right")
CLASSES = ("nothing", "normal", "softer", "harder")
STATED = ("--shape", "2x10x8", "--full-scale", "3.3")  # what no linter is told, and ours needs
HALF = LAYOUT.n_cells // 2
NAMED = re.compile(r"(observation\.tactile\.\w+)\s*\[([\d,\s]+)\]")
CONSTANT = re.compile(r"(observation\.tactile\.\w+):[^:]*constant dimension[^:]*:([^-]*)")

Frames = list[np.ndarray]


@dataclass(frozen=True)
class Tool:
    """A command, which is given the folder of a set."""

    name: str
    command: tuple[str, ...]
    is_ours: bool = False


def grasps(per_task: int) -> tuple[Frames, np.ndarray]:
    """Return healthy grasps, the tasks in turn, and the task of each."""
    made = af.simulate(per_task, LAYOUT, n_frames=60, seed=0, classes=CLASSES)
    labels = np.asarray(made.labels)
    turn = np.argsort(
        [np.sum(labels[:i] == label) for i, label in enumerate(labels)], kind="stable"
    )
    frames = [np.asarray(made.frames[i], np.float32).reshape(-1, LAYOUT.n_cells) for i in turn]
    return frames, labels[turn]


def healthy(frames: Frames, tasks: np.ndarray) -> list[int]:
    """Change nothing."""
    return []


def from_the_middle(frames: Frames, tasks: np.ndarray) -> list[int]:
    """A row is dead, a cell stuck, one copies another, one floats, one is late."""
    rng = np.random.default_rng(1)
    row = list(range(24, 32))
    stuck, copied, floats, late = 44, 50, 59, 37
    for frame in frames[len(frames) // 2 :]:
        whole = frame.copy()
        frame[:, row] = 0
        frame[:, stuck] = 1.234
        frame[:, copied] = whole[:, copied + 1]
        frame[:, floats] = 0.4 + rng.normal(0, 0.2, len(frame))
        frame[10:, late] = whole[:-10, late]
    return [*row, stuck, copied, floats, late]


def in_a_task(frames: Frames, tasks: np.ndarray) -> list[int]:
    """Six cells hold one value in one task."""
    cells = [18, 29, 36, 45, 53, 61]
    for frame, task in zip(frames, tasks, strict=True):
        if task == tasks.max():
            frame[:, cells] = 0.61
    return cells


KINDS: dict[str, Callable[[Frames, np.ndarray], list[int]]] = {
    "healthy": healthy,
    "12 of 160 cells fail in the middle": from_the_middle,
    "6 cells are frozen in one task": in_a_task,
}


def write(folder: Path, frames: Frames, tasks: np.ndarray) -> None:
    """Write a LeRobot 3.0 set."""
    for below in ("data/chunk-000", "meta/episodes/chunk-000"):
        (folder / below).mkdir(parents=True)
    lengths = np.array(list(map(len, frames)))
    readings = np.concatenate(frames)
    state = np.cumsum(np.random.default_rng(9).normal(0, 0.01, (len(readings), 6)), 0)
    vectors = {name: readings[:, k * HALF : (k + 1) * HALF] for k, name in enumerate(FEATURES)}
    vectors |= {"observation.state": state, "action": state}
    within = np.concatenate([np.arange(n) for n in lengths])
    numbers = {
        "timestamp": (within / LAYOUT.rate).astype(np.float32),
        "frame_index": within,
        "episode_index": np.repeat(np.arange(len(frames)), lengths),
        "index": np.arange(len(readings)),
        "task_index": np.repeat(tasks, lengths),
    }
    lists = {name: pa.array(list(one.astype(np.float32))) for name, one in vectors.items()}
    pq.write_table(pa.table({**lists, **numbers}), folder / "data/chunk-000/file-000.parquet")
    ends = np.cumsum(lengths)
    places = ("data/chunk_index", "data/file_index", "meta/episodes/chunk_index")
    episodes = {
        "episode_index": np.arange(len(frames)),
        "tasks": [[CLASSES[task]] for task in tasks],
        "length": lengths,
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
        **dict.fromkeys((*places, "meta/episodes/file_index"), np.zeros(len(frames), int)),
    }
    pq.write_table(pa.table(episodes), folder / "meta/episodes/chunk-000/file-000.parquet")
    known = {"task_index": list(range(len(CLASSES))), "__index_level_0__": list(CLASSES)}
    pq.write_table(pa.table(known), folder / "meta/tasks.parquet")
    features = {
        name: {"dtype": "float32", "shape": [one.shape[1]], "names": None}
        for name, one in vectors.items()
    }
    kinds = {name: "float32" if name == "timestamp" else "int64" for name in numbers}
    features |= {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in kinds.items()}
    about = {
        "codebase_version": "v3.0",
        "robot_type": "hand",
        "total_episodes": len(frames),
        "total_frames": len(readings),
        "total_tasks": len(CLASSES),
        "chunks_size": 1000,
        "fps": int(LAYOUT.rate),
        "splits": {"train": f"0:{len(frames)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }
    (folder / "meta/info.json").write_text(json.dumps(about))


def cells_named(tool: Tool, said: str, out: Path) -> set[int]:
    """Return the cells that a tool calls faulty, constant or stuck."""
    if tool.is_ours:
        found = json.loads(out.read_text())["inspection"]["diagnosis"]["faults"]
        return {cell for fault in found for cell in fault["cells"]}
    text = " ".join(re.sub(r"[│╭╮╰╯─]", " ", said).split())
    cells = set()
    for feature, numbers in NAMED.findall(text):
        cells |= {HALF * FEATURES.index(feature) + int(n) for n in re.findall(r"\d+", numbers)}
    for feature, dims in CONSTANT.findall(text):
        cells |= {HALF * FEATURES.index(feature) + int(n) for n in re.findall(r"dim (\d+)", dims)}
    return cells


def timed(command: Sequence[str], place: str) -> tuple[float, int, str]:
    """Run a command in a folder, as some write there; return its processor time in seconds, its
    exit code and what it said."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=place)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return seconds, done.returncode, done.stdout + done.stderr


def others(environment: Path) -> list[Tool]:
    """Return the tools of others, installed where they are not yet."""
    scripts = environment.resolve() / "bin"
    if not (scripts / "rda").exists():
        subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
        install = [str(scripts / "python"), "-m", "pip", "install", "--quiet", *VERSIONS]
        subprocess.run(install, check=True)
    return [
        Tool("lerobot-doctor 0.2.0", (str(scripts / "lerobot-doctor"),)),
        Tool("robovet 0.2.2", (str(scripts / "robovet"), "doctor")),
        Tool("physlint 0.4.0", (str(scripts / "physlint"), "check")),
        Tool("robot-data-audit 0.11.0", (str(scripts / "rda"), "audit")),
    ]


def ours() -> list[Tool]:
    """Return our commands."""
    check = (sys.executable, "-m", "adaptfault", "check", "--no-cache")
    return [Tool("`check --quick`", (*check, "--quick"), True), Tool("`check`", check, True)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="the table as Markdown (default: print it)")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--grasps", type=int, default=12, help="of each task")
    parser.add_argument("--environment", type=Path, default=Path("build/linters"))
    parser.add_argument("--ours-alone", action="store_true", help="without the tools of others")
    args = parser.parse_args()
    os.environ |= {"OMP_NUM_THREADS": "1", "COLUMNS": "4000"}
    lines = ["| set | tool | CPU s | faulty cells named | healthy cells named | exit code |"]
    lines.append("|---|---|---|---|---|---|")
    compared = ours() if args.ours_alone else [*others(args.environment), *ours()]
    with tempfile.TemporaryDirectory() as place:
        for kind, broken in KINDS.items():
            frames, tasks = grasps(args.grasps)
            truth = set(broken(frames, tasks))
            folder = Path(place, kind.replace(" ", "-"))
            write(folder, frames, tasks)
            for tool in compared:
                out = Path(place, "out.json")
                more = ("--out", str(out), *STATED) if tool.is_ours else ()
                ran = [timed((*tool.command, str(folder), *more), place) for _ in range(args.runs)]
                named = cells_named(tool, ran[0][2], out)
                seconds = min(one[0] for one in ran)
                counts = f"{len(named & truth)} of {len(truth)} | {len(named - truth)}"
                lines.append(f"| {kind} | {tool.name} | {seconds:.2f} | {counts} | {ran[0][1]} |")
                print(lines[-1], flush=True)
    if args.out:
        about = " ".join((__doc__ or "").split("\n\n")[1].split())
        args.out.write_text(f"# Linters of data sets\n\n{about}\n\n" + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
