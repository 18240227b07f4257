import tracemalloc

import numpy as np
import pytest
import torch

from adaptfault.adaptation import fault_free
from adaptfault.adaptation.adapter import Adapter
from adaptfault.adaptation.result import Adaptation
from adaptfault.data.windows import Windows
from adaptfault.imputation.statistics import CellStatistics
from adaptfault.imputation.tiled import TiledFill
from adaptfault.imputation.tiled_statistics import TiledStatistics
from adaptfault.models.network import TactileTransformer
from diagnostics import FaultSet, Line, SensorLayout

SKIN = SensorLayout(1, 24, 24)
F = FaultSet(
    tuple(np.random.default_rng(0).choice(SKIN.n_cells, 40, replace=False).tolist()), SKIN.n_cells
)


def presses(layout: SensorLayout, n: int, seed: int) -> Windows:
    """Windows of one frame: on each pad, for every 150 cells, a press of a few cells' width with
    sharp edges."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[: layout.rows, : layout.cols]
    x = np.zeros((n, *layout.shape), np.float32)
    for pad in x.reshape(-1, layout.rows, layout.cols):
        for _ in range(max(1, layout.rows * layout.cols // 150)):
            r = rng.uniform(0, layout.rows)
            c = rng.uniform(0, layout.cols)
            size = rng.uniform(2, 4)
            pad += rng.uniform(0.2, 0.6) * np.maximum(
                0, 1 - ((rows - r) ** 2 + (cols - c) ** 2) / size**2
            )
    x = np.minimum(x, 1).reshape(n, 1, -1)
    return Windows(x, np.arange(n) % 2, np.arange(n))


def filled(fill: torch.nn.Module, x: np.ndarray, fault_set: FaultSet) -> np.ndarray:
    with torch.no_grad():
        return fill(torch.from_numpy(x[..., fault_set.healthy])).numpy()


def explained(fill: torch.nn.Module, x: np.ndarray, fault_set: FaultSet) -> float:
    truth, guess = (v[..., fault_set.mask] for v in (x, filled(fill, x, fault_set)))
    return 1 - ((truth - guess) ** 2).sum() / ((truth - truth.mean(axis=(0, 1))) ** 2).sum()


def test_healthy_cells_pass_unchanged_and_in_place_and_the_rest_is_within_range():
    statistics = TiledStatistics.fit(presses(SKIN, 100, 0), SKIN)
    x = presses(SKIN, 20, 1).x
    for fill in (statistics.linear(F), statistics.nearest(F)):
        whole = filled(fill, x, F)
        np.testing.assert_array_equal(whole[..., F.healthy], x[..., F.healthy])
        assert whole.min() >= 0
        assert whole.max() <= 1


def test_where_frames_are_few_the_cells_around_explain_missing_ones_better_than_all_cells():
    training = presses(SKIN, 150, 0)
    x = presses(SKIN, 100, 1).x
    here = explained(TiledStatistics.fit(training, SKIN).nearest(F), x, F)
    assert here > 0.9
    assert here > explained(CellStatistics.fit(training).nearest(F), x, F)


def test_a_missing_row_is_explained_by_the_rows_beside_it():
    row = FaultSet(tuple(SKIN.cells_on(Line(0, "row", 11)).tolist()), SKIN.n_cells)
    fill = TiledStatistics.fit(presses(SKIN, 150, 0), SKIN).nearest(row)
    assert explained(fill, presses(SKIN, 100, 1).x, row) > 0.85


def test_what_lies_far_away_does_not_matter():
    fill = TiledStatistics.fit(presses(SKIN, 60, 0), SKIN).nearest(FaultSet((0, 1), SKIN.n_cells))
    x = presses(SKIN, 5, 1).x
    elsewhere = x.copy()
    elsewhere[..., SKIN.cell(0, 12, 0) :] = 0.7
    f = FaultSet((0, 1), SKIN.n_cells)
    np.testing.assert_array_equal(filled(fill, elsewhere, f)[..., :2], filled(fill, x, f)[..., :2])


def test_of_a_pad_that_is_gone_the_mean_load_of_the_other_tells_something():
    layout = SensorLayout(2, 24, 24)
    one = presses(SensorLayout(1, 24, 24), 150, 0)
    both = Windows(np.concatenate([one.x, one.x[..., ::-1]], axis=2), one.y, one.recording)
    gone = FaultSet(tuple(range(576, 1152)), 1152)
    fill = TiledStatistics.fit(both, layout).linear(gone)
    heavy, light = (
        filled(fill, scale * both.x[:20], gone)[..., 576:].mean() for scale in (1.0, 0.3)
    )
    assert heavy > 1.3 * light


def test_where_nothing_was_ever_touched_nothing_is_filled_in():
    nothing = Windows(np.zeros((20, 1, 576)), np.zeros(20), np.arange(20))
    assert (
        filled(TiledStatistics.fit(nothing, SKIN).nearest(F), presses(SKIN, 5, 1).x, F)[
            ..., F.mask
        ].max()
        == 0
    )


def test_positions_without_a_cell_may_be_in_f():
    present = np.ones(SKIN.shape, bool)
    present[0, :6, :6] = False
    layout = SensorLayout(1, 24, 24, present=present)
    f = FaultSet((0, 1, 30, 300), layout.n_cells)
    windows = presses(layout, 50, 0)
    windows.x[..., ~present.ravel()] = 0
    assert (
        filled(TiledStatistics.fit(windows, layout).nearest(f), windows.x, f)[..., [0, 1]].max()
        == 0
    )


def test_memory_for_a_cell_does_not_grow_with_the_number_of_cells():
    peaks = []
    for pads in (2, 8):
        layout = SensorLayout(pads, 24, 24)
        fault_set = FaultSet(tuple(range(7, layout.n_cells, 50)), layout.n_cells)
        windows = presses(layout, 30, 0)
        TiledStatistics.fit(windows, layout).nearest(fault_set)
        tracemalloc.start()
        TiledStatistics.fit(windows, layout).nearest(fault_set)
        peaks.append(tracemalloc.get_traced_memory()[1] / layout.n_cells)
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]


@pytest.mark.filterwarnings("ignore:.*nested tensors")
def test_an_adapter_of_a_large_array_fills_patch_by_patch_and_comes_back_from_disk(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(fault_free, "LARGE", 50)
    layout = SensorLayout(1, 8, 8)
    windows = presses(layout, 24, 0)
    windows = Windows(np.repeat(windows.x, 2, axis=1), windows.y, windows.recording)
    adapter = Adapter(TactileTransformer(layout, 2, length=2), windows, windows)
    fault_set = FaultSet((20, 21, 50), layout.n_cells)
    adaptation = adapter.adapt(fault_set, method="fill")
    assert isinstance(adaptation.model.front, TiledFill)
    adaptation.save(tmp_path / "adapted")
    again = Adaptation.load(tmp_path / "adapted")
    x = torch.from_numpy(windows.x[..., fault_set.healthy])
    with torch.no_grad():
        torch.testing.assert_close(again.model(x), adaptation.model(x), rtol=0, atol=0)


def test_broken_wires_of_a_skin_with_few_contacts_are_imputed_better_than_by_the_mean():
    layout = SensorLayout(6, 16, 16)
    pair = (*layout.cells_on(Line(2, "row", 6)), *layout.cells_on(Line(2, "row", 7)))
    wires = FaultSet(
        (*(int(cell) for cell in pair), *layout.cells_on(Line(4, "column", 9)).tolist()),
        layout.n_cells,
    )
    fill = TiledStatistics.fit(presses(layout, 12, 0), layout).nearest(wires)
    assert explained(fill, presses(layout, 200, 1).x, wires) > 0.5


def test_noise_is_imputed_by_its_mean_and_the_deviation_is_the_noise():
    noise = np.random.default_rng(0).uniform(0.2, 0.6, (4000, 1, SKIN.n_cells)).astype(np.float32)
    statistics = TiledStatistics.fit(Windows(noise, np.zeros(4000), np.arange(4000)), SKIN)
    parts, _ = statistics.parts(F)
    # of the deviation of a cell
    assert max(np.linalg.norm(part.weight, axis=1).max() for part in parts) < 0.25
    deviation = np.concatenate([part.deviation for part in parts])
    np.testing.assert_allclose(deviation, 0.4 / 12**0.5, rtol=0.15)
