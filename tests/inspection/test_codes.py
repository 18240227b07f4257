"""Codes of findings: one for each thing that is told, the same for ever, each with its limits."""

import pytest

from adaptfault.inspection.code_list import CODES
from adaptfault.inspection.codes import BY_CODE, code_of, unchecked
from adaptfault.inspection.severity import NAMES
from diagnostics import FaultKind

# Programs ask for them: a line may be added, none changed.
FROZEN = {
    100: "fault",
    101: "open",
    102: "short",
    103: "stuck",
    104: "alias",
    105: "intermittent",
    106: "noisy",
    107: "drift",
    108: "floating",
    109: "late",
    110: "copy",
    111: "clamped",
    112: "weak",
    119: "wire",
    120: "rewired",
    121: "transposed",
    122: "replaced_pad",
    123: "another_sensor",
    124: "gain",
    125: "offset",
    126: "ramp",
    127: "hum",
    128: "noise",
    129: "quantised",
    130: "saturated",
    131: "crosstalk",
    132: "normalised",
    133: "one_signal",
    134: "silent_array",
    135: "swapped_in_part",
    140: "frozen",
    141: "lost_frames",
    142: "repeated_frames",
    143: "corrupt_frame",
    144: "common_spike",
    145: "sentinel",
    146: "missing",
    147: "time_gaps",
    148: "clock_disorder",
    149: "jitter",
    160: "coincides",
    161: "static_load",
    162: "begins_in_contact",
    163: "tared_in_contact",
    164: "held_value",
    190: "untested",
    191: "unread",
}


def test_codes_never_change():
    assert {code.number: code.name for code in CODES} == FROZEN


def test_each_kind_of_fault_and_each_finding_has_one_code():
    assert sorted(code.name for code in CODES) == sorted([*map(str, FaultKind), *NAMES])


@pytest.mark.parametrize("code", CODES, ids=str)
def test_each_code_says_what_it_is_why_it_matters_and_what_is_not_found(code):
    for text in (code.what, code.why, code.limits, code.not_found):
        assert text.endswith("."), text
        assert text[0].isupper(), text
    told = code.text()
    assert told.startswith(f"TOUCH-{code.number} {code.name}\n")
    assert code.not_found in told


def test_a_code_is_found_by_its_number_and_by_what_it_tells():
    for code in CODES:
        for text in (str(code), str(code).lower(), f" {code.number} ", code.name):
            assert code_of(text) is code


@pytest.mark.parametrize("text", ["", "TOUCH-", "TOUCH-999", "dead", "1"])
def test_what_is_no_code_is_refused_with_what_is_one(text):
    with pytest.raises(ValueError, match=r"is no code; expected one of TOUCH-100 to TOUCH-191"):
        code_of(text)


def test_what_was_not_given_names_what_was_not_looked_for():
    everything = {code.needs for code in CODES} - {None}
    assert not unchecked(everything)
    left = unchecked({"classes", "times"})
    assert set(left) == {"reference"}
    assert BY_CODE["TOUCH-124"] in left["reference"]
    assert not any(code.needs for code in CODES if code.number < 120)
