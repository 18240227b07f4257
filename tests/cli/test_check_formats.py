"""adaptfault check in CI: formats, what fails, what was not checked; adaptfault explain."""

import json
import shlex
import shutil
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml

from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.inspection.code_list import CODES
from adaptfault.schemas import SCHEMAS, schema_of
from diagnostics import Fault, SensorLayout, inject

LAYOUT = SensorLayout(1, 3, 4, full_scale=1.0, unit="V", rate=50.0)
HOOKS = Path(__file__).parents[2] / ".pre-commit-hooks.yaml"


@pytest.fixture
def data_set(tmp_path):
    """30 recordings; cell 7 is dead."""
    rng = np.random.default_rng(0)
    course = np.maximum(np.sin(np.linspace(-0.5, np.pi + 0.5, 60)), 0)[:, None]
    dead = Fault("short", (7,))
    frames = [
        inject(
            0.1 + course * rng.uniform(0.2, 0.8, 12) + rng.normal(0, 0.002, (60, 12)),
            [dead],
            LAYOUT,
        )
        for _ in range(30)
    ]
    folder = tmp_path / "set"
    folder.mkdir()
    save_npz(folder / "set.npz", Recordings(tuple(frames), LAYOUT))
    return folder


def check(folder, *options):
    return main(["check", str(folder), "--quiet", *options])


@pytest.mark.parametrize("options", [(), ("--healthy", "0:15"), ("--fail-on", "never")])
def test_what_is_printed_is_as_the_schema_says(data_set, options, capsys, tmp_path):
    (data_set / "broken.npz").write_bytes(b"PK")
    out = tmp_path / "out.json"
    assert check(data_set, "--format", "json", "--out", str(out), *options) == 1
    printed = json.loads(capsys.readouterr().out)
    assert json.loads(out.read_text()) == printed
    schema = schema_of(printed["schema"])
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(printed, schema, jsonschema.Draft202012Validator)
    assert [one["code"] for one in printed["findings"]] == ["TOUCH-102", "TOUCH-191"]
    assert printed["findings"][0]["cells"] == [7]
    compared = "--healthy" in options
    assert any("gain" in one["what"] for one in printed["not_checked"]) != compared


def test_each_form_tells_the_same_findings(data_set, capsys):
    said = {}
    for form in ("text", "github", "markdown", "json"):
        assert check(data_set, "--format", form, "--count-from", "1") == 1
        said[form] = capsys.readouterr().out
    for form, text in said.items():
        assert "TOUCH-102" in text, form
        assert "not checked" in text.lower() or "not_checked" in text, form
    assert "TOUCH-102 pad 1, row 2, column 4 is short" in said["text"]
    assert said["github"].startswith("::warning title=TOUCH-102 short,file=")
    assert "| TOUCH-102 | warning | pad 1, row 2, column 4 is short" in said["markdown"]
    for form in ("text", "github", "markdown"):
        assert "1 cell is faulty in every recording: train without its readings" in said[form]
        assert "the data set is its own reference" in said[form]


@pytest.mark.parametrize(
    ("what", "code"),
    [("error", 0), ("never", 0), ("TOUCH-103", 0), ("warning", 1), ("short", 1), ("TOUCH-1", 1)],
)
def test_only_what_is_named_fails(data_set, what, code, capsys):
    assert check(data_set, "--fail-on", what) == code
    assert "TOUCH-102" in capsys.readouterr().out


def test_what_names_no_finding_is_refused_before_anything_is_read(data_set, capsys):
    assert check(data_set, "--fail-on", "fatal") == 3
    assert "'fatal' is no code" in capsys.readouterr().err


def test_a_file_that_was_not_read_fails_whatever_was_chosen(data_set):
    (data_set / "broken.npz").write_bytes(b"PK")
    assert check(data_set, "--fail-on", "never") == 1


def test_every_code_and_every_schema_is_explained(capsys):
    assert main(["explain"]) == 0
    listed = capsys.readouterr().out
    for code in CODES:
        assert f"{code}  {code.name}" in listed
    assert main(["explain", "touch-103"]) == 0
    assert "TOUCH-103 stuck" in capsys.readouterr().out
    assert main(["explain", "--json", "stuck"]) == 0
    assert json.loads(capsys.readouterr().out)["code"] == "TOUCH-103"
    for name in SCHEMAS:
        assert main(["explain", name]) == 0
        assert json.loads(capsys.readouterr().out)["properties"]["schema"]["const"] == name
    assert main(["explain", "dead"]) == 3
    assert "is no code" in capsys.readouterr().err


def test_the_hook_checks_the_data_set_that_it_is_given(data_set, capsys):
    (hook,) = yaml.safe_load(HOOKS.read_text())
    program, *arguments = shlex.split(hook["entry"])
    assert program == "adaptfault"
    assert main([*arguments, str(data_set), "--fail-on", "error"]) == 0
    shutil.rmtree(data_set)
    assert main([*arguments, str(data_set), "--fail-on", "error"]) == 3
