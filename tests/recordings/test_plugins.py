"""Somebody's own format and command are parts of the program through entry points."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from adaptfault import cli
from adaptfault.data.recordings import readers

ROOT = Path(__file__).parents[2]

# the one on the page for contributors
READER = (ROOT / "CONTRIBUTING.md").read_text().split("```python\n")[1].split("```")[0]

COMMAND = """
def add(commands):
    parser = commands.add_parser("greet", help="say hello")
    parser.set_defaults(run=run)


def run(args):
    print("hello")
    return 0
"""


@pytest.fixture
def installed(tmp_path):
    """A package as pip installs it, on the path of a new process."""
    site = tmp_path / "site"
    package = site / "mine"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "my_reader.py").write_text(READER)
    (package / "my_command.py").write_text(COMMAND)
    about = site / "mine-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        "[adaptfault.readers]\nraw10 = mine.my_reader\n"
        "[adaptfault.commands]\ngreet = mine.my_command\n"
    )
    return {**os.environ, "PYTHONPATH": f"{site}:{ROOT}"}


def run(environment, *arguments):
    command = [sys.executable, "-m", "adaptfault", *map(str, arguments)]
    return subprocess.run(command, env=environment, capture_output=True, text=True)


def test_a_format_of_another_package_is_read_by_every_command(installed, tmp_path):
    rng = np.random.default_rng(0)
    folder = tmp_path / "today"
    folder.mkdir()
    for i in range(3):
        rng.integers(0, 1000, (40, 10)).astype("<u2").tofile(folder / f"{i}.raw10")
    told = run(installed, "info", folder)
    assert told.returncode == 0, told.stderr
    assert "3 of 40 frames each" in told.stdout
    assert "0..1023 count, 50 Hz" in told.stdout
    written = run(installed, "convert", folder, "--out", tmp_path / "today.npz")
    assert written.returncode == 0, written.stderr


def test_a_command_of_another_package_is_one_of_the_program(installed):
    assert run(installed, "greet").stdout == "hello\n"
    assert "say hello" in run(installed, "--help").stdout


def test_the_parts_of_this_package_are_registered_as_those_of_others():
    tomllib = pytest.importorskip("tomllib")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    registered = project["entry-points"]
    assert registered[readers.GROUP] == readers.BUILT_IN
    assert registered[cli.GROUP] == cli.BUILT_IN
