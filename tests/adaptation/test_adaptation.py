import copy
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import Clock
from sklearn.ensemble import ExtraTreesClassifier

from adaptfault.adaptation import stages
from adaptfault.adaptation.adapter import Adapter
from adaptfault.adaptation.forecast import Expected, Forecast
from adaptfault.adaptation.reduced_model import ReducedModel, phi
from adaptfault.adaptation.result import Adaptation
from adaptfault.data.windows import Windows
from adaptfault.evaluation.class_recall import class_recalls
from adaptfault.evaluation.scores import evaluate
from adaptfault.imputation.linear import AffineFill
from adaptfault.models.compact import CompactNetwork
from adaptfault.models.network import TactileTransformer
from diagnostics import FaultSet, SensorLayout

LAYOUT = SensorLayout(2, 4, 4)
D = LAYOUT.n_cells


def blobs(n: int, seed: int) -> Windows:
    """Three classes of contact, told apart by where they press; neighbours say nearly all about a
    cell."""
    rng = np.random.default_rng(seed)
    y = rng.integers(0, 3, n)
    centre = np.stack([y * 1.2 + rng.normal(0.3, 0.4, n), rng.normal(1.5, 0.5, n)], axis=1)
    rows, cols = np.mgrid[:4, :4]
    distance = (rows - centre[:, :1, None]) ** 2 + (cols - centre[:, 1:, None]) ** 2  # (n, 4, 4)
    press = rng.uniform(0.2, 0.5, (n, 1, 1, 1, 1)) * np.exp(-distance / 2)[:, None, None]
    x = press * np.linspace(0.5, 1, 10)[:, None, None, None] * np.ones((1, 1, 2, 1, 1))
    x = np.maximum(x + rng.normal(0, 0.004, x.shape), 0).reshape(n, 10, D)
    return Windows(x.astype(np.float32), y, np.arange(n))


@pytest.fixture(scope="module")
def adapter() -> Adapter:
    from adaptfault.models.training import train

    training = blobs(300, 0)
    validation = blobs(120, 1)
    model = TactileTransformer(LAYOUT, 3)
    train(model, training, validation, epochs=8, learning_rate=1e-3, progress=False)
    assert evaluate(model, validation).accuracy > 0.8
    return Adapter(model, training, validation)


@pytest.fixture(scope="module")
def quick(adapter) -> Adapter:
    """The same with fewer windows, where many trainings follow one another."""
    return Adapter(
        adapter.model, adapter.train.select(slice(0, 120)), adapter.validation.select(slice(0, 60))
    )


@pytest.fixture
def working_clock(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> Clock:
    """A clock that work moves: 1 ms for each window that the network sees, 2 ms for each that a
    head is fitted to."""
    features = TactileTransformer.features
    fit = stages.fit_head

    def features_in_time(network, x):
        clock.now += len(x) * 1e-3
        return features(network, x)

    def fit_in_time(first, second, *rest, **options):
        clock.now += (len(first[0]) + len(second[0])) * 2e-3
        return fit(first, second, *rest, **options)

    monkeypatch.setattr(TactileTransformer, "features", features_in_time)
    monkeypatch.setattr(stages, "fit_head", fit_in_time)
    return clock


F = FaultSet((0, 5, 6, 7, 21), D)


# phi and the front end


def test_phi_drops_exactly_the_faulty_cells():
    x = np.arange(2 * 3 * D).reshape(2, 3, D)
    np.testing.assert_array_equal(phi(x, F), np.delete(x, list(F), axis=2))
    with pytest.raises(ValueError, match="F is over 32 cells, the windows have 31"):
        phi(x[..., :-1], F)


def test_with_f_empty_the_logits_of_fill_are_bit_identical(adapter):
    x = torch.from_numpy(adapter.validation.x)
    adapted = adapter.adapt(FaultSet((), D), method="fill")
    with torch.no_grad():
        assert torch.equal(adapted.model(x), adapter.model(x))


def test_a_sensor_without_faults_gets_the_best_model_too(half_trained):
    x = half_trained.validation.x
    adapted = half_trained.adapt([])
    assert adapted.model.head is not None
    np.testing.assert_array_equal(adapted.predict_proba(x), half_trained.healthy.predict_proba(x))


def textures(n: int, seed: int) -> Windows:
    """Three classes of texture: each raises the spread of a third of the cells, which rest anywhere
    and have gains of their own."""
    rng = np.random.default_rng(seed)
    y = rng.integers(0, 3, n)
    level = rng.uniform(0.2, 0.6, (n, 1, D))
    gain = np.random.default_rng(9).uniform(0.5, 1.5, D)
    spread = np.where(np.arange(D) % 3 == y[:, None], 0.02, 0.01)[:, None]
    x = level + gain * spread * rng.normal(size=(n, 10, D))
    return Windows(x.astype(np.float32), y, np.arange(n))


@pytest.mark.usefixtures("all_trees")
def test_a_repair_keeps_up_with_trees_where_texture_tells_the_class():
    training, validation, test = textures(200, 0), textures(100, 1), textures(400, 2)
    untrained = TactileTransformer(LAYOUT, 3)
    repaired = Adapter(untrained, training, validation).adapt(F, progress=False)

    def course(windows: Windows) -> np.ndarray:
        x = windows.x[..., F.healthy]
        return np.hstack([x.mean(1), x.max(1), x.std(1)])

    trees = ExtraTreesClassifier(300, random_state=0)
    known = np.vstack([course(training), course(validation)])
    trees.fit(known, np.concatenate([training.y, validation.y]))
    reached = (repaired.predict(test.x) == test.y).mean()
    assert reached > trees.score(course(test), test.y) - 0.02
    assert reached > 0.75


@pytest.mark.parametrize("method", ["fill", "head", "finetune"])
def test_the_value_of_a_dropped_cell_never_reaches_the_output(quick, working_clock, method):
    adapted = quick.adapt(F, method=method, budget=3.0, progress=False)
    assert adapted.stages[-1].name == method
    x = quick.validation.x[:20].copy()
    before = adapted.predict_proba(x)
    for value in (0.0, 1.0, np.nan, np.inf, -1e30):
        x[:, :, list(F)] = value
        np.testing.assert_array_equal(adapted.predict_proba(x), before)
    assert np.isfinite(before).all()


def test_a_missing_reading_outside_f_is_held_from_the_frame_before(adapter):
    adaptation = adapter.adapt([3], method="fill")
    x = adapter.validation.x[:4].copy()
    held = x.copy()
    held[:, 5, 7] = held[:, 4, 7]
    x[:, 5, 7] = np.nan
    x[:, :, 3] = np.nan
    np.testing.assert_array_equal(adaptation.predict_proba(x), adaptation.predict_proba(held))


def test_the_reduced_model_refuses_windows_with_the_faulty_cells_still_in(adapter):
    reduced = ReducedModel(adapter.model, F, AffineFill(F, np.zeros((5, D - 5)), np.zeros(5)))
    with pytest.raises(ValueError, match="27 healthy cells"):
        reduced(torch.zeros(2, 10, D))


# Stages


def test_each_stage_repairs_and_none_is_worse_than_the_one_before(quick):
    broken = quick.validation.x.copy()
    broken[:, :, list(F)] = 1.0
    collapsed = (quick.model.predict(broken) == quick.validation.y).mean()
    reached = [
        quick.adapt(F, method=m, progress=False).scores.accuracy
        for m in ("fill", "head", "finetune")
    ]
    assert collapsed < 0.7
    assert reached[0] > 0.75
    assert reached == sorted(reached)


@pytest.mark.slow
def test_on_fewer_numbers_the_network_gives_the_same_features_and_as_good_a_head(adapter):
    assert adapter.compact is None  # so few windows are not worth it
    folded = Adapter(adapter.model, adapter.train, adapter.validation)
    folded.compact = CompactNetwork(adapter.model)
    one_window = 1.5 / len(adapter.validation)
    assert folded.fault_free_accuracy == pytest.approx(adapter.fault_free_accuracy, abs=one_window)
    usual, other = (
        a.adapt(F, method="head").predict(adapter.validation.x) for a in (adapter, folded)
    )
    assert (usual == other).mean() > 0.99
    fill = (a.forecast(F).stages["fill"].accuracy for a in (adapter, folded))
    assert next(fill) == pytest.approx(next(fill), abs=one_window)


@pytest.fixture(scope="module")
def half_trained(adapter) -> Adapter:
    """An adapter whose network is worse than a head in closed form."""
    model = copy.deepcopy(adapter.model)
    with torch.no_grad():
        model.head.weight.copy_(
            torch.randn(model.head.weight.shape, generator=torch.Generator().manual_seed(0))
        )
    return Adapter(model, adapter.train, adapter.validation)


def test_a_sensor_gets_no_better_by_a_fault(half_trained):
    plain = half_trained.adapt(FaultSet((), D), method="fill").scores.accuracy
    repaired = half_trained.adapt(FaultSet((3,), D)).scores.accuracy
    assert repaired > plain + 0.1
    assert half_trained.healthy.scores.accuracy >= repaired - 1 / len(half_trained.validation)
    assert half_trained.fault_free_accuracy == half_trained.healthy.scores.accuracy
    assert (
        half_trained.forecast(FaultSet((3,), D)).stages["fault-free"].accuracy
        == half_trained.fault_free_accuracy
    )


def test_auto_leaves_out_a_head_that_loses_beyond_the_noise(adapter, half_trained):
    assert half_trained.adapt(FaultSet((3,), D)).model.head is not None
    wrong = np.random.default_rng(0).permutation(adapter.train.y)
    mislabelled = Adapter(adapter.model, replace(adapter.train, y=wrong), adapter.validation)
    adapted = mislabelled.adapt(FaultSet((3,), D))
    assert adapted.model.head is None
    assert [stage.name for stage in adapted.stages] == ["fill", "head"]
    assert adapted.stages[0].accuracy == adapted.stages[1].accuracy == adapted.scores.accuracy


def test_auto_fine_tunes_only_with_a_budget_and_after_a_loss(adapter, working_clock):
    hard = FaultSet(range(30), D)
    assert [stage.name for stage in adapter.adapt(hard).stages] == ["fill", "head"]
    stages = adapter.adapt(hard, budget=8.0, progress=False).stages
    assert [stage.name for stage in stages] == ["fill", "head", "finetune"]
    assert all(stage.accuracy is not None for stage in stages)


def test_a_larger_budget_never_ends_worse_and_none_is_overdrawn(quick, working_clock):
    hard = FaultSet(range(30), D)
    reached = []
    for budget in (0.0, 1.0, 3.0):
        began = working_clock.now
        adapted = quick.adapt(hard, method="finetune", budget=budget, progress=False)
        # that goes for seeing what a head would take
        assert working_clock.now - began <= max(budget, 0.7)
        reached.append(adapted.scores.accuracy)
    assert reached == sorted(reached)
    assert reached[-1] > reached[0]
    assert [stage.name for stage in adapted.stages] == ["fill", "head", "finetune"]


def test_scratch_learns_a_new_network_on_the_healthy_cells(quick, working_clock):
    scratch = quick.adapt(F, method="scratch", budget=2.0, progress=False)
    assert [stage.name for stage in scratch.stages] == ["scratch"]
    assert scratch.scores.accuracy > 0.5
    assert not torch.equal(scratch.model.network.head.weight, quick.model.head.weight)


def test_adapting_never_changes_the_fault_free_model_so_order_does_not_matter(quick, working_clock):
    before = {name: tensor.clone() for name, tensor in quick.model.state_dict().items()}
    options = {"method": "finetune", "budget": 3.0, "progress": False}
    first = quick.adapt(F, **options)
    assert first.stages[-1].name == "finetune"
    quick.adapt(FaultSet(range(10), D), **options)
    again = quick.adapt(F, **options)
    assert all(
        torch.equal(tensor, before[name]) for name, tensor in quick.model.state_dict().items()
    )
    np.testing.assert_array_equal(
        first.predict_proba(quick.validation.x), again.predict_proba(quick.validation.x)
    )


def test_a_class_without_training_windows_does_not_break_the_head(adapter):
    two, two_validation = (w.select(w.y != 1) for w in (adapter.train, adapter.validation))
    adapted = Adapter(adapter.model, two, two_validation).adapt(F, method="head")
    assert adapted.scores.n == len(two_validation)
    assert adapted.predict_proba(adapter.validation.x)[:, 1].max() < 1e-6
    np.testing.assert_allclose(
        adapted.predict_proba(adapter.validation.x).sum(axis=1), 1, atol=1e-5
    )


def test_one_validation_recording_or_one_window_is_enough(adapter):
    for few in (np.zeros(30), np.arange(1)):
        validation = adapter.validation.select(slice(0, len(few)))
        validation = Windows(validation.x, validation.y, few)
        adapted = Adapter(adapter.model, adapter.train, validation).adapt(
            FaultSet(range(30), D), method="head"
        )
        assert np.isfinite(adapted.predict_proba(adapter.validation.x)).all()


def test_adapting_to_more_faults_later_is_adapting_to_all_at_once(adapter):
    more = FaultSet((1, 2, 30), D)
    adapter.adapt(F, method="head")
    later = adapter.adapt(F | more, method="head")
    at_once = Adapter(adapter.model, adapter.train, adapter.validation).adapt(
        F | more, method="head"
    )
    np.testing.assert_array_equal(
        later.predict_proba(adapter.validation.x), at_once.predict_proba(adapter.validation.x)
    )


def test_without_labels_the_fault_free_model_teaches_the_head(adapter):
    unlabelled = replace(adapter.train, y=np.full(len(adapter.train), -1))
    lost = FaultSet(range(30), D)
    taught = Adapter(adapter.model, unlabelled, adapter.validation)
    assert (
        taught.adapt(lost, method="head").scores.accuracy
        >= adapter.adapt(lost, method="fill").scores.accuracy
    )
    np.testing.assert_allclose(
        taught.targets, adapter.model.predict_proba(adapter.train.x), atol=1e-5
    )


# Forecast


def test_the_forecast_is_what_the_stages_then_reach(adapter):
    forecast = adapter.forecast(F)
    for name in ("fill", "head"):
        scores = adapter.adapt(F, method=name).scores
        expected = forecast.stages[name]
        assert expected.low < expected.accuracy < expected.high
        assert scores.accuracy == pytest.approx(expected.accuracy)
    assert forecast.stages["fault-free"].accuracy == adapter.fault_free_accuracy
    assert list(forecast.stages) == ["fault-free", "fill", "head", "finetune", "scratch"]
    json.dumps(forecast.to_dict(), allow_nan=False)
    assert "without 5 cells, from 120 recordings" in str(forecast)


@pytest.mark.slow
def test_the_interval_covers_new_recordings(adapter, quick):
    covered = 0
    rng = np.random.default_rng(0)
    for i in range(20):
        one = Adapter(adapter.model, quick.train, blobs(60, 100 + i))
        lost = FaultSet(rng.choice(D, int(rng.integers(1, 28)), replace=False).tolist(), D)
        expected = one.forecast(lost).stages["head"]
        covered += (
            expected.low
            <= evaluate(one.adapt(lost, method="head"), blobs(120, 200 + i)).accuracy
            <= expected.high
        )
    assert covered >= 17  # of 20, at 95 % each


def test_an_interval_for_more_recordings_is_narrower(adapter):
    widths = []
    for recordings in (30, None, 1000, np.inf):
        forecast = adapter.forecast(F, recordings=recordings)
        expected = forecast.stages["fill"]
        widths.append(expected.high - expected.low)
    assert widths == sorted(widths, reverse=True)
    assert len(set(widths)) == 4
    assert "many new recordings like these" in str(forecast)
    assert json.loads(json.dumps(forecast.to_dict(), allow_nan=False))["n_new"] is None
    with pytest.raises(ValueError, match="a positive number of new recordings, got 0"):
        adapter.forecast(F, recordings=0)


def test_the_forecast_names_the_class_that_loses_most():
    y = np.repeat([0, 1, 2], 20)
    lost = np.where((y == 1) & (np.arange(60) % 2 == 0), 2, y)
    predicted = {"fault-free": y, "fill": np.zeros_like(y), "head": lost}
    forecast = Forecast.of(F, y, np.arange(60), predicted)
    assert (forecast.worst_class, forecast.worst_loss) == (1, 0.5)
    assert forecast.classes == class_recalls(y, predicted["head"], np.arange(60))
    assert [one["label"] for one in forecast.to_dict()["classes"]] == [0, 1, 2]
    assert forecast.stages["scratch"].accuracy == forecast.stages["head"].accuracy
    assert forecast.stages["scratch"].high >= forecast.stages["fault-free"].accuracy


def test_fault_sets_of_one_accuracy_rank_by_the_probability_of_the_true_class(adapter):
    half, nearly_all = (
        adapter.forecast(FaultSet(tuple(range(1, D, step)), D)).stages["head"] for step in (2, 1)
    )
    assert half.likelihood > nearly_all.likelihood
    right = np.ones(20, dtype=bool)
    low, high = (Expected.of(right, np.arange(20), likely=np.full(20, p)) for p in (0.6, 0.9))
    assert (low.accuracy, low.low) == (high.accuracy, high.low)
    assert (low.likelihood, high.likelihood) == (pytest.approx(0.6), pytest.approx(0.9))


def test_with_f_empty_the_forecast_is_the_fault_free_accuracy_alone(adapter):
    forecast = adapter.forecast(FaultSet((), D))
    assert list(forecast.stages) == ["fault-free"]
    assert forecast.worst_class is None


def test_the_worst_wires_and_pads_are_listed_and_mapped(adapter, tmp_path):
    from adaptfault.adaptation.worst import worst_faults

    few = Adapter(
        adapter.model, adapter.train.select(slice(0, 60)), adapter.validation.select(slice(0, 60))
    )
    said: list[str] = []
    worst = worst_faults(few, among=2, say=said.append)
    assert any(re.fullmatch(r"1 of \d+, about \d+ s left", text) for text in said)
    assert [len(part) for part in (worst.wires, worst.pairs, worst.pads)] == [16, 1, 2]
    for part in (worst.wires, worst.pairs, worst.pads):
        reached = [loss.expected.likelihood for loss in part]
        assert reached == sorted(reached)
    first, second = worst.wires[:2]
    assert worst.pairs[0].fault_set == first.fault_set | second.fault_set
    stages = few.forecast(first.fault_set).stages
    assert first.expected.accuracy == max(stages[name].accuracy for name in ("fill", "head"))
    assert f"  {first.expected.likelihood:.3f}; {first.expected}  {first.what}" in str(worst)
    json.dumps(worst.to_dict(), allow_nan=False)
    worst.plot().savefig(tmp_path / "worst.png")


# On disk


@pytest.mark.parametrize("fault_set", [F, FaultSet((), D)])
@pytest.mark.parametrize("method", ["fill", "head"])
def test_an_adaptation_comes_back_bit_for_bit(adapter, tmp_path, fault_set, method):
    adapted = adapter.adapt(fault_set, method=method)
    adapted.save(tmp_path / "adapted")
    again = Adaptation.load(tmp_path / "adapted")
    np.testing.assert_array_equal(
        again.predict_proba(adapter.validation.x), adapted.predict_proba(adapter.validation.x)
    )
    assert again.fault_set == fault_set
    assert again.stages == adapted.stages
    assert again.scores == adapted.scores


def test_a_damaged_adaptation_is_refused_in_one_line(adapter, tmp_path):
    with pytest.raises(FileNotFoundError):
        Adaptation.load(tmp_path)
    adapter.adapt(F, method="fill").save(tmp_path)
    manifest = tmp_path / "manifest.json"
    whole = manifest.read_text()
    manifest.write_text(whole.replace('"fault_set"', '"faulty_set"'))
    with pytest.raises(ValueError, match="is damaged") as error:
        Adaptation.load(tmp_path)
    assert "\n" not in str(error.value)
    manifest.write_text(whole)
    weights = next(tmp_path.glob("*.safetensors"))
    weights.write_bytes(weights.read_bytes()[:-1])
    with pytest.raises(ValueError, match="is damaged: its hash"):
        Adaptation.load(tmp_path)


# Bad input


def test_what_cannot_be_adapted_is_said(adapter):
    with pytest.raises(ValueError, match="F is over 220 cells, expected one over 32"):
        adapter.adapt(FaultSet((1,), 220))
    with pytest.raises(ValueError, match="holds all 32 cells"):
        adapter.adapt(FaultSet(range(D), D))
    with pytest.raises(ValueError, match="unknown method 'magic'"):
        adapter.adapt(F, method="magic")
    with pytest.raises(ValueError, match="one set is empty"):
        Adapter(adapter.model, adapter.train.select([]), adapter.validation)
    with pytest.raises(TypeError, match=r"repairs a torch\.nn\.Module, got dict"):
        Adapter({}, adapter.train, adapter.validation)


def test_a_list_of_cells_is_a_fault_set(adapter):
    listed = adapter.adapt([3, 1, 17], method="fill", progress=False)
    assert listed.fault_set == FaultSet((1, 3, 17), D)
    assert adapter.forecast(np.array([3, 1])).fault_set == FaultSet((1, 3), D)
    for wrong in ([-1], [D], [1.5], "13", 3, None, {3: 1}):
        with pytest.raises(ValueError, match="F "):
            adapter.adapt(wrong)


def test_an_adaptation_tells_its_accuracy_by_class_and_sets_of_classes(adapter, tmp_path):
    adapted = adapter.adapt([1, 3, 17], method="head", progress=False)
    scores = adapted.scores
    assert adapted.accuracy == scores.accuracy
    weights = scores.confusion.sum(axis=1) / scores.n
    assert adapted.by_class @ weights == pytest.approx(scores.accuracy)
    x = blobs(400, 5)
    sets = adapted.prediction_sets(x.x)
    assert sets.shape == (400, 3)
    # 0.9 within three standard deviations of 120 validation recordings
    assert sets[np.arange(400), x.y].mean() > 0.8
    wider = adapted.prediction_sets(x.x, alpha=0.02)
    assert (wider >= sets).all()
    adapted.save(tmp_path / "adapted")
    loaded = Adaptation.load(tmp_path / "adapted")
    assert (loaded.prediction_sets(x.x) >= sets).all()
    assert loaded.accuracy == adapted.accuracy
