"""A self-test from the robot's own repertoire."""

import itertools
import json

import numpy as np
import pytest

import adaptfault as af
from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.robot.selftest import _greedy, _share, load_probability
from diagnostics import SensorLayout

LAYOUT = SensorLayout(1, 3, 4, full_scale=1.0, unit="V", rate=10.0)


def press(*cells: int, force: float = 0.5, frames: int = 20, rest: float = 0.1) -> np.ndarray:
    """A recording that loads some cells."""
    recording = np.full((frames, 12), rest)
    recording[5:-5, list(cells)] += force
    return recording


def chosen_of(likely: np.ndarray, weights: np.ndarray, n: int) -> list[int]:
    return _greedy(likely, weights, np.ones(len(likely)), np.zeros(len(weights)), None, n)[0]


def test_a_cell_is_loaded_where_its_reading_leaves_its_rest():
    likely = load_probability([press(0, 1), press(5), press()], LAYOUT)
    assert likely[0, 0] == pytest.approx((1 + 1 / 3) / 2)
    assert likely[1, 0] == pytest.approx((0 + 1 / 3) / 2)
    assert (likely[:, 7] == 0).all()


def test_load_that_lowers_the_readings_loads_as_well():
    falling = [1 - press(0, 1), 1 - press(5), 1 - press()]
    rising = [press(0, 1), press(5), press()]
    np.testing.assert_array_equal(
        load_probability(falling, LAYOUT), load_probability(rising, LAYOUT)
    )


def test_recordings_of_one_class_repeat_each_other():
    likely = load_probability(
        [press(0), press(0), press(1), press(1)], LAYOUT, np.array([0, 0, 1, 1])
    )
    assert likely[:, 0].tolist() == [1, 1, 0, 0]


def test_missing_readings_and_absent_cells_are_no_load():
    present = np.ones((1, 3, 4), bool)
    present[0, 0, 3] = False
    layout = SensorLayout(1, 3, 4, full_scale=1.0, present=present)
    recording = press(0, 3)
    recording[:, 7] = np.nan
    recording[3, 0] = np.nan
    likely = load_probability([recording, press(1)], layout)
    assert likely[0, 0] > 0.5
    assert not likely[:, [3, 7]].any()


@pytest.mark.parametrize("seed", range(5))
def test_the_choice_reaches_its_bound_of_the_best_one(seed):
    rng = np.random.default_rng(seed)
    likely = rng.random((8, 12)) * (rng.random((8, 12)) < 0.4)
    weights = rng.random(12)
    weights /= weights.sum()
    best = max(
        _share(likely[list(some)].sum(axis=0), weights)
        for some in itertools.combinations(range(8), 3)
    )
    chosen = chosen_of(likely, weights, 3)
    assert _share(likely[chosen].sum(axis=0), weights) >= (1 - 1 / np.e) * best


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


def test_a_budget_of_seconds_is_kept(bundle, small_grasps):
    whole = af.plan_selftest(bundle, small_grasps)
    routine = af.plan_selftest(bundle, small_grasps, seconds=whole.seconds / 2)
    assert routine.seconds <= whole.seconds / 2
    with pytest.raises(ValueError, match="fits into"):
        af.plan_selftest(bundle, small_grasps, seconds=0.001)


def test_what_cannot_be_planned_is_refused(bundle, small_grasps):
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


def test_the_command_writes_the_routine(bundle, small_grasps, tmp_path, capsys):
    save_npz(tmp_path / "grasps.npz", small_grasps)
    out = tmp_path / "routine.json"
    command = ["selftest", str(bundle.path), str(tmp_path / "grasps.npz"), "--number", "2"]
    assert main([*command, "--out", str(out)]) == 0
    routine = af.Routine.from_dict(json.loads(out.read_text()))
    assert routine == af.plan_selftest(bundle, small_grasps, n=2)
    assert "of what matters" in capsys.readouterr().out
