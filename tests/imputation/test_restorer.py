import numpy as np
import pytest
from scale_curves import FULL_SCALE, recording

from adaptfault.imputation.restorer import Restorer
from diagnostics import FaultSet, Line, SensorLayout

LAYOUT = SensorLayout(2, 6, 5, full_scale=4095.0, unit="count")
LARGE = SensorLayout(3, 20, 20, full_scale=5.0)


def pressed(layout: SensorLayout, n: int, seed: int) -> list[np.ndarray]:
    """Recordings of 10 frames: a press that grows, at a random place of each pad, with converter
    noise."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[: layout.rows, : layout.cols]
    recordings = []
    for _ in range(n):
        frames = np.zeros((10, *layout.shape))
        for pad in range(layout.pads):
            r = rng.uniform(0, layout.rows)
            c = rng.uniform(0, layout.cols)
            size = rng.uniform(2, 4)
            shape = np.maximum(0, 1 - ((rows - r) ** 2 + (cols - c) ** 2) / size**2)
            frames[:, pad] = np.linspace(0.1, 0.7, 10)[:, None, None] * shape
        frames += rng.normal(0, 0.002, frames.shape)
        recordings.append(np.clip(frames, 0, 1).reshape(10, -1) * layout.full_scale)
    return recordings


@pytest.fixture(scope="module")
def small() -> Restorer:
    return Restorer(LAYOUT).fit(pressed(LAYOUT, 80, 0))


@pytest.fixture(scope="module")
def large() -> Restorer:
    return Restorer(LARGE).fit(pressed(LARGE, 60, 0))


def scattered(layout: SensorLayout) -> FaultSet:
    return FaultSet(tuple(range(3, layout.n_cells, 7)), layout.n_cells)


@pytest.mark.parametrize("name", ["small", "large"])
def test_restored_cells_are_close_to_the_truth_and_healthy_ones_are_unchanged(name, request):
    restorer = request.getfixturevalue(name)
    layout = restorer.layout
    fault_set = scattered(layout)
    truth = np.concatenate(pressed(layout, 20, 1))
    broken = truth.copy()
    broken[:, fault_set.mask] = np.nan
    whole, deviation = restorer.transform(broken, return_std=True)
    np.testing.assert_array_equal(whole[:, fault_set.healthy], truth[:, fault_set.healthy])
    error = (whole - truth)[:, fault_set.mask]
    assert np.mean(error**2) < 0.2 * np.mean((truth - restorer.mean_)[:, fault_set.mask] ** 2)
    assert (deviation[:, fault_set.healthy] == 0).all()
    assert np.sqrt(np.mean(error**2)) == pytest.approx(
        np.sqrt(np.mean(deviation[:, fault_set.mask] ** 2)), rel=0.5
    )


@pytest.mark.parametrize("name", ["small", "large"])
def test_a_frame_alone_a_recording_and_nan_or_f_give_the_same(name, request):
    restorer = request.getfixturevalue(name)
    fault_set = scattered(restorer.layout)
    frames = pressed(restorer.layout, 1, 2)[0]
    garbage = frames.copy()
    missing = frames.copy()
    garbage[:, fault_set.mask] = -1e6
    missing[:, fault_set.mask] = np.nan
    whole = restorer.transform(garbage, fault_set)
    np.testing.assert_array_equal(whole, restorer.transform(missing))
    one_by_one = np.stack([restorer.update(frame, fault_set) for frame in garbage])
    np.testing.assert_allclose(one_by_one, whole, atol=1e-4 * restorer.layout.full_scale)
    assert garbage[0, 3] == -1e6


def test_cells_that_nothing_predicts_are_restored_by_their_mean_with_their_deviation():
    rng = np.random.default_rng(0)
    noise = [rng.uniform(1000, 2000, (200, LAYOUT.n_cells)) for _ in range(10)]
    restorer = Restorer(LAYOUT).fit(noise)
    fault_set = FaultSet((4, 9), LAYOUT.n_cells)
    new = rng.uniform(1000, 2000, (500, LAYOUT.n_cells))
    whole, deviation = restorer.transform(new, fault_set, return_std=True)
    mean = np.mean((new[:, [4, 9]] - restorer.mean_[[4, 9]]) ** 2)
    assert np.mean((new - whole)[:, [4, 9]] ** 2) < 1.05 * mean
    np.testing.assert_allclose(deviation[:, [4, 9]], 1000 / 12**0.5, rtol=0.05)


def test_frames_that_miss_different_cells_are_restored_each_by_its_own_cells(small):
    frames = pressed(LAYOUT, 1, 3)[0]
    frames[2, 7] = frames[5, 12] = frames[5, 13] = np.nan
    whole = small.transform(frames)
    assert np.isfinite(whole).all()
    assert whole[2, 7] == pytest.approx(small.update(frames[2])[7], abs=1)


@pytest.mark.parametrize("name", ["small", "large"])
def test_without_any_healthy_cell_the_mean_is_returned(name, request):
    restorer = request.getfixturevalue(name)
    whole = restorer.update(np.full(restorer.layout.n_cells, np.nan))
    np.testing.assert_allclose(
        whole, restorer.mean_, rtol=1e-3, atol=2e-3 * restorer.layout.full_scale
    )


def test_a_lost_row_and_a_lost_pad_are_no_worse_than_the_mean(large):
    truth = np.concatenate(pressed(LARGE, 60, 4))
    for lost in (LARGE.cells_on(Line(1, "row", 7)), np.arange(400)):
        fault_set = FaultSet(tuple(lost.tolist()), LARGE.n_cells)
        error = large.transform(truth, fault_set)[:, lost] - truth[:, lost]
        assert np.mean(error**2) <= 1.02 * np.mean((truth[:, lost] - large.mean_[lost]) ** 2)


# the whole array at once, and tile by tile
@pytest.mark.parametrize(("pads", "share"), [(3, 1.0), (5, 0.5)])
def test_lines_of_a_skin_with_few_contacts_are_restored_better_than_by_the_mean_in_every_pad(
    pads, share
):
    layout = SensorLayout(pads, 16, 16, full_scale=FULL_SCALE, rate=20.0)
    rng = np.random.default_rng(0)
    restorer = Restorer(layout).fit([recording(layout, rng) for _ in range(12)])
    truth = np.concatenate([recording(layout, rng) for _ in range(40)]).astype(float)
    grid = layout.grid(np.arange(layout.n_cells))
    for lost in (grid[:, :, 4:6], grid[:, 7]):  # a bridge of two columns and a row, in each pad
        whole = restorer.transform(truth, FaultSet(tuple(lost.ravel().tolist()), layout.n_cells))
        for cells in lost.reshape(pads, -1):
            error = np.mean((whole - truth)[:, cells] ** 2)
            assert error < share * np.mean((truth[:, cells] - restorer.mean_[cells]) ** 2)


def test_absent_positions_may_be_nan():
    present = np.ones(LAYOUT.shape, bool)
    present[0, 0, 0] = False
    layout = SensorLayout(2, 6, 5, full_scale=4095.0, present=present)
    recordings = pressed(layout, 40, 0)
    for frames in recordings:
        frames[:, 0] = np.nan
    restorer = Restorer(layout).fit(recordings)
    assert np.isfinite(restorer.update(recordings[0][3])).all()


def test_bad_input_is_refused_in_one_line(small):
    with pytest.raises(ValueError, match="not fitted"):
        Restorer(LAYOUT).update(np.zeros(60))
    with pytest.raises(ValueError, match=r"expected a frame \[60\] or \[2, 6, 5\], got \[59\]"):
        small.update(np.zeros(59))
    with pytest.raises(ValueError, match="F is over 59 cells, expected one over 60"):
        small.update(np.zeros(60), FaultSet((1,), 59))
    with pytest.raises(ValueError, match="at least 4 healthy frames, got 2"):
        Restorer(LAYOUT).fit(np.zeros((2, 60)))
