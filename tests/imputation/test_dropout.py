import numpy as np
import pytest
import torch

from adaptfault.data.windows import Windows
from adaptfault.imputation.dropout import RandomRepairs, random_fault_set
from adaptfault.imputation.statistics import CellStatistics
from adaptfault.models.network import TactileTransformer
from adaptfault.models.training import train
from diagnostics import SensorLayout

LAYOUT = SensorLayout(2, 4, 5)


def windows(n: int = 64) -> Windows:
    rng = np.random.default_rng(0)
    y = rng.integers(0, 2, n)
    x = (
        rng.uniform(0, 0.2, (n, 10, LAYOUT.n_cells))
        + 0.5 * (np.arange(LAYOUT.n_cells) % 2 == y[:, None])[:, None]
    )
    return Windows(x.astype(np.float32), y, np.arange(n))


def test_fault_sets_of_every_shape_and_size_are_drawn_and_never_all_cells():
    rng = np.random.default_rng(0)
    sets = [random_fault_set(LAYOUT, rng).mask.reshape(LAYOUT.shape) for _ in range(500)]
    sizes = np.array([s.sum() for s in sets])
    assert sizes.max() < LAYOUT.n_cells
    assert ((sizes > 0) & (sizes <= 5)).any()
    assert (sizes > 30).any()
    for pad in (0, 1):
        assert any(s[pad].all() and not s[1 - pad].any() for s in sets)
    assert any((s == s[0, 0]).all() and s.any() for s in sets)  # whole columns of both pads
    assert any((s == s[:, :, :1]).all() and 0 < s.sum() < 20 for s in sets)  # whole rows


@pytest.mark.parametrize("shape", [(1, 1, 5), (3, 1, 1), (1, 64, 32)])
def test_any_array_keeps_a_cell(shape):
    layout = SensorLayout(*shape)
    rng = np.random.default_rng(0)
    assert all(len(random_fault_set(layout, rng).healthy) for _ in range(100))


def test_absent_positions_are_never_drawn_and_one_that_exists_stays():
    present = np.zeros((2, 4, 5), bool)
    present[0, 0, :2] = True
    layout = SensorLayout(2, 4, 5, present=present)
    rng = np.random.default_rng(0)
    drawn = {tuple(random_fault_set(layout, rng)) for _ in range(200)}
    assert drawn == {(), (0,), (1,)}


def test_a_repaired_batch_keeps_what_the_faults_spared_and_comes_again_for_a_seed():
    data = windows()
    repairs = RandomRepairs(LAYOUT, CellStatistics.fit(data))
    x = torch.from_numpy(data.x[:32].copy())
    first, again = (repairs(x.clone(), torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first, again)
    changed = (first != x).any(dim=1)  # (N, D)
    for part in torch.chunk(changed, 2):
        assert not part[:, ~part.any(0)].any()
        assert (part.all(0) | ~part.any(0)).float().mean() > 0.95
    assert 0 < changed.float().mean() < 1


def test_validation_looks_at_whole_and_at_repaired_windows():
    data = windows()
    both = RandomRepairs(LAYOUT, CellStatistics.fit(data)).beside(data, seed=0)
    assert len(both) == 2 * len(data)
    np.testing.assert_array_equal(both.x[: len(data)], data.x)
    assert (both.x[len(data) :] != data.x).any()
    np.testing.assert_array_equal(both.y[len(data) :], data.y)


@pytest.mark.slow
def test_a_repairable_base_loses_less_under_the_fill():
    from adaptfault.adaptation.adapter import Adapter
    from diagnostics import FaultSet

    data = windows(256)
    held_out = windows(100)
    lost = FaultSet(range(0, 40, 2), 40)
    reached = []
    for repairable in (False, True):
        model = TactileTransformer(LAYOUT, 2)
        train(
            model,
            data,
            held_out,
            epochs=4,
            learning_rate=1e-3,
            repairable=repairable,
            progress=False,
        )
        reached.append(Adapter(model, data, held_out).adapt(lost, method="fill").scores.accuracy)
    assert reached[1] >= reached[0]
    assert reached[1] > 0.9


def test_what_cannot_be_made_repairable_is_said():
    data = windows()
    with pytest.raises(TypeError, match="needs a network of a known layout, got Sequential"):
        train(
            torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(400, 2)),
            data,
            data,
            repairable=True,
        )
    model = TactileTransformer(LAYOUT, 2)
    with pytest.raises(ValueError, match="give augment or repairable"):
        train(model, data, data, repairable=True, augment=lambda x, _: x)
