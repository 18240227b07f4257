"""Every example runs as its first line says, and on recordings where it takes some. ``make examples`` shows them."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from adaptfault.recordings import Recordings, save_npz

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
# What an example takes on recordings, as small as it goes.
ON_RECORDINGS = {
    "adaptation_figures.py": ["--epochs", "1", "--cases", "1", "--only", "fill"],
    "compare_diagnosis.py": ["--logs", "1"],
    "diagnosis_figures.py": ["1", "--only", "cells"],
    "esp32_sender.py": ["--frames", "20"],
    "simulated_vs_real.py": [],
    "wrong_fault_set.py": ["--draws", "1"],
}
LESS = {"fleet_scaling.py": ["--robots", "4", "--batch", "2", "--adapted", "1"]}  # it takes minutes
NEEDS = {"deploy_speed.py": "onnxruntime"}  # others do without, and say so


def run(example: Path, folder: Path, *arguments: str | Path) -> None:
    if (package := NEEDS.get(example.name)) and importlib.util.find_spec(package) is None:
        pytest.skip(f"{example.name} needs {package}")
    environment = {**os.environ, "PYTHONWARNINGS": "error"}
    command = [sys.executable, example, *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.name)
def test_the_example_runs(example: Path, tmp_path: Path):
    run(example, tmp_path, *LESS.get(example.name, []))


@pytest.mark.parametrize("name", ON_RECORDINGS)
def test_the_example_runs_on_recordings(name: str, small_grasps: Recordings, tmp_path: Path):
    save_npz(tmp_path / "grasps.npz", small_grasps)
    run(EXAMPLES[0].with_name(name), tmp_path, "grasps.npz", *ON_RECORDINGS[name])


def test_no_example_that_takes_recordings_is_left_out():
    takes = {path.name for path in EXAMPLES if 'argument("recording' in path.read_text() or "[REC" in path.read_text()}
    assert takes == set(ON_RECORDINGS)
