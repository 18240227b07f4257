"""Adaptation of models of any architecture, and of regressions."""

import numpy as np
import pytest
import torch
from torch import nn

from adaptfault.adaptation.adapter import Adapter
from adaptfault.adaptation.result import Adaptation
from adaptfault.data.windows import Windows
from adaptfault.evaluation.scores import ValueScores, evaluate
from adaptfault.models.network import logits_of
from adaptfault.models.training import train
from diagnostics import FaultSet, SensorLayout

LAYOUT = SensorLayout(2, 4, 4)
D = LAYOUT.n_cells
T = 6
F = FaultSet((0, 5, 6, 7, 21, 22), D)


def presses(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Windows, and the place ``[n, 2]`` of their press."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform(0, 3, (n, 2))
    rows, cols = np.mgrid[:4, :4]
    distance = (rows - centre[:, :1, None]) ** 2 + (cols - centre[:, 1:, None]) ** 2
    press = rng.uniform(0.2, 0.5, (n, 1, 1, 1, 1)) * np.exp(-distance / 2)[:, None, None]
    x = press * np.linspace(0.5, 1, T)[:, None, None, None] * np.ones((1, 1, 2, 1, 1))
    return np.maximum(x + rng.normal(0, 0.004, x.shape), 0).reshape(n, T, D).astype(
        np.float32
    ), centre


def classes(n: int, seed: int) -> Windows:
    x, centre = presses(n, seed)
    return Windows(x, np.digitize(centre[:, 0], [1, 2]), np.arange(n))


def values(n: int, seed: int) -> Windows:
    x, centre = presses(n, seed)
    return Windows(x, 10 + 5 * centre, np.arange(n))


class Recurrent(nn.Module):
    def __init__(self, n: int) -> None:
        super().__init__()
        self.lstm = nn.LSTM(D, 24, batch_first=True)
        self.last = nn.Linear(24, n)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.last(self.lstm(x)[0][:, -1])


class Convolutional(nn.Module):
    """Takes [N, C, T, H, W] inside."""

    def __init__(self, n: int) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Conv3d(2, 8, 3, padding=1), nn.ReLU(), nn.AdaptiveAvgPool3d((1, 4, 4))
        )
        self.last = nn.Linear(8 * 16, n)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.last(self.net(x.reshape(-1, T, 2, 4, 4).transpose(1, 2)).flatten(1))


class Attention(nn.Module):
    def __init__(self, n: int) -> None:
        super().__init__()
        self.embed = nn.Linear(D, 16)
        self.encoder = nn.TransformerEncoderLayer(16, 2, 32, batch_first=True)
        self.last = nn.Linear(16, n)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.last(self.encoder(self.embed(x)).mean(1))


class Frozen(nn.Module):
    """No parameter is trainable, and no layer is linear: class scores are distances to
    templates."""

    def __init__(self, windows: Windows) -> None:
        super().__init__()
        mean = [windows.x[windows.y == c].mean((0, 1)) for c in range(3)]
        self.templates = nn.Parameter(torch.tensor(np.stack(mean)), requires_grad=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return -20 * torch.cdist(x.mean(1), self.templates)


class Lost(nn.Module):
    """Training diverged: every output is NaN."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.mean(1)[:, :3] * torch.nan


@pytest.fixture(scope="module")
def training() -> Windows:
    return classes(240, 0)


@pytest.fixture(scope="module")
def validation() -> Windows:
    return classes(100, 1)


@pytest.fixture(scope="module", params=[Recurrent, Convolutional, Attention])
def trained(request, training, validation) -> nn.Module:
    torch.manual_seed(0)
    model = request.param(3)
    train(model, training, validation, epochs=25, learning_rate=1e-2, patience=None, progress=False)
    assert evaluate(model, validation).accuracy > 0.8
    return model


def broken(windows: Windows) -> Windows:
    x = windows.x.copy()
    x[..., list(F)] = 1.0
    return Windows(x, windows.y, windows.recording)


@pytest.mark.filterwarnings("ignore:.*nested tensors")
def test_recurrent_convolutional_and_attention_models_are_repaired(trained, training, validation):
    adapter = Adapter(trained, training, validation, layout=LAYOUT)
    test = broken(classes(200, 2))
    fault_free = evaluate(trained, classes(200, 2)).accuracy
    for method in ("fill", "head"):
        adapted = adapter.adapt(F, method=method)
        assert adapted.stages[-1].name == method
        assert evaluate(adapted, test).accuracy > max(
            evaluate(trained, test).accuracy, fault_free - 0.12
        )
    assert adapter.forecast(F).stages["head"].accuracy == pytest.approx(adapted.scores.accuracy)


def test_finetuning_and_training_anew_leave_the_given_model_unchanged(
    training, validation, monkeypatch
):
    monkeypatch.setattr("adaptfault.adaptation.stages._ROUNDS", 1)
    monkeypatch.setattr("adaptfault.adaptation.stages._SCRATCH_EPOCHS", 1)
    torch.manual_seed(0)
    model = Recurrent(3)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    adapter = Adapter(model, training, validation, layout=LAYOUT)
    assert adapter.adapt(F, method="finetune").stages[-1].name == "finetune"
    scratch = adapter.adapt(F, method="scratch", seed=3)
    assert not torch.equal(scratch.model.network.module.last.weight, model.last.weight)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


def test_the_given_loss_is_the_one_that_is_trained(training, validation):
    calls = []

    def loss(outputs: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        calls.append(tuple(outputs.shape))
        return nn.functional.multi_margin_loss(outputs, y)

    train(Recurrent(3), training, validation, epochs=1, loss=loss, progress=False)
    assert (32, 3) in calls


def test_a_frozen_model_without_linear_layer_is_repaired_by_the_fill(training, validation):
    model = Frozen(training)
    adapter = Adapter(model, training, validation, layout=LAYOUT)
    test = broken(classes(200, 2))
    adapted = adapter.adapt(F)
    assert evaluate(adapted, test).accuracy > evaluate(model, test).accuracy + 0.2
    with pytest.raises(
        ValueError, match="Frozen has no linear layer to take features from: name a layer"
    ):
        adapter.adapt(F, method="head")
    with pytest.raises(ValueError, match="Frozen has no trainable parameters"):
        adapter.adapt(F, method="scratch")


def test_features_are_a_layer_or_a_function_of_the_model_and_the_windows(training, validation):
    model = Frozen(training)
    given = Adapter(
        model, training, validation, layout=LAYOUT, features=lambda module, x: module(x).detach()
    )
    assert given.adapt(F, method="head").stages[-1].name == "head"
    torch.manual_seed(0)
    recurrent = Recurrent(3)
    named = Adapter(recurrent, training, validation, layout=LAYOUT, features="lstm")
    x = torch.from_numpy(training.x[:5])
    with torch.no_grad():
        torch.testing.assert_close(named.model.features(x), recurrent.lstm(x)[0].mean(1))
        found = Adapter(recurrent, training, validation, layout=LAYOUT).model.features(x)
        torch.testing.assert_close(found, recurrent.lstm(x)[0][:, -1])


def test_an_adaptation_of_any_model_comes_back_into_an_instance_of_it(
    training, validation, tmp_path
):
    torch.manual_seed(0)
    adapted = Adapter(Recurrent(3), training, validation, layout=LAYOUT).adapt(F, method="head")
    adapted.save(tmp_path)
    again = Adaptation.load(tmp_path, network=Recurrent(3))
    np.testing.assert_array_equal(
        again.predict_proba(validation.x), adapted.predict_proba(validation.x)
    )
    with pytest.raises(
        ValueError, match=r"the model is a .*Recurrent: give an instance of it as network="
    ):
        Adaptation.load(tmp_path)


def test_a_regression_is_repaired_and_scored_by_r2_and_mean_absolute_error(tmp_path):
    training = values(300, 0)
    validation = values(120, 1)
    test = values(200, 2)
    torch.manual_seed(0)
    model = Recurrent(2)
    train(model, training, validation, epochs=40, learning_rate=1e-2, patience=None, progress=False)
    adapter = Adapter(model, training, validation, layout=LAYOUT)
    assert adapter.task == "regression"
    x = test.x.copy()
    x[..., list(F)] = 1.0
    harmed = ValueScores.of(test.y, logits_of(model, x).numpy())
    adapted = adapter.adapt(F, method="head")
    scores = ValueScores.of(test.y, adapted.predict(x))
    assert scores.r2 > max(0.9, harmed.r2)
    assert scores.r2 == pytest.approx(adapted.scores.r2, abs=0.08)
    np.testing.assert_allclose(scores.mae, np.abs(adapted.predict(x) - test.y).mean(0), rtol=1e-6)
    expected = adapter.forecast(F).stages["head"]
    assert expected.low < expected.accuracy == pytest.approx(adapted.scores.r2, abs=1e-6)
    adapted.save(tmp_path)
    np.testing.assert_array_equal(
        Adaptation.load(tmp_path, network=Recurrent(2)).predict(x), adapted.predict(x)
    )
    with pytest.raises(ValueError, match="no class probabilities"):
        adapted.predict_proba(x)


@pytest.mark.parametrize(
    ("model", "options", "message"),
    [
        (nn.Flatten(), {}, "Flatten has no layout: give layout="),
        (nn.Flatten(), {"layout": SensorLayout(1, 4, 4)}, "has 16 cells, the windows have 32"),
        (nn.Linear(7, 3), {"layout": LAYOUT}, r"Linear fails on windows of shape \[3, 6, 32\]"),
        (
            nn.Linear(D, 3),
            {"layout": LAYOUT},
            r"returns \[3, 6, 3\] for windows .* expected \[3, n\]",
        ),
        (
            nn.Sequential(nn.Flatten(), nn.Linear(T * D, 2)),
            {"layout": LAYOUT},
            r"Sequential has 2 outputs, labels run to 2: give a model with at least 3",
        ),
        (
            Recurrent(3),
            {"layout": LAYOUT, "features": "neck"},
            r"features 'neck' of Recurrent .* \(lstm, last\)",
        ),
        (
            Recurrent(3),
            {"layout": LAYOUT, "features": nn.Module.state_dict},
            "features 'state_dict' of Recurrent are not",
        ),
        (
            Lost(),
            {"layout": LAYOUT},
            "Lost returns NaN or infinity .*: give a model with finite weights",
        ),
        (
            Recurrent(3),
            {"layout": LAYOUT, "task": "regression"},
            r"task 'regression' needs y float \[N, k\]",
        ),
        (
            Recurrent(3),
            {"layout": LAYOUT, "loss": nn.MSELoss()},
            r"the loss fails on outputs \[4, 3\] and y \[4\]",
        ),
        (
            Recurrent(3),
            {"layout": LAYOUT, "loss": nn.CrossEntropyLoss(reduction="none")},
            r"the loss of outputs \[4, 3\] and y \[4\] is \[4\]: expected a scalar",
        ),
    ],
)
def test_what_cannot_be_adapted_is_said_before_any_work(
    model, options, message, training, validation
):
    with pytest.raises(ValueError, match=message) as error:
        Adapter(model, training, validation, **options)
    assert "\n" not in str(error.value)


def test_windows_of_which_no_model_can_learn_are_refused(training, validation):
    longer = Windows(np.repeat(validation.x, 2, axis=1), validation.y, validation.recording)
    with pytest.raises(
        ValueError, match=r"training windows are \[6, 32\], validation windows \[12, 32\]"
    ):
        Adapter(Recurrent(3), training, longer, layout=LAYOUT)
    unknown = Windows(
        np.where(training.x > 0.3, np.nan, training.x), training.y, training.recording
    )
    for parts in ((unknown, validation), (training, unknown)):
        with pytest.raises(ValueError, match="windows hold NaN or infinity: make_windows") as error:
            Adapter(Recurrent(3), *parts, layout=LAYOUT)
        assert "\n" not in str(error.value)


def test_outputs_that_do_not_fit_the_values_are_refused():
    with pytest.raises(
        ValueError, match="Recurrent has 3 outputs, the targets 2 values: give a model with 2"
    ):
        Adapter(Recurrent(3), values(10, 0), values(10, 1), layout=LAYOUT)


def build(layout: SensorLayout, n_classes: int, length: int) -> nn.Module:
    torch.manual_seed(0)
    return Recurrent(n_classes)


@pytest.mark.slow
def test_a_bundle_of_a_built_model_is_maintained_and_opens_only_where_its_builder_is_allowed(
    training, validation, tmp_path, monkeypatch
):
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.models import builders
    from adaptfault.robot.maintenance import maintain
    from diagnostics import Fault, FaultKind, SelfDiagnosis, inject

    name = f"{__name__}:build"
    monkeypatch.setattr(builders, "_allowed", set())
    monkeypatch.delenv(builders.VARIABLE, raising=False)
    with pytest.raises(ValueError, match="which is not allowed: call allow_model"):
        builders.build_model(name, LAYOUT, 3, length=T)
    builders.allow_model(name)
    model = builders.build_model(name, LAYOUT, 3, length=T)
    train(model, training, validation, epochs=15, learning_rate=1e-2, patience=None, progress=False)
    adapter = Adapter(model, training, validation, layout=LAYOUT)
    recordings = [5 * x.astype(float) for x in training.x]
    diagnoser = SelfDiagnosis(LAYOUT).fit(recordings)
    bundle = Bundle.create(tmp_path / "b", adapter.model, adapter, diagnoser, check=classes(60, 5))
    dead = [Fault(FaultKind.SHORT, (cell,)) for cell in (5, 21)]
    report = maintain(
        bundle, [inject(5 * x.astype(float), dead, LAYOUT) for x in classes(150, 6).x]
    )
    assert report.decision in ("deployed", "kept")
    assert set(report.diagnosis.fault_set) >= {5, 21}
    monkeypatch.setattr(builders, "_allowed", set())
    with pytest.raises(
        builders.ModelNotAllowed, match=r"^the model is built by .* which is not allowed"
    ) as error:
        Bundle.open(tmp_path / "b").parts.adapter()
    assert "\n" not in str(error.value)
    monkeypatch.setenv(builders.VARIABLE, f"other:build, {name}")
    assert Bundle.open(tmp_path / "b").parts.adapter().model.length == T


def test_what_cannot_be_built_or_stored_is_said(training, validation, tmp_path, monkeypatch):
    from adaptfault.adaptation.adapter_files import save_adapter
    from adaptfault.models import builders

    monkeypatch.setattr(builders, "_allowed", {"json:dumps", "json:no", f"{__name__}:classes"})
    with pytest.raises(ValueError, match="expected an import path"):
        builders.allow_model("rm -rf")
    with pytest.raises(ValueError, match="cannot be imported"):
        builders.build_model("json:no", LAYOUT, 3)
    with pytest.raises(
        ValueError, match=r"classes' fails: .* it is called with \(layout, n_classes, length\)"
    ) as error:
        builders.build_model(f"{__name__}:classes", LAYOUT, 3)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="cannot be rebuilt from a file: make it with build_model"):
        save_adapter(tmp_path, Adapter(Recurrent(3), training, validation, layout=LAYOUT))


def test_the_command_line_trains_a_model_of_the_user_and_adapts_it(
    small_grasps, tmp_path, monkeypatch, capsys
):
    from adaptfault.cli import main
    from adaptfault.data.recordings import save_npz
    from adaptfault.models import builders

    source = (
        "from torch import nn\n"
        "def build(layout, n_classes, length):\n"
        "    return nn.Sequential(nn.Flatten(), nn.Linear(length * layout.n_cells, 16), nn.ReLU(),"
        " nn.Linear(16, n_classes))\n"
    )
    (tmp_path / "own_network.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(builders, "_allowed", set())
    data = str(tmp_path / "grasps.npz")
    model = str(tmp_path / "model")
    save_npz(data, small_grasps)
    command = [
        "train",
        data,
        "--out",
        model,
        "--epochs",
        "3",
        "--quiet",
        "--model",
        "own_network:build",
    ]
    assert main([*command, "--learning-rate", "0"]) == 3
    assert (
        "training needs epochs, batch_size, learning_rate > 0, got 3, 32, 0.0"
        in capsys.readouterr().err
    )
    assert main([*command, "--learning-rate", "0.01"]) == 0
    adapt = ["adapt", model, data, "--faults", "3,8", "--out", str(tmp_path / "adapted"), "--quiet"]
    assert main(adapt) == 0
    assert (
        Adaptation.load(tmp_path / "adapted").model.network.config["builder"] == "own_network:build"
    )
    monkeypatch.setattr(builders, "_allowed", set())
    capsys.readouterr()
    assert main(adapt) == 3
    assert capsys.readouterr().err.count("\n") == 1
    assert main([*command[:-1], "own_network:lost"]) == 3
    assert "install its package or set PYTHONPATH" in capsys.readouterr().err


def test_a_regression_has_an_accuracy_but_no_classes():
    model = Recurrent(2)
    adapted = Adapter(model, values(80, 0), values(40, 1), layout=LAYOUT).adapt(F, progress=False)
    assert adapted.accuracy == adapted.scores.r2
    with pytest.raises(ValueError, match="a regression has no classes"):
        _ = adapted.by_class
    with pytest.raises(ValueError, match="a regression has no sets of classes"):
        adapted.prediction_sets(values(5, 2).x)
