"""A self-test from the robot's own repertoire."""

import itertools
import json

import numpy as np
import pytest

import adaptfault as af
from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.data.simulated_grasps import simulate
from adaptfault.robot import selftest
from adaptfault.robot.routine import LOADS, Repertoire
from adaptfault.robot.selftest import greedy, loads, share_tested
from diagnostics import Diagnosis, SensorLayout

LAYOUT = SensorLayout(1, 3, 4, full_scale=1.0, unit="V", rate=10.0)


@pytest.fixture(scope="module")
def planned(made_bundle, small_grasps) -> af.Routine:
    """Two recordings of the small grasps."""
    return af.plan_selftest(af.Bundle.open(made_bundle), small_grasps, n=2)


@pytest.fixture(scope="module")
def weights(made_bundle) -> np.ndarray:
    return selftest.cell_weights(af.Bundle.open(made_bundle).parts.adapter())


@pytest.fixture
def weighed(weights: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the cells of a healthy bundle matter is found once: it is most of the work of a plan."""
    find = selftest.cell_weights

    def cell_weights(adapter, faulty=None):
        return find(adapter, faulty) if faulty else weights

    monkeypatch.setattr(selftest, "cell_weights", cell_weights)


def press(*cells: int, force: float = 0.5, frames: int = 20, rest: float = 0.1) -> np.ndarray:
    """A recording that loads some cells."""
    recording = np.full((frames, 12), rest)
    recording[5:-5, list(cells)] += force
    return recording


def diagnosed(tested: np.ndarray) -> Diagnosis:
    return Diagnosis(LAYOUT, (), np.zeros(12), tested, n_frames=20, n_recordings=1)


def chosen_of(likely: np.ndarray, weights: np.ndarray, n: int) -> list[int]:
    untested = np.zeros(len(weights), bool)
    return greedy(likely, weights, np.ones(len(likely)), untested, None, n)[0]


def share(likely: np.ndarray, weights: np.ndarray) -> float:
    begun = np.zeros((LOADS, len(weights)))
    begun[0] = 1.0
    return share_tested(likely, weights, begun)


def repertoire(loaded: np.ndarray, gestures: list[int]) -> Repertoire:
    names = tuple(f"gesture {i}" for i in range(len(loaded)))
    even = np.full(loaded.shape[1], 1 / loaded.shape[1])
    return Repertoire.from_loads(loaded, np.array(gestures), names, even)


def test_a_cell_is_loaded_where_its_reading_leaves_its_rest():
    loaded = loads([press(0, 1), press(5), press()], LAYOUT)
    assert [np.flatnonzero(row).tolist() for row in loaded] == [[0, 1], [5], []]


def test_load_that_lowers_the_readings_loads_as_well():
    falling = [1 - press(0, 1), 1 - press(5), 1 - press()]
    rising = [press(0, 1), press(5), press()]
    np.testing.assert_array_equal(loads(falling, LAYOUT), loads(rising, LAYOUT))


def test_recordings_of_one_class_repeat_each_other():
    loaded = loads([press(0), press(0), press(1), press(0, 1)], LAYOUT)
    assert repertoire(loaded, [0, 0, 1, 1]).likely[:, 0].tolist() == [1, 1, 0.25, 0.75]
    assert repertoire(loaded, [0, 0, 0, 0]).likely[:, 0].tolist() == [0.875, 0.875, 0.375, 0.875]


def test_missing_readings_and_absent_cells_are_no_load():
    present = np.ones((1, 3, 4), bool)
    present[0, 0, 3] = False
    layout = SensorLayout(1, 3, 4, full_scale=1.0, present=present)
    recording = press(0, 3)
    recording[:, 7] = np.nan
    recording[3, 0] = np.nan
    loaded = loads([recording, press(1)], layout)
    assert loaded[0, 0]
    assert not loaded[:, [3, 7]].any()


@pytest.mark.parametrize("seed", range(5))
def test_the_choice_reaches_its_bound_of_the_best_one(seed):
    rng = np.random.default_rng(seed)
    likely = rng.random((8, 12)) * (rng.random((8, 12)) < 0.4)
    weights = rng.random(12)
    weights /= weights.sum()
    best = max(share(likely[list(some)], weights) for some in itertools.combinations(range(8), 5))
    chosen = chosen_of(likely, weights, 5)
    assert best >= share(likely[chosen], weights) >= (1 - 1 / np.e) * best


def test_the_share_is_that_of_repetitions_that_are_drawn():
    rng = np.random.default_rng(0)
    likely = rng.random((6, 5))
    weights = np.full(5, 0.2)
    drawn = rng.random((4000, 6, 5)) < likely
    counted = np.minimum(drawn.sum(axis=1), LOADS) @ weights / LOADS
    assert share(likely, weights) == pytest.approx(counted.mean(), abs=0.01)
    tested = np.arange(5) < 2
    _, reached = greedy(likely, weights, np.ones(6), tested, None, 1)
    assert reached[0] == pytest.approx(0.4 + likely[:, 2:].sum(axis=1).max() * 0.2 / LOADS)


def test_an_unsure_gesture_counts_less_than_a_sure_one_of_the_same_mean():
    sure = np.full((6, 1), 0.5)
    unsure = np.array([[1.0], [1.0], [1.0], [0.0], [0.0], [0.0]])
    one = np.ones(1)
    assert share(sure, one) < share(unsure, one) == 1.0


def test_what_matters_more_is_tested_first():
    likely = np.eye(4)
    weights = np.array([0.1, 0.6, 0.2, 0.1])
    assert chosen_of(likely, weights, 2) == [1, 2]


def test_a_bundle_plans_a_routine_that_comes_back_from_json(bundle, small_grasps):
    routine = af.plan_selftest(bundle, small_grasps, n=3)
    assert len(routine.recordings) == len(set(routine.recordings)) == 3
    before, after = routine.tested
    assert 0 <= before < after <= 1
    assert list(routine.reached) == sorted(routine.reached)
    assert routine.names[0] == small_grasps.names[routine.recordings[0]]
    assert af.Routine.from_dict(json.loads(json.dumps(routine.to_dict()))) == routine
    assert "3 recordings" in str(routine)
    longer = af.plan_selftest(bundle, small_grasps)
    assert longer.recordings[:3] == routine.recordings
    assert longer.tested[1] >= after


@pytest.mark.usefixtures("weighed")
def test_a_budget_of_seconds_is_kept(bundle, small_grasps):
    whole = af.plan_selftest(bundle, small_grasps)
    routine = af.plan_selftest(bundle, small_grasps, seconds=whole.seconds / 2)
    assert routine.seconds <= whole.seconds / 2
    with pytest.raises(ValueError, match="fits into"):
        af.plan_selftest(bundle, small_grasps, seconds=0.001)


@pytest.mark.usefixtures("weighed")
def test_what_cannot_be_planned_is_refused(bundle, planned, small_grasps):
    with pytest.raises(ValueError, match="at least 2 recordings"):
        af.plan_selftest(bundle, small_grasps.select([0]))
    with pytest.raises(ValueError, match="at least 1; got 0"):
        af.plan_selftest(bundle, small_grasps, n=0)
    with pytest.raises(ValueError, match="above 0"):
        af.plan_selftest(bundle, small_grasps, seconds=0)
    idle = Recordings(tuple(frames * 0 for frames in small_grasps), small_grasps.layout)
    with pytest.raises(ValueError, match="loads any cell"):
        af.plan_selftest(bundle, idle)
    with pytest.raises(ValueError, match="schema"):
        af.Routine.from_dict({})
    whole = planned.to_dict()
    for part in ({"loaded": ["00"]}, {"names": []}, {"weights": [1.0]}):
        damaged = {**whole, "repertoire": {**whole["repertoire"], **part}}
        with pytest.raises(ValueError, match=r"routine is damaged: .* repertoire"):
            af.Routine.from_dict(damaged)


@pytest.mark.usefixtures("weighed")
def test_the_command_writes_the_routine(bundle, planned, small_grasps, tmp_path, capsys):
    save_npz(tmp_path / "grasps.npz", small_grasps)
    out = tmp_path / "routine.json"
    command = ["selftest", str(bundle.path), str(tmp_path / "grasps.npz"), "--number", "2"]
    assert main([*command, "--out", str(out)]) == 0
    routine = af.Routine.from_dict(json.loads(out.read_text()))
    assert routine == planned
    assert "of what matters" in capsys.readouterr().out


def test_after_a_log_of_the_routine_the_run_says_what_is_untested_and_what_to_repeat_next(
    bundle, planned, small_grasps, tmp_path, capsys
):
    (tmp_path / "routine.json").write_text(json.dumps(planned.to_dict()))
    later = simulate(2, small_grasps.layout, n_frames=60, seed=8, classes=("softer",))
    save_npz(tmp_path / "log.npz", later)
    page = tmp_path / "page.html"
    command = ["maintain", str(bundle.path), str(tmp_path / "log.npz"), "--json", "--quiet"]
    options = ["--after", str(tmp_path / "routine.json"), "--report", str(page), "--dry-run"]
    assert main([*command, *options]) in (0, 1, 2)
    report = json.loads(capsys.readouterr().out)
    told = report["selftest"]
    untested = report["diagnosis"]["coverage"]["untested"]
    assert told["untested"] == untested
    weights = np.array(planned.repertoire.weights)
    assert told["tested"] == pytest.approx(1 - weights[untested].sum())
    left = np.zeros(60)
    left[untested] = weights[untested]
    best = int(np.argmax(planned.repertoire.likely @ left))
    assert told["next_best"] == small_grasps.names[best]
    assert f"next best: {told['next_best']}" in page.read_text()


def test_a_routine_of_another_sensor_or_a_file_of_something_else_is_refused(planned, tmp_path):
    with pytest.raises(ValueError, match="for 60 cells, the sensor has 12"):
        planned.after(diagnosed(np.ones(12, bool)), 1)
    (tmp_path / "notes.json").write_text("[]")
    with pytest.raises(ValueError, match=r"notes\.json: expected a routine"):
        af.Routine.read(tmp_path / "notes.json")


def test_where_no_recording_loads_what_is_untested_that_is_said():
    loaded = np.arange(12) < np.array([[6], [3]])
    routine = af.Routine((0,), ("gesture 0",), (0, 0.5), (0.5,), 1.0, repertoire(loaded, [0, 1]))
    tested = np.arange(12) < 6
    left = routine.after(diagnosed(tested), 1)
    assert left.next_best is None
    assert str(left).endswith(
        "6 of 12 cells untested, and no recording of the repertoire loads them"
    )
    whole = routine.after(diagnosed(np.ones(12, bool)), 2)
    assert str(whole).endswith("(50% expected), from 2 recordings, where the routine has 1")
