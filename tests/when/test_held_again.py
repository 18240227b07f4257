"""A cell that holds one value through several recordings while others move is never ALIVE, whoever
is asked."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import adaptfault as af
from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.inspection.long_log import inspect_parts
from diagnostics import Diagnosis, Fault, SelfDiagnosis, SensorLayout, Verdict
from diagnostics.decision.by_recording import with_recordings
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.when import Spans, find_held
from diagnostics.when.held_again import held_again

LAYOUT = SensorLayout(1, 4, 5, full_scale=1.0, unit="V", rate=50.0)
BROKEN = slice(6, 12)  # recordings
HELD = 7  # cell


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


def again(recordings: list[np.ndarray]) -> np.ndarray:
    return held_again(Spans.of(RecordingBlocks(recordings)), LAYOUT)


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
    assert not again(recordings).any()
    broken = np.random.default_rng(seed).random(24) < share
    for i in np.flatnonzero(broken):
        recordings[i] = recordings[i].copy()
        recordings[i][:, cell] = 0.5 + sign * value
    suspect = again(recordings)
    assert not np.delete(suspect, cell, axis=1).any()
    assert not suspect[~broken].any()
    beside = [one for one in LAYOUT.beside[cell] if one >= 0]
    moves = np.array([(np.ptp(one[:, beside], axis=0) > 0.1).sum() >= 2 for one in recordings])
    expected = broken & moves
    if expected.sum() >= 3 and share < 0.7:
        assert suspect[expected, cell].all()


def test_what_differs_from_rest_by_the_noise_of_a_converter_is_no_held_value():
    rng = np.random.default_rng(0)
    counts = []
    for _ in range(24):
        frames = np.full((12, 20), 11.0) + rng.integers(-1, 2, 20)
        noisy = rng.random(20) < 0.5
        frames[:, noisy] += rng.integers(0, 2, (12, noisy.sum()))
        counts.append(frames)
    assert not again(counts).any()


@pytest.fixture(scope="module")
def log() -> list[np.ndarray]:
    """A dozen recordings, too few to be their own reference; a cell holds a value in the last."""
    recordings = [0.4 * (one - 0.5) for one in contacts(0, 12)]
    for one in recordings[BROKEN]:
        one[:, HELD] = 0.12
    return [one.astype(np.float32) for one in recordings]


def test_every_call_says_the_same(log):
    known = Recordings(tuple(log), LAYOUT)
    diagnosis = SelfDiagnosis(LAYOUT).diagnose(log)
    assert diagnosis.verdicts[HELD] == Verdict.UNTESTED
    (possible,) = diagnosis.possible
    assert (possible.cells, possible.kind) == ((HELD,), "stuck")
    assert possible.reason in str(diagnosis)
    of_cell = diagnosis.by_recording.verdicts[:, HELD]
    assert (of_cell == Verdict.UNTESTED).all()  # it follows the cells around it in a part only
    inspected = af.inspect(log, SelfDiagnosis(LAYOUT))
    parts = inspect_parts(iter([log[:7], log[7:]]), SelfDiagnosis(LAYOUT))
    cut = [log[0][:30], log[0][30:], *log[1:]]
    pieces = inspect_parts(
        iter([cut[:1], cut[1:]]), SelfDiagnosis(LAYOUT), lengths=list(map(len, log))
    )
    for told in (inspected, parts, pieces):
        assert (told.diagnosis.verdicts == diagnosis.verdicts).all()
        assert told.diagnosis.possible == diagnosis.possible
        assert [(one.name, one.severity) for one in told.findings] == [("held_value", 1)]
    with pytest.warns(UserWarning, match="TOUCH-164 pad 0, row 1, column 2 holds the same value"):
        assert af.guard(known).codes == ("TOUCH-164",)


@pytest.mark.parametrize("command", ["check", "diagnose"])
def test_every_command_says_the_same(command, log, tmp_path, capsys):
    save_npz(tmp_path / "log.npz", Recordings(tuple(log), LAYOUT))
    assert main([command, str(tmp_path / "log.npz"), "--no-cache", "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    diagnosis = Diagnosis.from_dict(told.get("inspection", {}).get("diagnosis", told))
    assert diagnosis.verdicts[HELD] == Verdict.UNTESTED
    assert diagnosis.possible[0].cells == (HELD,)


def test_a_cell_of_which_a_fault_is_known_is_not_told_twice(log):
    held = find_held(Spans.of(RecordingBlocks(log)), LAYOUT, 0.005)
    assert held.again.any()
    fault = Fault("stuck", (HELD,), onset=300)
    known = Diagnosis(LAYOUT, (fault,), np.zeros(20), np.ones(20, bool), 600, 12)
    assert with_recordings(known, held, [50] * 12, 0.005, None).possible == ()


@pytest.mark.parametrize("value", [np.nan, 0.5])
def test_of_an_array_that_nothing_touches_nothing_is_told(value):
    recordings = [np.full((50, 20), value)] * 5
    assert not again(recordings).any()
