"""Somebody who checks types gets them."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
HOME = HERE.parents[1]
GIVEN = """\
import adaptfault as af
import numpy as np
from diagnostics import SelfDiagnosis
from numpy.typing import NDArray

diagnoser = SelfDiagnosis.load("healthy.npz")
frames: NDArray[np.float64] = np.zeros((100, 220))
frame = frames[0]
recordings = [frames]

"""
"""What the pages take for granted."""


def checked(program: Path, folder: Path, *options: str) -> str:
    """Return what mypy says of a program, "" where all is well."""
    command = [sys.executable, "-m", "mypy", "--strict", *options]
    done = subprocess.run(
        [*command, "--cache-dir", str(folder / "cache"), str(program)],
        cwd=HOME,
        capture_output=True,
        text=True,
    )
    return done.stdout if done.returncode else ""


@pytest.mark.slow
def test_a_program_of_a_user_has_strict_types(tmp_path):
    assert checked(HERE / "user_program.py", tmp_path) == ""


@pytest.mark.slow
def test_the_python_on_every_page_has_strict_types(tmp_path):
    programs = tmp_path / "pages"
    programs.mkdir()
    pages = [HOME / "README.md", *(HOME / "docs").rglob("*.md")]
    for page in pages:
        text = page.read_text()
        blocks = re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
        if blocks:
            program = programs / f"{page.stem.replace('-', '_')}_{page.parent.name}.py"
            program.write_text(GIVEN + "\n".join(blocks))
    assert len(list(programs.iterdir())) > 10
    # what somebody writes for a bench needs no types of its own
    assert checked(programs, tmp_path, "--allow-untyped-defs", "--allow-untyped-calls") == ""
