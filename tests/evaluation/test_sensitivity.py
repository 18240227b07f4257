import json

import numpy as np
import pytest
import torch

from adaptfault.data.windows import Windows
from adaptfault.evaluation.scores import evaluate
from adaptfault.evaluation.sensitivity import analyse, sensitivity
from adaptfault.models.network import TactileTransformer, logits_of
from adaptfault.models.training import train
from diagnostics import SensorLayout

PRESENT = np.ones((1, 5, 6), bool)
PRESENT[0, 0, 0] = PRESENT[0, 4, 5] = False
LAYOUT = SensorLayout(1, 5, 6, present=PRESENT)


def windows(n: int, seed: int) -> Windows:
    """Three classes that differ in where they press; many readings are exactly 0, and some windows
    are wholly so."""
    rng = np.random.default_rng(seed)
    y = rng.integers(0, 3, n)
    press = np.zeros((3, 1, 5, 6))
    press[1, :, :2] = 0.2
    press[2, :, 3:] = 0.2
    x = (press[y][:, None] + rng.normal(0, 0.15, (n, 10, *LAYOUT.shape)) - 0.1).clip(0, 1) * PRESENT
    x[(y == 0) & (rng.random(n) < 0.5)] = 0
    return Windows(x.reshape(n, 10, -1).astype(np.float32), y, np.arange(n))


@pytest.fixture(scope="module", params=["same", pytest.param("valid", marks=pytest.mark.slow)])
def model(request) -> TactileTransformer:
    model = TactileTransformer(LAYOUT, 3, padding=request.param, init="glorot")
    train(model, windows(128, 0), windows(32, 1), epochs=2, learning_rate=1e-3, progress=False)
    with torch.no_grad():  # gains and biases that do something, as those of a long training
        for name, parameter in model.named_parameters():
            if "norm" in name or "bias" in name:
                parameter += 0.1 * torch.randn(
                    parameter.shape, generator=torch.Generator().manual_seed(len(name))
                )
    return model


def one_by_one(model, data: Windows, values) -> np.ndarray:
    usual = evaluate(model, data).accuracy
    lost = np.zeros((len(values), LAYOUT.n_cells))
    for v, value in enumerate(values):
        for cell in range(LAYOUT.n_cells):
            x = data.x.copy()
            x[..., cell] = value
            lost[v, cell] = usual - (model.predict(x) == data.y).mean()
    return lost


def test_the_batched_pass_equals_one_cell_after_the_other(model):
    data = windows(12, 3)
    values = (0.0, 1.0, 0.4)
    np.testing.assert_allclose(
        sensitivity(model, data, values=values), one_by_one(model, data, values), atol=1e-6
    )


def test_the_name_stays_a_function_after_its_module_was_imported():
    import adaptfault

    assert adaptfault.sensitivity is sensitivity
    assert adaptfault.sensitivity is sensitivity


def test_positions_without_a_cell_cost_nothing(model):
    lost = sensitivity(model, windows(16, 5))
    assert not lost[:, ~PRESENT.ravel()].any()
    assert lost[:, PRESENT.ravel()].any()


def test_anything_that_predicts_can_be_asked():
    class Threshold:
        def predict(self, x):
            return (x[:, :, 7].mean(1) > 0.5).astype(int)

    rng = np.random.default_rng(0)
    y = rng.integers(0, 2, 50)
    x = np.full((50, 10, 12), 0.5, np.float32)
    x[:, :, 7] = np.where(y, 0.9, 0.1)[:, None]
    lost = sensitivity(Threshold(), Windows(x, y, np.arange(50)))
    np.testing.assert_allclose(lost[:, 7], [y.mean(), 1 - y.mean()])
    assert not np.delete(lost, 7, axis=1).any()
    with pytest.raises(TypeError, match="got object"):
        sensitivity(object(), Windows(x, y, np.arange(50)))


def test_a_module_that_is_not_the_papers_network_is_enumerated_plainly(model):
    data = windows(10, 6)
    wrapped = torch.nn.Sequential(model)
    np.testing.assert_allclose(sensitivity(wrapped, data), sensitivity(model, data), atol=1e-6)


def test_what_classes_lose_adds_up_to_what_all_lose(model):
    data = windows(16, 7)
    result = analyse(model, data, wires=False)
    share = np.bincount(data.y, minlength=3) / len(data)
    np.testing.assert_allclose(
        (result.accuracy_lost_by_class * share).sum(-1), result.accuracy_lost, atol=1e-12
    )
    np.testing.assert_allclose(
        (result.confidence_lost_by_class * share).sum(-1), result.confidence_lost, atol=1e-12
    )
    np.testing.assert_array_equal(result.accuracy_lost, sensitivity(model, data))
    assert result.wires == ()


def test_a_class_without_windows_is_unknown_and_the_json_says_null(model):
    data = windows(16, 7)
    result = analyse(model, data.select(data.y < 2), wires=False)
    assert np.isnan(result.accuracy_lost_by_class[..., 2]).all()
    assert (
        json.loads(json.dumps(result.to_dict(), allow_nan=False))["accuracy_lost_by_class"][0][3][2]
        is None
    )


def test_the_gradient_is_exact_for_a_small_step(model):
    data = windows(30, 8)
    cell = 10
    step = data.x[..., cell].mean() + 1e-3
    still = data.x.copy()
    still[..., cell] = data.x[..., cell].mean()
    base = Windows(still, data.y, data.recording)
    moved = still.copy()
    moved[..., cell] = step
    loss = [
        torch.nn.functional.cross_entropy(
            logits_of(model, x).double(), torch.from_numpy(data.y)
        ).item()
        for x in (still, moved)
    ]
    estimate = analyse(model, base, values=(float(step),), wires=False).gradient[0, cell]
    assert estimate == pytest.approx(loss[1] - loss[0], rel=0.05, abs=1e-6)


def test_each_wire_costs_what_breaking_it_costs(model):
    data = windows(16, 9)
    result = analyse(model, data)
    assert len(result.wires) == 2 * len(LAYOUT.lines)
    row = next(w for w in result.wires if w.line.kind == "row" and w.value == 1)
    x = data.x.copy()
    x[..., LAYOUT.cells_on(row.line)] = 1
    assert row.accuracy_lost == pytest.approx(result.accuracy - (model.predict(x) == data.y).mean())
    bit = next(
        w
        for w in result.wires
        if w.line.kind == "column_address" and w.line.index == 0 and w.value == 0
    )
    x = data.x.copy()
    grid = np.arange(30).reshape(5, 6)
    x[..., grid[:, 1::2]] = data.x[..., grid[:, ::2]]
    assert bit.accuracy_lost == pytest.approx(result.accuracy - (model.predict(x) == data.y).mean())
    losses = [w.accuracy_lost for w in result.wires]
    assert losses == sorted(losses, reverse=True)


def test_the_map_and_the_summary_name_the_worst_cell(model, tmp_path):
    result = analyse(model, windows(16, 10), wires=False)
    cell, value, lost = result.worst(1)[0]
    assert lost == result.accuracy_lost.max()
    assert result.accuracy_lost[result.values.index(value), cell] == lost
    assert "pad {}, row {}, column {}".format(*LAYOUT.position(cell)) in str(result)
    result.plot().savefig(tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    assert result.rank_correlation.shape == (2,)


def test_windows_without_labels_are_refused(model):
    data = windows(4, 0)
    with pytest.raises(ValueError, match="needs labelled windows"):
        sensitivity(model, Windows(data.x, np.full(4, -1), data.recording))
    with pytest.raises(TypeError, match="got Sequential"):
        analyse(torch.nn.Sequential(model), data)
