"""Every example runs as its first line says."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

LESS = {"fleet_scaling.py": ["--robots", "4", "--batch", "2", "--adapted", "1"]}  # it takes minutes
EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.name)
def test_the_example_runs(example: Path, tmp_path: Path):
    environment = {**os.environ, "PYTHONWARNINGS": "error"}
    command = [sys.executable, str(example), *LESS.get(example.name, [])]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
