"""A reproduction: run the tasks without a result, then draw the figures, decide the claims and
write the page."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tqdm import tqdm

from adaptfault.data.atomic import atomic_write
from adaptfault.data.recordings import Recordings
from adaptfault.data.windows import make_windows
from adaptfault.models.checkpoint import fingerprint_windows
from adaptfault.paper.bench import Bench, Setup
from adaptfault.paper.ledger import Ledger, Result
from adaptfault.paper.settings import Settings

SCHEMA = "adaptfault.reproduce/1"
FIGURES = (2, 3, 4, 5, 6, 7)
_PACKAGES = ("adaptfault", "torch", "numpy", "scipy", "scikit-learn", "statsmodels")


def reproduce(
    recordings: Recordings,
    settings: Settings,
    folder: Path,
    *,
    figures: tuple[int, ...] = FIGURES,
    source: str = "simulated grasps",
    command: str = "",
    device: str = "cpu",
    progress: bool | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Path:
    """Measure, draw and write the page; return its path. A second run continues an interrupted one.

    Args:
        recordings: labelled and fault-free.
        settings: extent of the measurements.
        folder: of the run; created if missing.
        figures: numbers of the paper's figures, and 7 for its future work.
        source: name of the recordings, for the page.
        command: command line of the run, for the page.
        device: of training.
        progress: show or hide it on stderr; None shows it on a terminal.
        say: receives status messages, a line at a time.

    Raises:
        ValueError: no labels, or the folder holds a run with other settings or recordings.
    """
    from adaptfault.paper.page import write_page

    if recordings.labels is None:
        raise ValueError("the recordings have no labels: the experiments train a classifier")
    windows = make_windows(recordings.frames, recordings.labels, recordings.layout)
    config: dict[str, Any] = {
        "schema": SCHEMA,
        "recordings": source,
        "settings": settings.to_dict(),
    }
    config["windows"] = fingerprint_windows(windows)
    folder.mkdir(parents=True, exist_ok=True)
    _settle(folder / "config.json", config)
    versions = {name: version(name) for name in _PACKAGES} | {"python": platform.python_version()}
    about = {"schema": SCHEMA, "command": command, "versions": versions, "device": device}
    atomic_write(folder / "versions.json", json.dumps(about, indent=1).encode())
    setup = Setup(recordings, windows, settings, folder, device, progress, say)
    ledger = Ledger(folder / "results.jsonl")
    _measure(setup, ledger, figures)
    return write_page(setup, ledger, figures, {**config, **about})


def _settle(path: Path, config: dict[str, Any]) -> None:
    """Write the configuration; refuse a folder of another run."""
    config = json.loads(json.dumps(config))
    if path.exists():
        known = json.loads(path.read_text())
        if changed := sorted(k for k in {*known, *config} if known.get(k) != config.get(k)):
            raise ValueError(
                f"{path.parent} holds a run with other {', '.join(changed)}: give another --out"
            )
    else:
        atomic_write(path, json.dumps(config, indent=1).encode())


def _measure(setup: Setup, ledger: Ledger, figures: tuple[int, ...]) -> None:
    """Run the tasks that have no result yet."""
    present = int(setup.recordings.layout.present.sum())
    tasks = list(setup.settings.tasks(present, figures))
    left = [task for task in tasks if task not in ledger.results]
    if len(left) < len(tasks):
        setup.say(f"{len(tasks) - len(left)} of {len(tasks)} results are there already")
    hide = None if setup.progress is None else not setup.progress
    benches: dict[int, Bench] = {}
    with tqdm(total=len(tasks), initial=len(tasks) - len(left), unit="result", disable=hide) as bar:
        for task in left:
            if task.seed not in benches:
                benches[task.seed] = Bench(setup, task.seed)
            bench = benches[task.seed]
            began = time.perf_counter()
            predicted = bench.predict(task)
            result = Result.of(task, bench.test, predicted, time.perf_counter() - began)
            ledger.add(result)
            bar.update()
            setup.say(
                f"{task.strategy}, {task.k} {task.faults}, seed {task.seed}: accuracy"
                f" {result.accuracy:.3f}"
            )
    ledger.arrange(setup.settings.tasks(present, FIGURES))
