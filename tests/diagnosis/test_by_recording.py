"""In which recordings a fault shows, with and without a reference."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptfault.data.recordings.valid import valid_masks
from adaptfault.data.simulated_grasps import simulate
from adaptfault.inspection.result import of_diagnosis
from diagnostics import Diagnosis, Fault, FaultKind, SelfDiagnosis, SensorLayout, Verdict
from diagnostics.decision.by_recording import with_recordings
from diagnostics.when import Held
from diagnostics.when.reference_findings import ReferenceWarning

LAYOUT = SensorLayout(1, 8, 8)
ROW = [LAYOUT.cell(0, 3, column) for column in range(8)]
STUCK = LAYOUT.cell(0, 5, 4)
DEAD = sorted([*ROW, STUCK])
MIDDLE = tuple(range(14, 28))


@pytest.fixture(scope="module")
def grasps() -> list[np.ndarray]:
    frames = simulate(6, LAYOUT, n_frames=50, seed=3).frames
    order = np.random.default_rng(0).permutation(len(frames))
    return [np.asarray(frames[i], dtype=np.float64) for i in order]


@pytest.fixture(scope="module")
def seated_again(grasps: list[np.ndarray]) -> list[np.ndarray]:
    """A row and a cell are dead in the middle third of the recordings."""
    log = [recording.copy() for recording in grasps]
    for i in MIDDLE:
        log[i][:, ROW] = 0.0
        log[i][:, STUCK] = 1.7
    return log


@pytest.fixture(scope="module")
def diagnosis(seated_again: list[np.ndarray]) -> Diagnosis:
    return SelfDiagnosis(LAYOUT).diagnose(seated_again)


def test_what_is_dead_for_some_recordings_and_works_again_is_found_with_them(diagnosis):
    assert diagnosis.fault_set == set(DEAD)
    assert diagnosis.exit_code == 2
    assert {fault.recordings for fault in diagnosis.faults} == {MIDDLE}
    assert all("in recordings 14 to 27; it works again" in f.reason for f in diagnosis.faults)


@given(
    cells=st.sampled_from([ROW, [STUCK], DEAD]),
    where=st.sets(st.integers(0, 19), min_size=1, max_size=19),
    evidence=st.floats(3, 20),
)
def test_whatever_is_suspect_is_faulty_or_told_as_possible_and_untested(cells, where, evidence):
    suspect = np.zeros((20, 64), bool)
    suspect[np.ix_(sorted(where), cells)] = True
    of_cells = np.where(suspect.any(axis=0), evidence, -np.inf)
    value = np.where(suspect.any(axis=0), 0.0, np.nan)
    again = np.zeros_like(suspect)
    held = Held(of_cells, suspect, ~suspect, value, again, np.full(suspect.shape[1], np.nan))
    whole = Diagnosis(LAYOUT, (), np.zeros(64), np.ones(64, bool), 1000, n_recordings=20)
    told = with_recordings(whole, held, [50] * 20, 0.01, None)
    possible = {cell for fault in told.possible for cell in fault.cells}
    assert possible | set(told.fault_set) == set(cells)
    assert not (told.verdicts[cells] == Verdict.ALIVE).any()
    names = {finding.name for finding in of_diagnosis(told)}
    assert bool(names & {"held_value", "untested"}) == bool(possible)
    assert all("perhaps" in fault.reason for fault in told.possible)


@given(n=st.integers(4, 60), odds=st.floats(0.5, 2))
def test_what_a_set_of_recordings_shows_is_told_where_no_other_set_may_by_chance(n, odds):
    where = tuple(range(n - n // 3, n))
    suspect = np.zeros((n, 64), bool)
    suspect[np.ix_(where, [STUCK])] = True
    of_cells = np.where(suspect.any(axis=0), 9.0, -np.inf)
    nothing = np.full(64, np.nan)
    held = Held(of_cells, suspect, ~suspect, nothing, np.zeros_like(suspect), nothing)
    whole = Diagnosis(LAYOUT, (), np.zeros(64), np.ones(64, bool), 10 * n, n_recordings=n)
    against = odds * n * (n + 1) / 2
    likely = against / (1 + against)
    probability = np.where(np.arange(64) == STUCK, likely, 0.0)

    def diagnose(recordings):
        assert recordings == where
        fault = Fault(FaultKind.STUCK, (STUCK,), probability=likely)
        return Diagnosis(LAYOUT, (fault,), probability, np.ones(64, bool), 10, len(where))

    told = with_recordings(whole, held, [10] * n, 0.01, diagnose)
    assert (told.fault_set == {STUCK}) == (odds >= 1)
    assert [fault.cells for fault in told.possible] == ([] if odds >= 1 else [(STUCK,)])


def test_each_recording_has_verdicts_of_its_own(diagnosis, grasps):
    told = diagnosis.by_recording
    assert told.verdicts.shape == told.probability.shape == (len(grasps), 64)
    faulty = told.verdicts == Verdict.FAULTY
    assert faulty[np.ix_(MIDDLE, DEAD)].all()
    assert faulty.sum() == len(MIDDLE) * len(DEAD)
    still = np.array([np.ptp(recording, axis=0) == 0 for recording in grasps])
    assert not ((told.verdicts == Verdict.ALIVE) & still).any()
    assert told.probability[0, DEAD].max() == 0
    assert told.probability[MIDDLE[0], DEAD].min() > 0.9


def test_a_stored_diagnosis_keeps_the_recordings(diagnosis):
    again = Diagnosis.from_dict(json.loads(json.dumps(diagnosis.to_dict())))
    assert again.faults == diagnosis.faults
    np.testing.assert_array_equal(again.by_recording.verdicts, diagnosis.by_recording.verdicts)


def test_the_mask_marks_these_recordings_alone(diagnosis, seated_again):
    masks = list(valid_masks(seated_again, diagnosis.faults, LAYOUT))
    for number, mask in enumerate(masks):
        assert mask[:, DEAD].all() == (number not in MIDDLE)
        assert np.delete(mask, DEAD, axis=1).all()


def test_a_reference_that_is_broken_in_part_is_told_and_nothing_is_learned_from_it(seated_again):
    fitted = SelfDiagnosis(LAYOUT)
    with pytest.warns(ReferenceWarning, match="in recordings 14 to 27, pad 0, row 3"):
        fitted.fit(seated_again)
    assert fitted.reference_findings_[0].recordings == MIDDLE
    assert set(fitted.reference_findings_[0].cells) == set(DEAD)
    assert fitted.diagnose(seated_again).fault_set == set(DEAD)
    assert fitted.diagnose([seated_again[i] for i in MIDDLE]).fault_set == set(DEAD)


def test_a_strict_fit_refuses_it(seated_again):
    with pytest.raises(ValueError, match="the reference is no healthy one"):
        SelfDiagnosis(LAYOUT).fit(seated_again, strict=True)


def test_a_healthy_reference_shows_nothing(grasps):
    assert SelfDiagnosis(LAYOUT).judge(grasps) == ()


def test_a_fault_keeps_its_recordings_in_a_document():
    fault = Fault(FaultKind.OPEN, (3,), recordings=(1, 4))
    assert Fault.from_dict(json.loads(json.dumps(fault.to_dict()))) == fault
    assert "recordings" not in Fault(FaultKind.OPEN, (3,)).to_dict()
    with pytest.raises(ValueError, match="expected a fault"):
        Fault.from_dict({"kind": "open", "cells": [3], "recordings": ["first"]})


@pytest.mark.parametrize("seed", [4, 7])
def test_what_moves_in_a_class_that_the_reference_lacks_is_not_blamed_for_it(seed):
    layout = SensorLayout(1, 8, 8, full_scale=3.3, rate=20.0)
    classes = ("nothing", "normal", "softer", "harder")
    made = simulate(12, layout, n_frames=60, seed=seed, classes=classes)
    order = np.argsort(np.arange(len(made.frames)) % 12, kind="stable")  # in turn
    log = [np.array(made.frames[i], np.float64) for i in order]
    rng = np.random.default_rng(seed)
    for one, label in zip(log, made.labels[order], strict=True):
        if classes[label] == "harder" and rng.random() < 0.94:
            one[:, [18, 29, 44, 51]] = 0.61
    diagnosis = SelfDiagnosis(layout).diagnose(log, classes=made.labels[order])
    assert set(diagnosis.fault_set) == {18, 29, 44, 51}


def test_a_log_that_lies_class_by_class_blames_nobody_for_a_class_of_the_second_half():
    layout = SensorLayout(2, 9, 8, full_scale=3.3, rate=20.0)
    classes = ("nothing", "normal", "softer", "harder")
    made = simulate(12, layout, n_frames=60, seed=31, classes=classes)
    order = np.argsort(made.labels, kind="stable")
    log = [np.array(made.frames[i], np.float64) for i in order]
    row = list(range(16, 24))
    for one in log[24:]:
        one[:, row] = 0.0
    diagnosis = SelfDiagnosis(layout).diagnose(log, classes=made.labels[order])
    assert set(diagnosis.fault_set) == set(row)
