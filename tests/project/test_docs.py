"""Blocks of Python and commands in the README and on the pages of docs/ run, and what the pages
name exists."""

import inspect
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from _pytest.mark import ParameterSet
from conftest import without_export, write_forces, write_keys

import adaptfault as af
from adaptfault.bundle.bundle import Bundle
from adaptfault.cli import BUILT_IN, main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.data.recordings.facts.layout_file import read_layout
from adaptfault.data.recordings.formats import npz
from adaptfault.fleet import listing
from diagnostics import FaultSet, SensorLayout, inject

HOME = Path(__file__).parents[2]
GUIDES = [
    HOME / "README.md",
    *sorted((HOME / "docs").glob("*.md")),
    *sorted((HOME / "docs" / "methods").glob("*.md")),
]
PAGES = [*GUIDES, *sorted((HOME / "examples" / "compare").glob("*.md"))]
WITH_PYTHON = [page for page in PAGES if "```python" in page.read_text()]
NOT_RUN = {"reproduce": "test_paper.py runs it, small"}
# make test-all runs these, by the language of their blocks.
SLOW = {
    "": ("README.md", "maintenance.md", "sensor.md", "security.md"),
    "python": ("robot-software.md", "diagnosis.md", "test-bench.md"),
}
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
    return [
        shlex.split(line, comments=True)[1:] for line in lines if line.startswith("adaptfault ")
    ]


def marked(pages: list[Path], language: str) -> list[ParameterSet]:
    slow = dict.fromkeys(SLOW[language], pytest.mark.slow)
    return [pytest.param(page, marks=slow.get(page.name, ()), id=page.name) for page in pages]


@pytest.fixture(scope="module")
def prepared(made_bundle, small_grasps, later_grasps, broken_row, tmp_path_factory) -> Path:
    """A folder that has all that the pages speak of, in a small version."""
    home = tmp_path_factory.mktemp("docs")
    layout = small_grasps.layout
    broken = Recordings(tuple(inject(r, [broken_row], layout) for r in later_grasps), layout)
    grasps = small_grasps.select(range(0, len(small_grasps), 2))
    for name, recordings in {"grasps": grasps, "today": broken, "recordings": broken}.items():
        (home / name).mkdir()
        save_npz(home / name / f"{name}.npz", recordings)
    save_npz(home / "grasps.npz", grasps)
    held = [f for f, label in zip(small_grasps.frames, small_grasps.labels, strict=True) if label]
    write_forces(home / "force", held[::3])
    shutil.copytree(made_bundle, home / "robot.bundle")
    adapter = Bundle.open(home / "robot.bundle").parts.adapter()
    af.save_model(home / "model", adapter.model)
    adapter.adapt(FaultSet((1, 2), layout.n_cells), method="fill").save(home / "adapted")
    (home / "FLEET.toml").write_text(
        '[[robots]]\nname = "a"\nbundle = "robot.bundle"\nrecordings = "recordings"\n'
    )
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
    given = {
        "af": af,
        "diagnoser": diagnoser,
        "frames": frames,
        "frame": frames[0],
        "recordings": later_grasps,
    }
    given["healthy"] = later_grasps
    found = blocks(page, "python")
    assert len(found) == page.read_text().count("```python") > 0
    for code in found:
        exec(compile(code, page.name, "exec"), given)


@pytest.mark.parametrize("page", marked([page for page in PAGES if commands(page)], ""))
def test_the_commands_on_a_page_run(page, place, capsys):
    if page.name == "security.md":
        pytest.importorskip("cryptography")
        private, public = write_keys(Path(), "key")
        private.rename("private.pem")
        public.rename("public.pem")
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
    known = set(BUILT_IN)
    for page in PAGES:
        for code in re.findall(r"`+([^`]*)`+", page.read_text()):
            for command, rest in re.findall(
                r"^adaptfault (\w[\w-]*(?: maintain| survival)?)(.*)$", code, re.MULTILINE
            ):
                assert command.split()[0] in known, f"{page.name}: {code}"
                with pytest.raises(SystemExit):
                    main([*command.split(), "--help"])
                options = capsys.readouterr().out
                for option in re.findall(r"(?<!\S)\[?(--[a-z-]+)", rest.partition("#")[0]):
                    assert option in options, f"{page.name}: {code}: no option {option}"


def test_scripts_and_targets_that_the_pages_name_exist():
    makefile = (HOME / "Makefile").read_text()
    for page in [*PAGES, HOME / "CONTRIBUTING.md"]:
        text = page.read_text()
        for path, rest in re.findall(r"((?:examples|benchmarks|docs)/\w+\.py)([^`\n]*)", text):
            source = (HOME / path).read_text()
            for option in re.findall(r"--[a-z-]+", rest):
                assert f'"{option}"' in source, f"{page.name}: {path} has no option {option}"
        for target in re.findall(r"`make ([a-z-]+)`|^make ([a-z-]+)", text, re.MULTILINE):
            assert f"\n{''.join(target)}:" in makefile, f"{page.name}: make {''.join(target)}"


def test_benchmark_rows_and_arrays_that_the_results_name_exist():
    rows = re.findall(
        r"^def (\w+)\(bench: Bench\)", (HOME / "benchmarks" / "rows.py").read_text(), re.MULTILINE
    )
    sources = "".join(
        (HOME / "benchmarks" / f"{name}.py").read_text()
        for name in ("gestures", "static_holds", "other_sensors")
    )
    results = (HOME / "docs" / "results.md").read_text()
    named = [
        row
        for cell in re.findall(r"`([a-z_ ]+)` \|$", results, re.MULTILINE)
        for row in cell.split()
    ]
    assert named
    assert set(named) <= set(rows)
    skins = re.findall(
        r"^\| (?:drift: |fabric, |posture, )?([^|]+?) \| \d",
        (HOME / "docs" / "results-arrays.md").read_text(),
        re.MULTILINE,
    )
    assert skins
    arrays = (HOME / "benchmarks" / "arrays.py").read_text()
    assert [skin for skin in skins if f'"{skin}"' not in sources + arrays] == []


def test_the_tables_of_the_result_pages_are_what_was_measured(monkeypatch):
    monkeypatch.syspath_prepend(HOME / "benchmarks")
    import pages

    measured = pages.Measured.read()
    texts = [page.read_text() for page in pages.with_tables()]
    named = pages.BLOCK.findall("".join(texts))
    assert sorted(named) == sorted(pages.TABLES)
    for text in texts:
        assert pages.written(text, measured) == text


def test_a_figure_without_counts_is_deleted_once_it_is_measured(monkeypatch):
    monkeypatch.syspath_prepend(HOME / "benchmarks")
    import pages

    count = {"array": "hand", "split": 0, "repeat": 0, "logs": 9, "row": "16 % dead: recall"}
    count |= {"part": 1, "of": 4, "unit": "", "higher": True}
    figures = [
        {"array": "hand", "row": row, "value": 0.5, "before": False, "from": "a run"}
        for row in ("16 % dead: recall", "40 % dead: recall")
    ]
    measured = pages.Measured([count], figures)
    assert measured.value("hand", "16 % dead: recall") == 0.5
    assert measured.left() == figures[1:]
    table = pages.drawn(pages.hand(measured)).splitlines()
    assert table[0] == "|  | split 0 | since, split 0 | ROW |"
    assert table[2] == "| recall | 0.250 | 0.500 | `cells` |"
    assert pages.drawn(pages.hand(pages.Measured([count], []))).count("since") == 0


def test_a_table_of_other_figures_has_their_rows_and_columns(monkeypatch):
    monkeypatch.syspath_prepend(HOME / "benchmarks")
    import pages

    others = [
        {"row": "fill", "column": "10 %", "value": 0.68, "spread": 0.019},
        {"row": "head", "column": "10 %", "value": 0.9, "best": 0.85, "by": "T"},
        {"row": "head", "column": "time", "value": 7.0, "unit": "s"},
    ]
    others = [{"table": "repaired", **figure} for figure in others]
    assert pages.TABLES["repaired"](pages.Measured([], [], others)) == [
        ["", "10 %", "time"],
        ["fill", "0.680 ± 0.019", "-"],
        ["head", "0.900 / 0.850 T", "7 s"],
    ]


def test_the_page_of_formats_names_every_key_and_field_that_is_read(tmp_path):
    page = HOME / "docs" / "file-formats.md"
    layout_fields = {f.name for f in fields(SensorLayout)} | {"schema"}
    beside = [*re.findall(r'beside\.get\("(\w+)"', inspect.getsource(npz)), *npz._RATES]
    assert len(beside) >= 6
    read = {*npz._KEYS, *beside, *layout_fields, *listing._ENTRY, *listing._LISTING} - {"robots"}
    assert (
        sorted(
            name
            for name in read
            if not re.search(rf"`{name}`|^{name} = ", page.read_text(), re.MULTILINE)
        )
        == []
    )
    (entries, pattern), (_, layout) = blocks(page, "toml"), blocks(page, "json")
    (tmp_path / "f.toml").write_text(entries)
    assert listing.Fleet.read(tmp_path / "f.toml").robots[0].commissioned == "2025-03-01"
    (tmp_path / "robots" / "r7" / "robot.bundle").mkdir(parents=True)
    (tmp_path / "f.toml").write_text(pattern)
    (robot,) = listing.Fleet.read(tmp_path / "f.toml").robots
    assert (robot.name, robot.recordings) == (
        "r7",
        (str(tmp_path / "robots" / "r7" / "recordings" / "r7"),),
    )
    (tmp_path / "layout.json").write_text(layout)
    assert str(read_layout(tmp_path / "layout.json")) == "1 x 6 x 9 cells, 0..3.3 V, 100 Hz"


@pytest.mark.parametrize(
    "page", [*PAGES, HOME / "CONTRIBUTING.md", HOME / "CHANGELOG.md"], ids=lambda page: page.name
)
def test_files_that_a_page_names_exist(page):
    places = [page.parent, HOME, HOME / "diagnostics", HOME / "diagnostics" / "decision"]
    text = page.read_text()
    named = re.findall(r"`((?:\w+/)*\w+\.py)`", text) if page.name != "CHANGELOG.md" else []
    linked = [
        link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link
    ]
    missing = [
        name
        for name in [*named, *filter(None, linked)]
        if not any((place / name).exists() for place in places)
    ]
    assert missing == []


@pytest.mark.parametrize(
    "page", sorted((HOME / "docs" / "methods").glob("*.md")), ids=lambda page: page.stem
)
def test_a_method_page_has_formula_figure_cost_and_limits(page):
    text = page.read_text()
    assert blocks(page, "text")
    assert "\n## When to use it\n" in text or page.stem == "evidence"
    assert "\n## What it costs\n" in text
    assert re.search(r"\n## What it does not (detect|do)\n", text)
    for picture in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text):
        assert (page.parent / picture).stat().st_size < 100_000


OWN_WORDS = (
    r"vouch|convict|witness|boil|tare\b|twin|\brim\b|\btouch(?:es)?\b|unrest|told from|takes? its"
    r" word|knows"
)


@pytest.mark.parametrize(
    "page", [*GUIDES, HOME / "CONTRIBUTING.md", HOME / "CHANGELOG.md"], ids=lambda page: page.name
)
def test_a_page_uses_the_terms_of_the_glossary(page):
    text = re.sub(r"```.*?```|`[^`]*`|TOUCH-\w+", "", page.read_text(), flags=re.DOTALL)
    assert re.findall(OWN_WORDS, text, re.IGNORECASE) == []


@pytest.mark.slow
def test_the_script_draws_the_figures_of_the_method_pages(tmp_path):
    script = HOME / "docs" / "figures.py"
    subprocess.run(
        [sys.executable, script, "--out", tmp_path],
        check=True,
        env={**os.environ, "PYTHONWARNINGS": "error"},
    )
    committed = {path.name for path in (HOME / "docs" / "figures").glob("*.png")}
    assert {path.name for path in tmp_path.glob("*.png")} == committed


def test_the_page_of_codes_is_written_from_their_registry(monkeypatch):
    monkeypatch.syspath_prepend(HOME / "docs")
    import codes_page

    assert codes_page.PAGE.read_text() == codes_page.page()
