"""What a check tells as linters do: levels, formats, and which findings fail it."""

import re
from urllib.parse import unquote

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptfault.inspection.code import LEVELS
from adaptfault.inspection.code_list import CODES
from adaptfault.inspection.findings import FailOn, Findings, Unchecked, level_of
from adaptfault.inspection.result import Finding
from adaptfault.inspection.severity import NAMES, of_finding
from diagnostics import Fault, FaultKind, SensorLayout
from diagnostics.decision.numbering import Numbering

LAYOUT = SensorLayout(1, 3, 4, full_scale=1.0, unit="V", rate=50.0)
AS_COUNTED = Numbering()

texts = st.text(st.characters(exclude_categories=["Cs"]), min_size=1)
faults = st.builds(Fault, st.sampled_from(FaultKind), st.just((3,)))
of_faults = st.builds(Finding, st.just("fault"), st.integers(1, 2), texts, faults)
of_names = st.builds(
    lambda name, text: Finding(name, of_finding(name), text),
    st.sampled_from(NAMES),
    texts,
)
several = st.lists(st.one_of(of_faults, of_names), max_size=5)
chosen = st.lists(
    st.sampled_from([*LEVELS, "never", *map(str, CODES), "TOUCH-1", "touch-10", "stuck"]),
    min_size=1,
    max_size=3,
)


def findings(found: list[Finding], *unchecked: str) -> Findings:
    left = tuple(Unchecked(text) for text in unchecked)
    return Findings(tuple(found), left, LAYOUT, "a set: 100%, really")


def names(finding: Finding, part: str) -> bool:
    """Whether a part of --fail-on names a finding."""
    if part in LEVELS:
        return finding.severity >= LEVELS.index(part)
    by_begin = part.upper().startswith("TOUCH-") and str(finding.code).startswith(part.upper())
    return by_begin or finding.code.name == part


@given(several, chosen)
def test_a_check_fails_where_a_finding_is_named_or_something_was_not_checked(found, parts):
    fails = FailOn.parse(",".join(parts))
    failing = [
        one
        for one in found
        if any(names(one, part) for part in parts) or one.name in ("untested", "unread")
    ]
    code = findings(found).failed(fails)
    assert code == max((max(one.severity, 1) for one in failing), default=0)
    assert (code == 0) == (not failing)


def test_what_was_declared_harmless_does_not_fail():
    untested = Finding("untested", 0, "only 3% of the cells were tested")
    assert findings([untested]).failed(FailOn.parse("never")) == 0
    assert findings([untested]).failed(FailOn.parse("untested")) == 1


@pytest.mark.parametrize("text", ["", "fatal", "TOUCH-9", "error;warning"])
def test_what_names_no_finding_is_refused(text):
    with pytest.raises(ValueError, match="is no code"):
        FailOn.parse(text)


@given(several, texts)
def test_an_annotation_is_one_line_that_holds_the_whole_message(found, left):
    lines = findings(found, left).github(AS_COUNTED).split("\n")
    assert len(lines) == len(found) + 1
    for one, line in zip(found, lines, strict=False):
        level, about, message = re.fullmatch(r"::(\w+) ([^:]*)::(.*)", line, re.DOTALL).groups()
        assert level == level_of(one)
        assert unquote(message) == unquote(one.reason.replace("%", "%25"))
        title, file = about.split(",")
        assert title == f"title={one.code} {one.code.name}"
        assert unquote(file) == "file=a set: 100%, really"
    assert lines[-1].startswith("::notice title=not checked::")


@given(several, texts)
def test_a_row_of_the_card_has_three_cells_whatever_a_message_holds(found, left):
    lines = findings(found, left).markdown(AS_COUNTED).split("\n")
    rows = [line for line in lines if line.startswith("| TOUCH-")]
    assert len(rows) == len(found)
    for row in rows:
        assert len(re.findall(r"(?<!\\)\|", row)) == 4
    assert "Not checked:" in lines


def test_the_findings_are_a_sequence_with_their_codes():
    stuck = Finding("fault", 1, "cell 3 is stuck", Fault("stuck", (3,)))
    wire = Finding("wire", 2, "a row is open", Fault("open", (4, 5)))
    found = findings([stuck, wire, stuck], "5 cells")
    assert found[0] is stuck
    assert list(found[1:]) == [wire, stuck]
    assert (len(found), found.codes, found.severity) == (3, ("TOUCH-101", "TOUCH-103"), 2)
    assert found.summary() == "1 error, 2 warnings, 1 not checked"
    assert str(found).splitlines()[0] == "warning: TOUCH-103 cell 3 is stuck"
    assert repr(found) == "<Findings: warning: TOUCH-103 cell 3 is stuck>"
    assert findings([]).summary() == "no finding"


def test_a_finding_that_was_stored_without_its_fault_has_a_code():
    assert str(Finding("fault", 1, "").code) == "TOUCH-100"
    assert str(Finding("wire", 2, "").code) == "TOUCH-119"
