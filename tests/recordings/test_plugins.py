"""Somebody's own format and command are parts of the program through entry points."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import adaptfault
from adaptfault import cli
from adaptfault.data.plugins import APART
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


def projects():
    tomllib = pytest.importorskip("tomllib")
    paths = [ROOT / "pyproject.toml", *sorted(ROOT.glob("packages/*/pyproject.toml"))]
    return [tomllib.loads(path.read_text())["project"] for path in paths]


@pytest.mark.parametrize("part", [readers, cli], ids=["readers", "commands"])
def test_the_parts_of_the_repository_are_registered_as_those_of_others(part):
    registered = {}
    for project in projects():
        registered |= project.get("entry-points", {}).get(part.GROUP, {})
    assert registered == part.BUILT_IN


def test_the_packages_of_the_repository_are_of_one_version():
    core, *others = projects()
    assert core["version"] == adaptfault.__version__
    ours = {f"{project['name']}=={core['version']}" for project in (core, *others)}
    for project in others:
        assert project["version"] == core["version"]
        assert project["dependencies"][0] == f"adaptfault=={core['version']}"
        own = {one for one in project["dependencies"] if "adaptfault" in one}
        assert own <= ours
    assert set(APART.values()) <= {project["name"] for project in others}


class NotInstalled:
    def find_spec(self, name, path=None, target=None):
        if name in APART:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


@pytest.fixture
def core_alone(monkeypatch):
    for name in list(sys.modules):
        if name.startswith(tuple(APART)):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [NotInstalled(), *sys.meta_path])


@pytest.mark.parametrize(
    ("arguments", "package"),
    [
        (["listen", "--port", "5", "--", "x"], "adaptfault-station"),
        (["reproduce", "--quick", "--help"], "adaptfault-paper"),
        (["fleet", "survival", "FLEET.toml"], "adaptfault-fleet"),
    ],
    ids=["listen", "reproduce", "fleet survival"],
)
def test_a_command_of_a_package_that_is_not_installed_says_what_to_install(
    core_alone, tmp_path, monkeypatch, capsys, arguments, package
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "FLEET.toml").write_text(
        '[[robots]]\nname = "a"\nbundle = "a.bundle"\nrecordings = "a"\n'
    )
    assert cli.main(arguments) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        f"adaptfault {arguments[0]}: error: this needs {package}, which is not installed:"
        f" pip install {package}"
    )


def test_a_name_of_a_package_that_is_not_installed_says_what_to_install(core_alone):
    with pytest.raises(ImportError, match="pip install adaptfault-station"):
        getattr(adaptfault, "Station")  # noqa: B009
    assert all(hasattr(adaptfault, name) for name in adaptfault.__all__)
