"""Adapted together is adapted one by one, to within rounding."""

import copy

import numpy as np
import pytest
import torch

from adaptfault.adapter import Adapter
from adaptfault.fills import CellStatistics
from adaptfault.network import TactileTransformer, logits_of
from adaptfault.reduction import ReducedModel, phi, reduce_windows
from adaptfault.together import Together, adapt_many, train_together
from adaptfault.training import train
from adaptfault.windows import Windows
from diagnostics import FaultSet, SensorLayout

LAYOUT = SensorLayout(2, 3, 3, present=np.arange(18) % 9 != 4)
D = LAYOUT.n_cells
SETS = [FaultSet((0,), D), FaultSet((1, 2, 10), D), FaultSet((), D), FaultSet(range(9), D)]
TOLERANCE = 1e-4  # of a logit


pytestmark = pytest.mark.usefixtures("one_thread")


def blobs(n: int, seed: int) -> Windows:
    """Three classes: which row of both pads is pressed."""
    rng = np.random.default_rng(seed)
    y = rng.integers(0, 3, n)
    rows = np.abs(np.arange(3)[None] - y[:, None] - rng.normal(0, 0.3, (n, 1)))
    press = np.exp(-rows)[:, None, None, :, None] * rng.uniform(0.3, 0.9, (n, 1, 2, 1, 3))
    x = press * np.linspace(0.6, 1, 4)[:, None, None, None] + rng.normal(0, 0.02, (n, 4, 2, 3, 3))
    x = np.maximum(x, 0).reshape(n, 4, D) * LAYOUT.present.ravel()
    return Windows(x.astype(np.float32), y, np.arange(n))


@pytest.fixture(scope="module")
def adapter() -> Adapter:
    model = TactileTransformer(LAYOUT, 3, length=4)
    train(model, blobs(150, 0), blobs(60, 1), epochs=5, learning_rate=1e-3, progress=False)
    return Adapter(model, blobs(150, 0), blobs(60, 1))


def reduced(adapter: Adapter) -> list[ReducedModel]:
    statistics = CellStatistics.fit(adapter.train)
    return [ReducedModel(copy.deepcopy(adapter.model), f, statistics.linear(f)).eval() for f in SETS]


def test_stacked_models_say_what_each_says_and_never_see_what_they_dropped(adapter):
    models, x = reduced(adapter), torch.from_numpy(adapter.validation.x.copy())
    together = Together(models).eval()
    with torch.no_grad():
        given = together(x)
        for k, (model, faults) in enumerate(zip(models, SETS, strict=True)):
            torch.testing.assert_close(given[k], model(x[..., faults.healthy]), rtol=0, atol=1e-5)
            x[..., list(faults)] = torch.nan
            assert torch.equal(together(x)[k], given[k])
            x = torch.from_numpy(adapter.validation.x.copy())


def test_models_trained_together_are_those_trained_one_by_one(adapter):
    options = {"epochs": 3, "seed": 5, "patience": 1, "learning_rate": 1e-3, "progress": False}
    alone, together = reduced(adapter), reduced(adapter)
    training, validation = blobs(90, 2), blobs(60, 3)
    histories = train_together(together, training, validation, **options)
    for model, other, faults, history in zip(alone, together, SETS, histories, strict=True):
        parts = [reduce_windows(windows, faults) for windows in (training, validation)]
        before = logits_of(model, parts[1].x)
        expected = train(model, *parts, **options)
        after = logits_of(model, parts[1].x)
        assert (after - before).abs().max() > 100 * TOLERANCE  # there was something to learn
        torch.testing.assert_close(logits_of(other, parts[1].x), after, rtol=0, atol=TOLERANCE)
        assert (history.epochs, history.best_epoch, history.stopped) == (
            expected.epochs,
            expected.best_epoch,
            expected.stopped,
        )
        np.testing.assert_allclose(history.train_loss, expected.train_loss, atol=TOLERANCE)
        if model.front is not None:
            torch.testing.assert_close(other.front.weight, model.front.weight, rtol=0, atol=TOLERANCE)


def test_adapted_together_is_adapted_one_by_one_and_the_fault_free_model_stays(adapter):
    before = {name: tensor.clone() for name, tensor in adapter.model.state_dict().items()}
    x, sets = adapter.validation.x, [SETS[1], SETS[2], SETS[3]]
    many = adapt_many(adapter, sets, seed=3, progress=False, device="cpu")
    assert all(torch.equal(tensor, before[name]) for name, tensor in adapter.model.state_dict().items())
    for faults, adaptation in zip(sets, many, strict=True):
        alone = adapter.adapt(faults, method="finetune", seed=3, progress=False)
        assert adaptation.fault_set == faults
        assert [stage.name for stage in adaptation.stages] == [stage.name for stage in alone.stages]
        np.testing.assert_allclose(adaptation.predict_proba(x), alone.predict_proba(x), atol=1e-3)


def test_more_fault_sets_than_at_once_come_back_in_their_order(adapter):
    many = adapt_many(adapter, SETS, method="fill", at_once=3)
    assert [adaptation.fault_set for adaptation in many] == SETS
    assert adapt_many(adapter, []) == ()


def test_what_cannot_be_adapted_is_said_before_any_time_is_spent(adapter):
    with pytest.raises(ValueError, match="F is over 220 cells, the model over 18"):
        adapt_many(adapter, [SETS[0], FaultSet((1,), 220)])
    with pytest.raises(ValueError, match="unknown method 'magic'"):
        adapt_many(adapter, SETS, method="magic")
    with pytest.raises(ValueError, match="at_once must be 1 or more, got 0"):
        adapt_many(adapter, SETS, at_once=0)
    with pytest.raises(ValueError, match="lower learning_rate"):
        train_together(reduced(adapter), adapter.train, adapter.validation, epochs=20, learning_rate=1e38)


def test_phi_and_the_mask_agree_on_which_cells_are_gone(adapter):
    models = reduced(adapter)
    assert [tuple(torch.where(row)[0].tolist()) for row in Together(models).missing] == [tuple(f) for f in SETS]
    assert all(phi(adapter.train.x, f).shape[2] == D - len(f) for f in SETS)
