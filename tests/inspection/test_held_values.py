"""A cell that holds one value through several recordings while others move is never ALIVE."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptfault.inspection.changed_readings import ChangedReadings
from adaptfault.inspection.held_values import HeldValues, with_held_values
from adaptfault.inspection.inspection import Inspection
from diagnostics import Diagnosis, Fault, SensorLayout, Verdict

LAYOUT = SensorLayout(1, 4, 5, full_scale=1.0, unit="V", rate=50.0)


def contacts(seed: int, n: int = 24, sign: int = 1) -> list[np.ndarray]:
    """Recordings of contacts that come and go anywhere; what they do not reach reads 0.5."""
    rng = np.random.default_rng(seed)
    places = np.argwhere(np.ones((4, 5)))
    found = []
    for _ in range(n):
        press = np.clip(1 - ((places - rng.uniform((0, 0), (3, 4))) ** 2).sum(axis=1) / 6, 0, None)
        course = np.clip(np.sin(np.linspace(-1, 3 * np.pi, 50)), 0, None)[:, None]
        found.append(0.5 + sign * 0.4 * rng.uniform(0.5, 1) * course * press)
    return found


def inspection(states: np.ndarray, *faults: Fault) -> Inspection:
    n = len(states)
    nothing = np.zeros(20)
    found = Diagnosis(LAYOUT, faults, nothing, nothing == 0, 50 * n, n, states=states)
    return Inspection(ChangedReadings(None, None, [], found), ())


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    sign=st.sampled_from([1, -1]),
    cell=st.integers(0, 19),
    share=st.floats(0.2, 0.8),
    value=st.floats(0.1, 0.35),
)
def test_a_cell_that_holds_a_value_in_some_recordings_is_suspect_there_alone(
    seed, sign, cell, share, value
):
    recordings = contacts(seed, sign=sign)
    healthy = HeldValues.of(recordings, LAYOUT)
    assert not healthy.suspect.any()
    broken = np.random.default_rng(seed).random(24) < share
    for i in np.flatnonzero(broken):
        recordings[i] = recordings[i].copy()
        recordings[i][:, cell] = 0.5 + sign * value
    held = HeldValues.of(recordings, LAYOUT)
    assert not np.delete(held.suspect, cell, axis=1).any()
    assert not held.suspect[~broken].any()
    beside = [one for one in LAYOUT.beside[cell] if one >= 0]
    moves = np.array([(np.ptp(one[:, beside], axis=0) > 0.1).sum() >= 2 for one in recordings])
    expected = broken & moves
    if expected.sum() >= 3 and share < 0.7:
        assert held.suspect[expected, cell].all()


def test_such_a_cell_is_told_and_neither_alive_nor_tested():
    recordings = contacts(0)
    for i in range(12, 24):
        recordings[i][:, 7] = 0.8
    states = np.full((24, 20), int(Verdict.ALIVE), np.uint8)
    found = with_held_values(inspection(states), recordings, LAYOUT)
    (told,) = found.findings
    assert (told.name, told.severity, str(told.code)) == ("held_value", 1, "TOUCH-164")
    assert told.reason.startswith("pad 0, row 1, column 2 holds the same value away from rest")
    diagnosis = found.diagnosis
    assert diagnosis.verdicts[7] == Verdict.UNTESTED
    assert np.delete(diagnosis.tested, 7).all()
    by_recording = diagnosis.by_recording.verdicts[:, 7]
    assert (by_recording[:12] == Verdict.ALIVE).all()
    assert Verdict.UNTESTED in by_recording[12:]


def test_a_cell_of_which_a_fault_is_known_is_not_told_twice():
    recordings = contacts(0)
    for one in recordings[12:]:
        one[:, 7] = 0.8
    states = np.full((24, 20), int(Verdict.ALIVE), np.uint8)
    known = inspection(states, Fault("stuck", (7,), onset=600))
    assert with_held_values(known, recordings, LAYOUT) is known


@pytest.mark.parametrize("value", [np.nan, 0.5])
def test_of_an_array_that_nothing_touches_nothing_is_told(value):
    recordings = [np.full((50, 20), value)] * 5
    assert not HeldValues.of(recordings, LAYOUT).suspect.any()
