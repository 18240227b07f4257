"""Policies: touch and other inputs to chunks of actions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

import adaptfault as af
from adaptfault.adaptation.adapter import Adapter
from adaptfault.adaptation.result import Adaptation
from adaptfault.bundle.bundle import Bundle
from adaptfault.data.windows import Windows, make_windows, split
from adaptfault.models import builders
from diagnostics import FaultSet, SelfDiagnosis, SensorLayout

LAYOUT = SensorLayout(2, 3, 4)
D = LAYOUT.n_cells
F = FaultSet((1, 6, 7, 15), D)
CHUNK = (5, 2)


class Chunks(nn.Module):
    """Touch and joints to a chunk of actions ``[N, 5, 2]``; its last layer acts for each step."""

    def __init__(self) -> None:
        super().__init__()
        self.see = nn.Linear(D, 16)
        self.tell = nn.Linear(3, 16)
        self.step = nn.Embedding(CHUNK[0], 16)
        self.last = nn.Linear(16, CHUNK[1])

    def forward(self, touch: Tensor, joints: Tensor) -> Tensor:
        both = self.see(touch.mean(1)) + self.tell(joints)
        return self.last(torch.tanh(both[:, None] + self.step.weight))


class OfDict(nn.Module):
    """The same policy, from one dict of inputs."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = Chunks()

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        return self.inner(batch["observation.tactile"], batch["observation.state"])


class Shaped(nn.Module):
    """Actions of any shape, of the mean frame and the joints."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.shape_of_actions = shape
        self.last = nn.Linear(D + 3, int(np.prod(shape)))

    def forward(self, touch: Tensor, joints: Tensor) -> Tensor:
        flat = self.last(torch.cat([touch.mean(1), joints], dim=1))
        return flat.unflatten(1, self.shape_of_actions)


def observed(episodes: int, shape: tuple[int, ...] = CHUNK, *, first: int = 0) -> Windows:
    """Return six windows an episode. One press is seen by all cells, each with its gain; the
    actions are multiples of the press and of a joint."""
    rng = np.random.default_rng(first)
    n = 6 * episodes
    press = rng.uniform(0, 1, (n, 1, 1))
    gain = np.random.default_rng(7).uniform(0.3, 0.9, D)
    touch = press * gain * np.ones((1, 4, 1)) + rng.normal(0, 0.01, (n, 4, D))
    joints = rng.normal(size=(n, 3))
    of_press = np.random.default_rng(8).normal(size=shape)
    of_joint = np.random.default_rng(9).normal(size=shape)
    actions = press[:, 0].reshape(-1, *[1] * len(shape)) * of_press
    actions = actions + 0.3 * joints[:, 0].reshape(-1, *[1] * len(shape)) * of_joint
    episode = first + np.repeat(np.arange(episodes), 6)
    return Windows(touch.clip(0, 1), actions, episode, {"joints": joints})


def renamed(windows: Windows) -> Windows:
    return replace(windows, extra={"observation.state": windows.extra["joints"]})


@pytest.fixture(scope="module")
def policy() -> Chunks:
    torch.manual_seed(0)
    policy = Chunks()
    training = observed(40)
    validation = observed(10, first=100)
    af.train(policy, training, validation, epochs=40, learning_rate=1e-2, progress=False)
    return policy


@pytest.fixture(scope="module")
def adapter(policy: Chunks) -> Adapter:
    return Adapter(policy, observed(40), observed(10, first=100), layout=LAYOUT)


@pytest.fixture(scope="module")
def test_episodes() -> Windows:
    return observed(20, first=200)


def broken(windows: Windows) -> Windows:
    x = windows.x.copy()
    x[..., F.mask] = 1.0
    return replace(windows, x=x)


def of_policy(policy: nn.Module, windows: Windows) -> np.ndarray:
    with torch.no_grad():
        joints = torch.from_numpy(windows.extra["joints"]).float()
        return policy(torch.from_numpy(windows.x), joints).numpy()


def test_a_policy_learns_chunks_from_touch_and_other_inputs(policy, test_episodes):
    assert af.evaluate(policy, test_episodes).r2 > 0.9


def test_with_f_empty_the_actions_are_those_of_the_policy_bit_for_bit(
    adapter, policy, test_episodes
):
    adapted = adapter.adapt([], method="fill")
    actions = adapted.predict(test_episodes.x, **test_episodes.extra)
    np.testing.assert_array_equal(actions, of_policy(policy, test_episodes))


@pytest.mark.parametrize("method", ["fill", "head", "finetune", "auto"])
def test_a_repaired_policy_acts_nearly_as_before(method, adapter, policy, test_episodes):
    adapted = adapter.adapt(F, method=method, progress=False)
    worse = broken(test_episodes)
    assert adapted.predict(worse.x, **worse.extra).shape == (len(worse), *CHUNK)
    healthy = af.evaluate(policy, test_episodes).r2
    assert af.evaluate(policy, worse).r2 < healthy - 0.2
    assert af.evaluate(adapted, worse).r2 > healthy - 0.05


def test_what_the_faulty_cells_read_does_not_matter(adapter, test_episodes):
    adapted = adapter.adapt(F, method="head")
    worse = broken(test_episodes)
    np.testing.assert_array_equal(
        adapted.predict(worse.x, **worse.extra),
        adapted.predict(test_episodes.x, **test_episodes.extra),
    )


@pytest.mark.parametrize("method", ["fill", "head", "finetune"])
def test_other_inputs_count_after_the_repair_and_pass_through_unchanged(
    method, adapter, test_episodes
):
    seen = []
    adapted = adapter.adapt(F, method=method, progress=False)
    module = adapted.model.network.module
    hook = module.register_forward_pre_hook(
        lambda _, args, others: seen.append(others["joints"]), with_kwargs=True
    )
    actions = adapted.predict(test_episodes.x, **test_episodes.extra)
    hook.remove()
    joints = test_episodes.extra["joints"].astype(np.float32)
    np.testing.assert_array_equal(torch.cat(seen).numpy(), joints)
    other = adapted.predict(test_episodes.x, joints=joints + 1)
    assert not np.allclose(actions, other)


def test_a_policy_of_a_dict_is_repaired_as_one_of_names(adapter, policy, test_episodes):
    of_dict = OfDict()
    of_dict.inner.load_state_dict(policy.state_dict())
    named = Adapter(
        of_dict,
        renamed(observed(40)),
        renamed(observed(10, first=100)),
        layout=LAYOUT,
        touch="observation.tactile",
    )
    windows = renamed(test_episodes)
    for method in ("fill", "head"):
        expected = adapter.adapt(F, method=method).predict(test_episodes.x, **test_episodes.extra)
        actions = named.adapt(F, method=method).predict(windows.x, **windows.extra)
        np.testing.assert_allclose(actions, expected, rtol=1e-4, atol=1e-5)


@settings(max_examples=12, deadline=None)
@given(
    shape=st.lists(st.integers(1, 3), min_size=1, max_size=3).map(tuple),
    faults=st.sets(st.integers(0, D - 1), max_size=D - 1),
)
def test_actions_of_any_shape_are_repaired_in_that_shape(shape, faults):
    torch.manual_seed(0)
    policy = Shaped(shape)
    validation = observed(3, shape, first=100)
    adapter = Adapter(policy, observed(6, shape), validation, layout=LAYOUT)
    adapted = adapter.adapt(sorted(faults), method="fill")
    actions = adapted.predict(validation.x, **validation.extra)
    assert actions.shape == (len(validation), *shape)
    before = of_policy(policy, validation)
    if not faults:
        np.testing.assert_array_equal(actions, before)


def test_a_repair_is_told_by_episodes(adapter):
    """Windows of an episode are alike: three times as many of them tell no more."""
    validation = adapter.validation
    thrice = np.repeat(np.arange(len(validation)), 3)
    forecast = adapter.forecast(F)
    again = Adapter(
        adapter.model, observed(40), observed(10, first=100).select(thrice), layout=LAYOUT
    )
    width = [f.stages["fill"].high - f.stages["fill"].low for f in (forecast, again.forecast(F))]
    assert width[1] == pytest.approx(width[0], rel=0.1)
    assert forecast.stages["fill"].low < forecast.stages["fill"].accuracy


def test_a_loss_of_actions_gets_their_shape(policy):
    shapes = []

    def loss(outputs: Tensor, y: Tensor) -> Tensor:
        shapes.append((outputs.shape[1:], y.shape[1:]))
        return nn.functional.l1_loss(outputs, y)

    adapter = Adapter(policy, observed(8), observed(4, first=100), layout=LAYOUT, loss=loss)
    adapter.adapt(F, method="finetune", progress=False)
    assert set(shapes) == {(CHUNK, CHUNK)}


def test_a_repaired_policy_is_stored(adapter, test_episodes, tmp_path):
    adapted = adapter.adapt(F, method="head")
    adapted.save(tmp_path / "adapted")
    again = Adaptation.load(tmp_path / "adapted", network=Chunks())
    np.testing.assert_array_equal(
        again.predict(test_episodes.x, **test_episodes.extra),
        adapted.predict(test_episodes.x, **test_episodes.extra),
    )


def build(layout: SensorLayout, n_classes: int, length: int) -> nn.Module:
    return Chunks()


def test_an_adapter_of_a_policy_comes_back_from_a_folder(
    policy, test_episodes, tmp_path, monkeypatch
):
    name = f"{__name__}:build"
    monkeypatch.setattr(builders, "_allowed", {name})
    built = builders.build_model(name, LAYOUT, 10, length=4)
    built.load_state_dict(policy.state_dict())
    adapter = Adapter(built, observed(40), observed(10, first=100), layout=LAYOUT)
    af.save_adapter(tmp_path / "adapter", adapter)
    again = af.load_adapter(tmp_path / "adapter")
    expected = adapter.adapt(F, method="fill").predict(test_episodes.x, **test_episodes.extra)
    actions = again.adapt(F, method="fill").predict(test_episodes.x, **test_episodes.extra)
    # readings are stored with 12 bits
    np.testing.assert_allclose(actions, expected, atol=0.02)


def test_windows_are_cut_from_all_inputs_alike_and_split_by_episode():
    rng = np.random.default_rng(0)
    lengths = (11, 12, 13, 14)
    touch = [rng.random((n, D)) for n in lengths]
    joints = [np.arange(3 * n).reshape(n, 3) for n in lengths]
    actions = [np.full((n, *CHUNK), i, float) for i, n in enumerate(lengths)]
    windows = make_windows(touch, actions, LAYOUT, length=4, stride=1, extra={"joints": joints})
    assert windows.y.shape == (len(windows), *CHUNK)
    assert windows.extra["joints"].shape == (len(windows), 4, 3)
    np.testing.assert_array_equal(windows.y[:, 0, 0], windows.recording)
    np.testing.assert_array_equal(windows.extra["joints"][2], joints[0][2:6])
    parts = split(windows, test=0.25, validation=0.25)
    episodes = [set(part.recording.tolist()) for part in parts]
    assert sum(map(len, episodes)) == len(set.union(*episodes)) == 4


class Blind(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.last = nn.Linear(3, 10)

    def forward(self, touch: Tensor, joints: Tensor) -> Tensor:
        return self.last(joints).unflatten(1, CHUNK)


def refused(policy: nn.Module, training: Windows, validation: Windows, **options) -> str:
    with pytest.raises(ValueError, match=r"\A[^\n]+\Z") as error:
        Adapter(policy, training, validation, layout=LAYOUT, **options)
    return str(error.value)


def test_bad_input_is_told_in_one_line(policy, adapter):
    training = observed(8)
    validation = observed(4, first=100)
    assert "Blind does not use touch" in refused(Blind(), training, validation)
    renamed_touch = refused(OfDict(), renamed(training), renamed(validation), touch="touch")
    assert "OfDict fails on windows" in renamed_touch
    assert "'observation.tactile'" in renamed_touch
    same = replace(validation, recording=validation.recording - 100)
    assert "episode 0 is in training and in validation" in refused(policy, training, same)
    fewer = replace(validation, y=validation.y[:, :3])
    assert "returns actions [N, 5, 2], the targets are [24, 3, 2]" in refused(
        policy, training, fewer
    )
    lacking = replace(validation, extra={})
    assert "validation windows []" in refused(policy, training, lacking)
    holes = {"joints": np.full((24, 3), np.nan)}
    assert "input 'joints'" in refused(policy, training, replace(validation, extra=holes))
    with pytest.raises(ValueError, match=r"^a bundle holds a classifier.*touch alone: store"):
        Bundle.create("nowhere.bundle", adapter.model, adapter, SelfDiagnosis(LAYOUT))
    with pytest.raises(ValueError, match=r"^F is over 23 cells, .*24"):
        adapter.adapt(FaultSet((1,), 23))


def test_inputs_and_episodes_of_another_length_are_told():
    windows = observed(2)
    with pytest.raises(ValueError, match=r"need the input 'joints' of shape \[12, \.\.\.\]"):
        replace(windows, extra={"joints": np.zeros((5, 3))})
    with pytest.raises(ValueError, match=r"need recording of shape \[12\], got \[3\]"):
        replace(windows, recording=np.arange(3))
