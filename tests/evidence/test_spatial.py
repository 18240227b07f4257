import numpy as np
import pytest

from diagnostics.events.constant_runs import ConstantRuns
from diagnostics.events.contact_events import ContactEvent, Summary
from diagnostics.evidence.conditional_test import CellState, Model
from diagnostics.evidence.prediction import Prediction
from diagnostics.evidence.spatial import Spatial, SpatialTest
from diagnostics.preprocessing.scale import Array, Scale

CELLS = 8
FRAMES = 20
SCALE = Scale(np.zeros(CELLS), 0.05, 5.0)
NONE = np.zeros(CELLS, bool)


class Copycat:
    """An array on which all cells are always loaded alike: each does what the predictors do on
    average."""

    def predict(self, features: Array, predictors: np.ndarray) -> Prediction:
        shape = features[:, 0].shape
        known = predictors if predictors.any() else np.ones(CELLS, bool)
        of_known = features[:, :, known]
        loaded, always, mean = (
            of.mean(axis=1, keepdims=True)
            for of in (of_known[:, 2], of_known[:, 3] == 1, of_known[:, 1])
        )
        p = np.clip(np.broadcast_to(np.stack([1 - loaded, always]), (2, *shape)), 0.02, 0.98)
        return Prediction(p[0], p[1], np.broadcast_to(mean, shape), np.full(CELLS, 0.05))


class Presser:
    """Predicts that every event loads all cells."""

    def predict(self, features: Array, predictors: np.ndarray) -> Prediction:
        even = np.ones(features[:, 0].shape)
        return Prediction(0.02 * even, 0.02 * even, 0.5 * even, np.full(CELLS, 0.05))


class Holder:
    """Is sure that all cells hold a root load of one half throughout."""

    def predict(self, features: Array, predictors: np.ndarray) -> Prediction:
        expected = Presser().predict(features, predictors)
        expected.always[:] = 0.98
        return expected


class Row:
    """The last three cells lie in a row: each does what the other two do; without them it is
    loaded, more likely."""

    def predict(self, features: Array, predictors: np.ndarray) -> Prediction:
        expected = Copycat().predict(features, predictors)
        for cell in range(5, 8):
            scored = [other for other in range(5, 8) if other != cell and predictors[other]]
            unloaded = (features[:, 2, scored] == 0).all(axis=1)
            expected.never[:, cell] = np.where(unloaded, 0.98, 0.02) if scored else 0.3
        return expected


def seen(log: np.ndarray) -> tuple[ConstantRuns, list[ContactEvent]]:
    """Return the state after a log of events of 20 frames each."""
    runs = ConstantRuns.begin(CELLS)
    events = []
    for first in range(0, len(log), FRAMES):
        frames = log[first : first + FRAMES]
        runs = runs.extend(frames, np.arange(first, first + len(frames)), 0.025)
        root = SCALE.root_load(frames)
        halves = tuple(Summary.of(root[i : i + 10], first + i, SCALE.root_near) for i in (0, 10))
        events.append(ContactEvent(halves, root.min(axis=0), root.max(axis=0), halves[0].first))
    return runs, events


def result_of(
    log: np.ndarray,
    wrong: np.ndarray = NONE,
    accumulated: np.ndarray | None = None,
    jump: float = 0.0,
    model: Model | None = None,
) -> Spatial:
    """Test a log of events of 20 frames each."""
    runs, events = seen(log)
    accumulated = np.zeros(CELLS) if accumulated is None else accumulated
    jumps = np.full(CELLS, jump)
    cells = CellState(runs, SCALE, 0.025, accumulated, jumps, ~wrong)
    return SpatialTest(events, cells, model or Copycat().predict).finish()


def pressed(events: int) -> np.ndarray:
    """All cells are loaded in each event, from rest to 2 N and back."""
    force = 2 * np.sin(np.linspace(0, np.pi, FRAMES))
    return np.tile(np.repeat(force[:, None], CELLS, axis=1), (events, 1))


@pytest.mark.parametrize("value", [0.0, 5.0])
def test_each_event_adds_evidence_against_a_cell_that_holds_its_value_through_it(value: float):
    outcomes = []
    for events in (1, 2, 4, 8):
        log = pressed(events)
        log[:, 3] = value
        outcomes.append(result_of(log).evidence[3])
    assert (np.diff(outcomes) > 2).all()


def test_how_seldom_cells_stick_to_a_value_in_between_is_charged_once():
    charged = []
    for events in (3, 6):
        log = pressed(events)
        log[:, 3] = 0.0
        log[:, 4] = 2.5
        spatial = result_of(log)
        charged.append((spatial.surprisal - spatial.evidence)[[3, 4]])
    assert charged[0][1] > charged[0][0] + 2
    assert charged[1] == pytest.approx(charged[0])


@pytest.mark.parametrize("value", [1.0, 5.0])
def test_a_load_held_since_the_last_event_tells_nothing(value: float):
    log = pressed(2)
    log[35:, 3] = value
    found = result_of(log)
    assert found.scored[3]
    assert found.evidence[3] == 0


def test_a_cell_at_rest_is_as_likely_broken_without_an_event_as_after_one_without_load():
    untested = pressed(2)
    untested[35:, 3] = 0.0
    unloaded = np.concatenate([untested, np.zeros((FRAMES, CELLS))])
    evidence = result_of(untested).evidence[3]
    assert evidence < 0
    assert result_of(unloaded).evidence[3] == pytest.approx(evidence, abs=0.05)


def test_an_unexpected_value_is_weaker_evidence_in_events_with_large_errors():
    outcomes = []
    for force in (1.0, 0.1):
        log = force * pressed(4)
        log[:, 3] = 4.5
        outcomes.append(result_of(log, model=Holder().predict).surprisal[3])
    assert 0 < outcomes[1] < outcomes[0] - 2


def test_a_cell_at_rest_is_not_suspected_without_any_event():
    spatial = result_of(np.zeros((100, CELLS)))
    assert spatial.scored.all()
    assert (spatial.evidence <= 0).all()


def test_cells_that_move_are_not_scored_and_have_no_evidence():
    log = pressed(4)
    log[:, 3] = 0
    spatial = result_of(log)
    assert spatial.scored.tolist() == [cell == 3 for cell in range(CELLS)]
    assert (spatial.evidence[~spatial.scored] == 0).all()
    assert spatial.events[3] == 4
    assert spatial.events[~spatial.scored].sum() == 0


def test_only_what_came_after_the_onset_speaks_against_a_cell():
    early = pressed(6)
    late = pressed(6)
    early[:, 3] = 0
    late[80:, 3] = 0
    assert result_of(late).evidence[3] < result_of(early).evidence[3] - 4
    assert result_of(late).events[3] == 2


def test_a_cell_that_fails_within_an_event_is_tested_on_the_rest_of_it():
    log = pressed(1)
    log[8:, 3] = 0
    assert result_of(log).events[3] == 1
    assert result_of(log).surprisal[3] > 1


def test_two_broken_cells_do_not_excuse_each_other():
    one = pressed(4)
    two = pressed(4)
    one[:, 3] = 0
    two[:, [3, 4, 5]] = 0
    assert result_of(two).evidence[[3, 4, 5]].min() > 5
    assert result_of(two).evidence[3] == pytest.approx(result_of(one).evidence[3], abs=2)


def test_cells_known_to_be_faulty_are_neither_predictors_nor_scored():
    log = pressed(4)
    log[:, 3] = 0
    log[:, 6] = 4 - log[:, 6]
    wrong = np.arange(CELLS) == 3
    spatial = result_of(log, wrong)
    assert not spatial.scored[3]
    assert spatial.evidence[3] == 0


def test_evidence_of_earlier_events_is_kept():
    log = pressed(2)
    log[:, 3] = 0
    accumulated = np.full(CELLS, 7.0)
    assert result_of(log, accumulated=accumulated).evidence[3] == pytest.approx(
        result_of(log).evidence[3] + 7
    )


def test_an_event_that_surprises_the_moving_cells_is_weak_evidence_about_the_others():
    outcomes = []
    slope = np.linspace(0.3, 1, CELLS)
    for surprised in (0, 2, 4):
        # no event repeats the other
        log = pressed(2) * np.repeat([slope, slope[::-1]], FRAMES, axis=0)
        log[:, 3] = 0.0
        log[FRAMES:, 4 : 4 + surprised] = 0.0
        outcomes.append(result_of(log, model=Presser().predict).surprisal[3])
    assert outcomes[0] > outcomes[1] + 0.4 > outcomes[2] + 0.6


@pytest.mark.parametrize("one_is_still", [True, False])
def test_a_cell_that_moves_but_never_returns_to_its_baseline_has_an_offset(one_is_still: bool):
    log = pressed(6)
    log[:, 3] = 2 + 0.2 * log[:, 3] + np.linspace(0, 1, len(log))
    if one_is_still:
        log[:, 7] = 0
    offset = result_of(log).offset
    assert offset[3] > 4
    assert (np.delete(offset, 3) == 0).all()


def test_an_offset_that_ended_is_forgotten():
    log = pressed(6)
    log[:100, 3] = 2 + 0.2 * log[:100, 3]
    log[:, 7] = 0
    assert result_of(log).offset[3] == 0
