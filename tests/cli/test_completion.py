"""A shell completes commands, options, choices and paths."""

import os
import shutil
import subprocess
import sys

import pytest

from adaptfault.cli import BUILT_IN
from adaptfault.cli.completion import parser

shtab = pytest.importorskip("shtab")

SHELLS = [shell for shell in ("bash", "zsh", "fish") if shell in shtab.SUPPORTED_SHELLS]


@pytest.fixture(scope="module")
def written():
    """What is written for each shell."""
    return {shell: shtab.complete(parser(), shell) for shell in SHELLS}


@pytest.mark.parametrize("shell", SHELLS)
def test_what_is_written_knows_all_commands_and_is_of_the_shell(shell, written, tmp_path):
    for command in BUILT_IN:
        assert command in written[shell]
    path = tmp_path / "completion"
    path.write_text(written[shell])
    if shutil.which(shell):
        assert subprocess.run([shell, "-n", path], check=False).returncode == 0


def completed(script, *words):
    """Return what bash offers for the last word."""
    code = f"""source {script}
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _shtab_adaptfault "$1" "${{@: -1}}" "${{@: -2:1}}"
printf '%s\\n' "${{COMPREPLY[@]}}" """
    asked = ["bash", "-c", code, "bash", *words]
    return subprocess.run(asked, check=True, capture_output=True, text=True).stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_options_choices_and_paths(written, tmp_path, monkeypatch):
    script = tmp_path / "completion.bash"
    script.write_text(written["bash"])
    (tmp_path / "grasps.npz").touch()
    monkeypatch.chdir(tmp_path)
    assert completed(script, "adaptfault", "dia") == ["diagnose"]
    assert "--write-valid" in completed(script, "adaptfault", "check", "--wr")
    assert completed(script, "adaptfault", "check", "--format", "git") == ["github"]
    assert completed(script, "adaptfault", "info", "gra") == ["grasps.npz"]
    assert completed(script, "adaptfault", "diagnose", "--reference", "gra") == ["grasps.npz"]


def test_the_line_of_the_page_writes_it(written):
    line = ["-m", "shtab", "--shell", "bash", "adaptfault.cli.completion.parser"]
    found = subprocess.run(
        [sys.executable, *line], check=True, capture_output=True, text=True, env={**os.environ}
    )
    assert "complete -" in found.stdout
    assert "--write-valid" in found.stdout
