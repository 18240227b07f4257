"""Units of a regression: a network learns standardised values and returns them in their unit."""

import copy

import numpy as np
import pytest
import torch
from torch import nn

from adaptfault.adaptation.adapter import Adapter
from adaptfault.data.windows import Windows
from adaptfault.evaluation.scores import evaluate
from adaptfault.models.any_model import AnyModel
from adaptfault.models.network import TactileTransformer, logits_of
from adaptfault.models.store import load_model, save_model
from adaptfault.models.training import train
from adaptfault.models.value_units import ValueUnits, foldable
from diagnostics import FaultSet, SensorLayout

LAYOUT = SensorLayout(1, 4, 4)
UNITS = np.array([1000.0, 1e-3])
MEAN = np.array([4000.0, -0.02])


def windows(n: int, seed: int) -> Windows:
    """A press at a random place: its strength near 4000 and its column near -0.02."""
    rng = np.random.default_rng(seed)
    strength = rng.uniform(0.2, 1.0, n)
    column = rng.uniform(0, 3, n)
    rows, cols = np.mgrid[:4, :4]
    place = np.exp(-((cols - column[:, None, None]) ** 2 + (rows - 1.5) ** 2) / 3)
    x = (strength[:, None, None] * place).reshape(n, 1, 16).repeat(5, axis=1)
    y = np.stack([strength, column], axis=1) * UNITS + MEAN
    return Windows(x, y, np.arange(n))


def module(last: nn.Module) -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Flatten(), nn.Linear(80, 16), nn.ReLU(), last)


def wrapped(last: nn.Module) -> AnyModel:
    return AnyModel.probe(module(last), LAYOUT, torch.zeros(3, 5, 16))


@pytest.mark.parametrize("kind", ["network", "module"])
def test_a_folded_model_returns_values_in_their_unit_and_comes_back_bit_for_bit(kind, tmp_path):
    model = TactileTransformer(LAYOUT, 2, length=5)
    if kind == "module":
        model = wrapped(nn.Linear(16, 2))
    part = windows(50, 0)
    units = ValueUnits.of(part)
    standard = logits_of(model, part.x).numpy()
    units.fold(model)
    values = logits_of(model, part.x).numpy()
    np.testing.assert_allclose((values - units.mean) / units.deviation, standard, atol=1e-3)
    if kind == "network":
        save_model(tmp_path, model)
        again = logits_of(load_model(tmp_path), part.x).numpy()
        np.testing.assert_array_equal(again, values)
    units.unfold(model)
    np.testing.assert_allclose(logits_of(model, part.x).numpy(), standard, atol=1e-3)


def test_values_of_any_size_are_learned_and_fine_tuned_and_repaired():
    training, validation, test = (windows(n, n) for n in (300, 100, 101))
    model = wrapped(nn.Linear(16, 2))
    units = ValueUnits.of(training)
    train(
        model,
        units.standardised(training),
        units.standardised(validation),
        epochs=60,
        learning_rate=3e-3,
        patience=None,
        progress=False,
    )
    units.fold(model)
    assert evaluate(model, test).r2 > 0.9
    adapter = Adapter(model, training, validation)
    faults = FaultSet((1, 5, 9), 16)
    broken = copy.copy(test)
    broken.x[..., list(faults)] = 1.0
    # of values in their own unit a new network learns nothing: R2 is far below 0
    for method, least in (("finetune", 0.8), ("scratch", 0.1)):
        scores = evaluate(adapter.adapt(faults, method=method, progress=False), broken)
        assert scores.r2 > least


def test_standardised_values_have_mean_0_and_deviation_1_and_a_constant_stays_0():
    part = windows(40, 0)
    part = Windows(part.x, np.column_stack([part.y, np.full(40, 0.1)]), part.recording)
    units = ValueUnits.of(part)
    y = units.standardised(part).y
    np.testing.assert_allclose(y.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(y.std(axis=0), [1, 1, 0], atol=1e-4)
    assert units.deviation[2] == 1


def test_a_model_without_a_last_linear_layer_is_not_given_units():
    assert foldable(wrapped(nn.Linear(16, 2)))
    assert not foldable(wrapped(nn.Linear(16, 2, bias=False)))
    assert not foldable(wrapped(nn.Sequential(nn.Linear(16, 2), nn.Softplus())))
    units = ValueUnits.of(windows(9, 0))
    with pytest.raises(ValueError, match=r"last nn.Linear with a bias.*end the module with one"):
        units.fold(wrapped(nn.Linear(16, 2, bias=False)))
    with pytest.raises(ValueError, match="a class has no unit"):
        ValueUnits.of(Windows(np.zeros((3, 5, 16)), np.zeros(3), np.arange(3)))
