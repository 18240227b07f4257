"""Swapped, mirrored and shifted wiring, on simulated grasps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import whole_fit, worn

from adaptfault.data.simulated_grasps import simulate
from diagnostics import SelfDiagnosis, SensorLayout

LAYOUT = SensorLayout(2, 6, 5)
HAND = Path(__file__).resolve().parents[3] / "shared" / "data" / "sdh2x13x6_grasps36.npz"
GRID = LAYOUT.grid(np.arange(LAYOUT.n_cells))
# of each class, two thirds are the reference
DEALT = np.arange(90).reshape(3, 30).T.ravel()


@pytest.fixture(scope="module")
def fitted(small_grasps):
    with whole_fit():
        return SelfDiagnosis(LAYOUT).fit([small_grasps.frames[i] for i in DEALT[:60]])


def log(small_grasps, seed):
    chosen = 60 + np.random.default_rng(seed).choice(30, 12, replace=False)
    return [np.asarray(small_grasps.frames[i]) for i in DEALT[chosen]]


def exchanged_rows(pad, a, b):
    grid = GRID.copy()
    grid[pad, [a, b]] = grid[pad, [b, a]]
    return grid.ravel()


def reverse_rows():
    grid = GRID.copy()
    grid[0] = grid[0, ::-1]
    return grid.ravel()


def shifted_columns():
    grid = GRID.copy()
    grid[1] = np.roll(grid[1], 1, axis=1)
    return grid.ravel()


@pytest.mark.parametrize(
    ("wired", "said"),
    [
        (exchanged_rows(0, 1, 4), "rows 1 and 4 of pad 0 are exchanged"),
        (reverse_rows(), "the rows of pad 0 are in reverse order"),
        (shifted_columns(), "the columns of pad 1 are shifted by +1"),
    ],
)
def test_a_changed_wiring_is_named_and_undone(fitted, small_grasps, wired, said):
    healthy = log(small_grasps, 0)
    found = fitted.rewiring([frames[:, wired] for frames in healthy])
    assert found is not None
    assert found.steps == (said,)
    for frames in healthy:
        np.testing.assert_array_equal(found.undo(frames[:, wired]), frames)


def test_the_recordings_do_not_decide_for_pads_that_an_object_loads_alike(fitted, small_grasps):
    opposite = GRID[::-1].ravel()
    found = fitted.rewiring([frames[:, opposite] for frames in log(small_grasps, 0)])
    assert found is None or found.steps == ("pads 0 and 1 are exchanged",)


def test_two_changes_are_found_together(fitted, small_grasps):
    wired = exchanged_rows(0, 1, 4)[exchanged_rows(1, 0, 3)]
    found = fitted.rewiring([frames[:, wired] for frames in log(small_grasps, 1)])
    assert found is not None
    assert len(found.steps) == 2
    np.testing.assert_array_equal(found.undo(wired), np.arange(LAYOUT.n_cells))


def test_contacts_that_are_repeated_in_other_recordings_prove_little_more(fitted, small_grasps):
    few = [frames[:, reverse_rows()] for frames in log(small_grasps, 0)[:4]]
    once = fitted.rewiring(few)
    often = fitted.rewiring(few * 4)
    assert once.steps == often.steps
    assert often.gain < 1.01 * once.gain * sum(1 / k for k in range(1, 5))  # not 4 times


def test_healthy_logs_show_no_change(fitted, small_grasps):
    assert [fitted.rewiring(log(small_grasps, seed)) for seed in range(12)] == [None] * 12


def test_dead_cells_are_no_change_of_the_wiring(fitted, small_grasps):
    dead = np.random.default_rng(2).choice(LAYOUT.n_cells, 10, replace=False)
    broken = [frames.copy() for frames in log(small_grasps, 3)]
    for frames in broken:
        frames[:, dead[:5]] = 0.0
        frames[:, dead[5:]] = LAYOUT.full_scale
    assert fitted.rewiring(broken) is None


def with_faulty(log, cells, kind, seed=0, layout=LAYOUT):
    """Return a log in which some cells move, but not with their neighbours."""
    rng = np.random.default_rng(seed)
    broken = [frames.astype(float) for frames in log]
    for frames in broken:
        size = (len(frames), len(cells))
        if kind == "constant in each recording":
            frames[:, cells] = rng.uniform(0, layout.full_scale, (1, len(cells)))
        elif kind == "swinging":
            phase = np.arange(len(frames))[:, None] / 5 + rng.uniform(0, 6, len(cells))
            frames[:, cells] = layout.full_scale * (1 + np.sin(phase)) / 5
        elif kind == "spiking":
            spikes = rng.uniform(0.2, 1, size) * layout.full_scale
            frames[:, cells] = np.where(rng.random(size) < 0.1, spikes, frames[:, cells])
    return broken


MOVING = ("constant in each recording", "swinging", "spiking")


@pytest.mark.parametrize("kind", MOVING)
def test_faulty_cells_that_move_are_no_change_of_the_wiring(fitted, small_grasps, kind):
    for seed in range(4):
        cells = np.random.default_rng(seed).choice(LAYOUT.n_cells, 6, replace=False)
        assert fitted.rewiring(with_faulty(log(small_grasps, seed), cells, kind, seed)) is None


@pytest.mark.parametrize("kind", MOVING)
def test_exchanged_rows_are_mostly_named_beside_faulty_cells_and_no_others(
    fitted, small_grasps, kind
):
    named = []
    for seed in range(8):
        cells = np.random.default_rng(seed).choice(LAYOUT.n_cells, 3, replace=False)
        broken = with_faulty(log(small_grasps, seed), cells, kind)
        found = fitted.rewiring([frames[:, exchanged_rows(0, 1, 4)] for frames in broken])
        named += [] if found is None else list(found.steps)
    assert set(named) == {"rows 1 and 4 of pad 0 are exchanged"}
    assert len(named) >= 5


def test_a_strap_is_no_change_of_the_wiring():
    """A smooth load that never goes away fits exchanged lines better, by chance, wherever it
    lies."""
    layout = SensorLayout(2, 8, 8)
    grasps = simulate(8, layout, n_frames=60, seed=1)
    fitted = SelfDiagnosis(layout).fit(grasps.frames)
    later = simulate(4, layout, n_frames=60, seed=99)
    for force in (1.0, 2.0):
        strapped = worn(later.frames, layout, "strap", force)
        assert fitted.rewiring(strapped) is None


@pytest.mark.slow
@pytest.mark.skipif(not HAND.exists(), reason="recordings of a real hand are not at hand")
def test_faulty_cells_of_a_real_hand_are_no_change_of_the_wiring():
    with np.load(HAND) as given:
        layout = SensorLayout(
            2, 13, 6, full_scale=4095.0, unit="count", rate=31.25, present=given["factory_mask"]
        )
        recordings = [
            f[:n].reshape(n, -1).astype(float)
            for f, n in zip(given["frames"], given["lengths"], strict=True)
        ]
    order = np.random.default_rng(0).permutation(len(recordings))
    with whole_fit():
        hand = SelfDiagnosis(layout).fit([recordings[i] for i in order[:300]])
    for seed in range(12):
        rng = np.random.default_rng(seed)
        chosen = [recordings[i] for i in rng.choice(order[300:], 30, replace=False)]
        cells = rng.choice(np.flatnonzero(layout.present), int(rng.integers(6, 17)), replace=False)
        assert hand.rewiring(with_faulty(chosen, cells, MOVING[seed % 3], seed, layout)) is None


def test_what_the_data_cannot_tell_is_not_reported(fitted, small_grasps):
    idle = [np.zeros((50, LAYOUT.n_cells))] * 6
    assert fitted.rewiring(idle) is None
    assert fitted.rewiring(log(small_grasps, 0)[:1]) is None
    assert SelfDiagnosis(LAYOUT).rewiring(log(small_grasps, 0)) is None


def test_where_there_are_no_rows_none_are_exchanged(fitted, small_grasps):
    wired = exchanged_rows(0, 1, 4)
    buses = SelfDiagnosis(replace(LAYOUT, wiring="bus"))
    buses.reference_ = fitted.reference_
    assert buses.rewiring([frames[:, wired] for frames in log(small_grasps, 0)]) is None


@pytest.mark.parametrize("wiring", [{"wiring": "bus"}, {"groups": {"triangle": range(30)}}])
def test_one_pad_without_rows_and_columns_has_no_wiring_to_change(small_grasps, wiring):
    recordings = [frames[:, :30] for frames in small_grasps.frames]
    one_pad = SelfDiagnosis(SensorLayout(1, 6, 5, **wiring)).fit(recordings[:60])
    assert one_pad.rewiring(recordings[60:]) is None


def test_exchanged_rows_of_a_sensor_that_rests_high_are_named(fitted, small_grasps):
    wired = exchanged_rows(0, 1, 4)
    high = SelfDiagnosis(replace(LAYOUT, rest="high"))
    high.reference_ = fitted.reference_
    found = high.rewiring([5.0 - frames[:, wired] for frames in log(small_grasps, 0)])
    assert found is not None
    assert found.steps == ("rows 1 and 4 of pad 0 are exchanged",)
