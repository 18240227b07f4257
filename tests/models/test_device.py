"""Everything runs on another device too: tensors that only say they are there, and that refuse to
meet the CPU's."""

import copy
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch import nn
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_map_only

from adaptfault.adaptation.adapter import Adapter
from adaptfault.adaptation.baselines.fault_aware import train_fault_aware
from adaptfault.data.simulated_grasps import simulate
from adaptfault.data.windows import Windows, make_windows
from adaptfault.evaluation.sensitivity import analyse
from adaptfault.models.network import TactileTransformer
from adaptfault.models.store import load_model, save_model
from adaptfault.models.training import train
from adaptfault.paper.bench import Bench, Setup
from adaptfault.paper.settings import Settings, Task, aware
from diagnostics import FaultSet, SensorLayout

LAYOUT = SensorLayout(1, 5, 6, present=np.arange(30).reshape(1, 5, 6) > 0)
AWAY = torch.device("xpu", 0)
MOVES = {"to", "cpu", "copy_", "__set__"}


def away(x: torch.Tensor) -> bool:
    return "away" in vars(x)


class OtherDevice(TorchFunctionMode):
    """Tensors moved to ``AWAY`` stay where they are, but are marked, and so is what is computed of
    them."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        name = getattr(func, "__name__", "")
        tensors = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, torch.Tensor)]
        marked = any(away(x) for x in tensors)
        if getattr(func, "__self__", None) is torch.Tensor.device:
            return AWAY if marked else torch.device("cpu")
        if name in ("_parse_to", "_has_compatible_shallow_copy_type"):
            return func(*args, **kwargs)
        if marked and name in ("numpy", "__array__"):
            raise TypeError("can't convert a tensor of another device to numpy")
        if marked and name not in MOVES and any(x.dim() and not away(x) for x in tensors):
            raise RuntimeError(f"{name}: tensors on two devices")
        devices = [x for x in (*args, *kwargs.values()) if isinstance(x, torch.device)]
        args, kwargs = tree_map_only(torch.device, lambda _: torch.device("cpu"), (args, kwargs))
        out = func(*args, **kwargs)
        if name == "cpu" or devices:
            marked = AWAY in devices
            out = out.clone() if out is args[0] else out  # an object is marked, or it is not
        if name == "__set__" and len(tensors) == 2:
            vars(tensors[0]).pop("away", None)
            marked = away(tensors[1])
            if marked:
                tensors[0].away = True
        if marked and name != "copy_":
            tree_map_only(torch.Tensor, lambda x: setattr(x, "away", True), out)
        return out


@pytest.fixture
def pretended(monkeypatch) -> Iterator[torch.device]:
    plain = nn.Parameter.__deepcopy__

    def deepcopy(self, memo):
        twin = plain(self, memo)
        if away(self):
            twin.away = True
        return twin

    monkeypatch.setattr(nn.Parameter, "__deepcopy__", deepcopy)
    with OtherDevice():
        yield AWAY


@pytest.fixture(
    params=[
        "pretended",
        pytest.param(
            "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
        ),
    ]
)
def elsewhere(request) -> torch.device:
    return (
        request.getfixturevalue("pretended")
        if request.param == "pretended"
        else torch.device("cuda", 0)
    )


def rounding(device: torch.device) -> float:
    """How far probabilities may lie from the CPU's: a GPU may multiply with 10 bits (TF32) in
    convolutions."""
    return 2e-3 if device.type == "cuda" else 1e-5


def windows(n: int, seed: int) -> Windows:
    rng = np.random.default_rng(seed)
    y = rng.integers(0, 2, n)
    x = rng.uniform(0, 0.2, (n, 10, 30)) + 0.3 * (np.arange(30) % 2 == y[:, None])[:, None]
    return Windows(x.astype(np.float32), y, np.arange(n))


def test_another_device_refuses_the_tensors_of_this_one(elsewhere):
    there = torch.ones(3).to(elsewhere)
    here = torch.ones(3)
    assert (there + 1).device == elsewhere
    assert there.cpu().device.type == "cpu"
    with pytest.raises(
        RuntimeError, match="same device" if elsewhere.type == "cuda" else "two devices"
    ):
        there + here
    with pytest.raises(TypeError, match="numpy"):
        there.numpy()


def test_training_there_ends_as_it_ends_here_and_goes_on_from_its_checkpoint(elsewhere, tmp_path):
    data = windows(64, 0)
    held = windows(32, 1)
    options = {"learning_rate": 1e-3, "patience": None, "progress": False}
    models = [TactileTransformer(LAYOUT, 2, init="glorot") for _ in range(2)]
    models[1].to(elsewhere)
    train(models[0], data, held, epochs=2, **options)
    train(models[1], data, held, epochs=1, checkpoint=tmp_path / "run", **options)
    models[1] = TactileTransformer(LAYOUT, 2, init="glorot").to(elsewhere)
    train(models[1], data, held, epochs=2, checkpoint=tmp_path / "run", **options)
    assert {p.device for p in models[1].parameters()} == {elsewhere}
    here, there = (model.predict_proba(held.x) for model in models)
    # Adam moves a weight whose gradient is all rounding by its full rate, 1e-3 in each of 4 steps.
    np.testing.assert_allclose(there, here, atol=0.02)
    save_model(tmp_path / "model", models[1])
    np.testing.assert_allclose(
        load_model(tmp_path / "model").predict_proba(held.x), there, atol=rounding(elsewhere)
    )


def test_fault_aware_and_repairable_training_run_there(elsewhere):
    data = windows(48, 0)
    held = windows(16, 1)
    options = {"epochs": 1, "patience": None, "progress": False}
    model = TactileTransformer(LAYOUT, 2, init="glorot").to(elsewhere)
    assert train_fault_aware(model, data, held, n_samples=32, n_faults=(2,), **options).epochs == 1
    assert train(model, data, held, repairable=True, **options).epochs == 1


def test_single_faults_cost_there_what_they_cost_here(elsewhere):
    data = windows(6, 2)
    model = TactileTransformer(LAYOUT, 2, init="glorot", padding="valid")
    here = analyse(model, data)
    there = analyse(copy.deepcopy(model).to(elsewhere), data)
    np.testing.assert_allclose(
        there.confidence_lost, here.confidence_lost, atol=rounding(elsewhere)
    )
    np.testing.assert_allclose(there.gradient, here.gradient, atol=rounding(elsewhere))
    assert {wire.line for wire in here.wires} == {wire.line for wire in there.wires}


def test_an_adapter_works_on_the_cpu_wherever_the_model_is(elsewhere):
    data = windows(64, 0)
    held = windows(32, 1)
    faults = FaultSet((3, 8, 20), 30)
    model = TactileTransformer(LAYOUT, 2, init="glorot").to(elsewhere)
    adaptation = Adapter(model, data, held).adapt(faults, method="head", progress=False)
    assert adaptation.predict(held.x).shape == (32,)
    assert model.head.weight.device == elsewhere


@pytest.mark.slow
def test_the_papers_networks_are_trained_there_and_answer_as_those_trained_here(
    elsewhere, tmp_path
):
    grasps = simulate(
        6, SensorLayout(2, 6, 5), n_frames=30, seed=1, classes=("nothing", "softer", "harder")
    )
    data = make_windows(grasps.frames, grasps.labels, grasps.layout)
    settings = Settings(
        seeds=(0,), epochs=1, patience=None, samples=(32,), warm=True, aware_epochs=1, windows=2
    )
    tasks = [Task(4, 0, "mixed", 5, aware(32, kind)) for kind in ("cells", "none", "blocks")]
    tasks.append(Task(5, 0, "mixed", 5, "trained anew"))
    answers = []
    for device in ("cpu", elsewhere):
        bench = Bench(
            Setup(grasps, data, settings, tmp_path / str(device), device, False, lambda text: None),
            0,
        )
        answers.append(np.concatenate([bench.predict(task) for task in tasks]))
    # rounding may decide a close call
    assert (answers[0] == answers[1]).mean() > (0.9 if elsewhere.type == "cuda" else 0.95)
