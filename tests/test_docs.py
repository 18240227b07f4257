"""What the README and the pages of docs/ show is run: blocks of Python, and commands."""

import re
import shlex
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from _pytest.mark import ParameterSet
from conftest import without_export

import adaptfault as af
from adaptfault.cli import COMMANDS, main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.robot.bundle import Bundle
from diagnostics import FaultSet, inject

HOME = Path(__file__).parents[1]
PAGES = [HOME / "README.md", *sorted((HOME / "docs").glob("*.md"))]
WITH_PYTHON = [page for page in PAGES if "```python" in page.read_text()]
NOT_RUN = {"reproduce": "test_paper.py runs it, small"}
# make test-all runs these, by the language of their blocks.
SLOW = {"": ("README.md", "maintenance.md"), "python": ("robot-software.md",)}
QUICK = {
    "train": ["--epochs", "1"],
    "demo": ["--epochs", "1"],
    "listen": ["--port", "0", "--seconds", "0.2"],
    "fleet": ["--jobs", "1"],
}


def blocks(page: Path, language: str) -> list[str]:
    fenced = re.findall(r"^```(\S*)\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)
    return [text for name, text in fenced if name == language]


def commands(page: Path) -> list[list[str]]:
    lines = "".join(blocks(page, "")).splitlines()
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("adaptfault ")]


def marked(pages: list[Path], language: str) -> list[ParameterSet]:
    slow = dict.fromkeys(SLOW[language], pytest.mark.slow)
    return [pytest.param(page, marks=slow.get(page.name, ()), id=page.name) for page in pages]


@pytest.fixture(scope="module")
def prepared(made_bundle, small_grasps, later_grasps, broken_row, tmp_path_factory) -> Path:
    """A folder that has all that the pages speak of, in a small version."""
    home, layout = tmp_path_factory.mktemp("docs"), small_grasps.layout
    broken = Recordings(tuple(inject(r, [broken_row], layout) for r in later_grasps), layout)
    for name, recordings in {"grasps": small_grasps, "today": broken, "recordings": broken}.items():
        (home / name).mkdir()
        save_npz(home / name / f"{name}.npz", recordings)
    save_npz(home / "grasps.npz", small_grasps)
    shutil.copytree(made_bundle, home / "robot.bundle")
    adapter = Bundle.open(home / "robot.bundle").parts.adapter()
    af.save_model(home / "model", adapter.model)
    adapter.adapt(FaultSet((1, 2), layout.n_cells), method="fill").save(home / "adapted")
    (home / "FLEET.toml").write_text('[[robots]]\nname = "a"\nbundle = "robot.bundle"\nrecordings = "recordings"\n')
    return home


@pytest.fixture
def place(prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of it, as the working directory."""
    place = tmp_path / "place"
    shutil.copytree(prepared, place)
    monkeypatch.chdir(place)
    monkeypatch.setattr(af, "train", partial(af.train, epochs=1, progress=False))
    with without_export():
        yield place


@pytest.mark.parametrize("page", marked(WITH_PYTHON, "python"))
def test_the_python_on_a_page_runs(page, place, later_grasps, capsys):
    diagnoser = Bundle.open("robot.bundle").diagnoser()
    frames = np.concatenate(later_grasps)
    given = {"af": af, "diagnoser": diagnoser, "frames": frames, "frame": frames[0], "recordings": later_grasps}
    for code in blocks(page, "python"):
        exec(compile(code, page.name, "exec"), given)


@pytest.mark.parametrize("page", marked([page for page in PAGES if commands(page)], ""))
def test_the_commands_on_a_page_run(page, place, capsys):
    for command, *arguments in commands(page):
        if command in NOT_RUN:
            continue
        if command == "train" and Path("robot.bundle").exists():
            shutil.rmtree("robot.bundle")
        if command == "rollback" and len(Bundle.open("robot.bundle").versions.numbers) < 2:
            continue  # nothing was better than what runs
        code = main([command, *arguments, *QUICK.get(command, [])])
        assert code in (0, 1, 2), f"{command} {arguments}: {capsys.readouterr().err}"


def test_options_that_the_pages_name_exist(capsys):
    known = {module.__name__.rpartition(".")[2] for module in COMMANDS}
    for page in PAGES:
        for code in re.findall(r"`+([^`]*)`+", page.read_text()):
            for command, rest in re.findall(r"^adaptfault (\w+(?: maintain)?)(.*)$", code, re.MULTILINE):
                assert command.split()[0] in known, f"{page.name}: {code}"
                with pytest.raises(SystemExit):
                    main([*command.split(), "--help"])
                options = capsys.readouterr().out
                for option in re.findall(r"(?<!\S)\[?(--[a-z-]+)", rest.partition("#")[0]):
                    assert option in options, f"{page.name}: {code}: no option {option}"


def test_examples_and_targets_that_the_pages_name_exist():
    makefile = (HOME / "Makefile").read_text()
    for page in [*PAGES, HOME / "CONTRIBUTING.md"]:
        text = page.read_text()
        for path, rest in re.findall(r"(examples/\w+\.py)([^`\n]*)", text):
            source = (HOME / path).read_text()
            for option in re.findall(r"--[a-z-]+", rest):
                assert f'"{option}"' in source, f"{page.name}: {path} has no option {option}"
        for target in re.findall(r"`make ([a-z-]+)`|^make ([a-z-]+)", text, re.MULTILINE):
            assert f"\n{''.join(target)}:" in makefile, f"{page.name}: make {''.join(target)}"
