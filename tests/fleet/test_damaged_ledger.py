"""A ledger or a list of a fleet that somebody damaged is one line that names it."""

import json

import pytest

from adaptfault.data.json_lines import Lines
from adaptfault.fleet.listing import Fleet, Robot
from adaptfault.fleet.outcome import Cause, Outcome
from adaptfault.fleet.run import LEDGER, SCHEMA, _resumed
from adaptfault.robot.metrics import PadCells

ROBOT = Robot("a", "/a/robot.bundle", ("/a/log",), ("hall 3",), "2025-01-01")
OUTCOME = Outcome(
    ROBOT,
    "deployed",
    1,
    "better",
    *(2, 60, 3, "2 x 6 x 5", 0.5, 1),
    (Cause("short", None, None, 3),),
    ("note",),
    pads=(PadCells(3, 20),),
    coverage=0.5,
)
TIME = "2026-01-01T00:00:00+00:00"
HEAD = {"schema": SCHEMA, "options": {"dry_run": False}, "began": TIME}
ENTRY = {"time": TIME, "outcome": OUTCOME.to_dict()}

DAMAGED = {
    "no JSON": [b"{"],
    "no text": [b"\xff\xfe\x00"],
    "nested": [b"[" * 100_000],
    "a list": [[]],
    "no time": [{"outcome": ENTRY["outcome"]}],
    "a number as time": [{**ENTRY, "time": 3}],
    "no time at all": [{**ENTRY, "time": "yesterday"}],
    "a time without its zone": [{**ENTRY, "time": "2026-01-01T00:00:00"}],
    "no outcome": [{"time": TIME}],
    "an empty outcome": [{"time": TIME, "outcome": {}}],
    **{
        f"{name} as {value!r}": [{**ENTRY, "outcome": {**ENTRY["outcome"], name: value}}]
        for name, value in [
            *[("robot", "a"), ("robot", {}), ("exit_code", "x"), ("exit_code", True)],
            *[("causes", 3), ("causes", [3]), ("notes", {}), ("pads", [{"pad": 1}])],
            *[("reason", None), ("accuracy", "high"), ("recordings", 1.5), ("version", [])],
        ]
    },
}


def ledger(folder, lines) -> Lines:
    raw = [line if isinstance(line, bytes) else json.dumps(line).encode() for line in lines]
    (folder / LEDGER).write_bytes(b"".join(line + b"\n" for line in raw))
    return Lines(folder / LEDGER)


def test_an_outcome_is_rebuilt_from_its_json():
    assert Outcome.from_dict(json.loads(json.dumps(OUTCOME.to_dict()))) == OUTCOME


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_line_is_named_with_its_number(tmp_path, name):
    lines = ledger(tmp_path, [HEAD, ENTRY, *DAMAGED[name]])
    with pytest.raises(ValueError, match=r"ledger\.jsonl, line 3: ") as told:
        _resumed(lines, Fleet((ROBOT,)), HEAD["options"])
    assert "remove" in str(told.value)
    assert len(str(told.value)) < 500


@pytest.mark.parametrize("name", ["schema", "options", "began"])
@pytest.mark.parametrize("value", [None, 3, [], "x"])
def test_a_damaged_first_line_is_named(tmp_path, name, value):
    lines = ledger(tmp_path, [{**HEAD, name: value}])
    with pytest.raises(ValueError, match=r"ledger\.jsonl, line 1: "):
        _resumed(lines, Fleet((ROBOT,)), HEAD["options"])


@pytest.mark.parametrize(
    "text", ["{bundle_dir.x}", "{name[0]}", "{name!r}", "{name:>9}", "{0}", "{}", "{", "{other}"]
)
def test_braces_hold_names_alone(tmp_path, text):
    (tmp_path / "a.bundle").mkdir()
    path = tmp_path / "fleet.toml"
    path.write_text(f'bundles = "*.bundle"\nrecordings = "{text}/today"\n')
    with pytest.raises(ValueError, match=r"expected only \{bundle_dir\} and \{name\} in braces"):
        Fleet.read(path)
