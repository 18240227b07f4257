"""Takes the step for touch through LeRobot's own pipelines: python tests/check_touch_step.py

LeRobot has to be installed, 0.4.4 as it was written for. Not a test of pytest's: LeRobot brings
gigabytes, and other versions of packages. ``make lerobot-check`` makes an environment for it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.act.processor_act import make_act_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline, ProcessorStepRegistry

import adaptfault as af
from adaptfault.bundle.known_faults import KnownFaults
from adaptfault.lerobot import TouchProcessorStep
from adaptfault.lerobot.limits import NotCertified
from diagnostics import Fault, FaultKind, FaultSet, SelfDiagnosis, SensorLayout

LAYOUT = SensorLayout(2, 6, 5, rate=20.0)
SIDES = ("observation.tactile.left", "observation.tactile.right")
STATE = "observation.state"
ROOM = "observation.environment_state"
DEAD = (7, 31)
FILE = "policy_preprocessor.json"


def make_bundle(path: Path, layout: SensorLayout) -> af.Bundle:
    """Write a bundle whose second version knows of dead cells."""
    grasps = af.simulate(8, layout, n_frames=60, seed=1, classes=("normal", "harder"))
    train, validation, test = af.split(af.make_windows(grasps.frames, grasps.labels, layout))
    model = af.TactileTransformer(layout, 2)
    af.train(model, train, validation, epochs=1)
    adapter = af.Adapter(model, train, validation)
    diagnoser = SelfDiagnosis(layout).fit(grasps.frames)
    bundle = af.Bundle.create(path, model, adapter, diagnoser, check=test)
    deploy(bundle, DEAD)
    return bundle


def deploy(bundle: af.Bundle, cells: tuple[int, ...]) -> None:
    """Deploy a version that knows of these dead cells."""
    known = KnownFaults(bundle.layout.n_cells, (Fault(FaultKind.OPEN, cells),))
    faulty = FaultSet(cells, bundle.layout.n_cells)
    adaptation = bundle.parts.adapter().adapt(faulty, method="fill")
    bundle.deploy(bundle.write_version(adaptation, {"knowledge": known.to_dict()}).number)


def features(shape: tuple[int, ...] = (6, 5)) -> dict[str, PolicyFeature]:
    """Return what a policy declares."""
    touch = {side: PolicyFeature(FeatureType.STATE, shape) for side in SIDES}
    return {STATE: PolicyFeature(FeatureType.STATE, (4,)), **touch}


def policy() -> tuple[ACTConfig, PolicyProcessorPipeline]:
    """Return the configuration of ACT, and its own preprocessor."""
    inputs = {**features(), ROOM: PolicyFeature(FeatureType.ENV, (3,))}
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (4,))}
    config = ACTConfig(
        input_features=inputs,
        output_features=outputs,
        device="cpu",
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        chunk_size=4,
        n_action_steps=4,
    )
    scale = {"mean": torch.full((6, 5), 1.0), "std": torch.full((6, 5), 2.0)}
    stats = dict.fromkeys(SIDES, scale)
    return config, make_act_pre_post_processors(config, stats)[0]


def observation(frames: np.ndarray, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    """Return frames ``[..., D]`` as a batch for a policy."""
    grids = torch.from_numpy(frames).reshape(*frames.shape[:-1], 2, 6, 5).to(dtype)
    touch = {side: grids[..., i, :, :] for i, side in enumerate(SIDES)}
    lead = frames.shape[:-1]
    return {STATE: torch.zeros(*lead, 4), ROOM: torch.ones(*lead, 3), **touch}


@contextmanager
def told(kind: type[Exception], text: str) -> Iterator[None]:
    """Expect an error of one line."""
    said = ""
    try:
        yield
    except kind as error:
        said = str(error)
    assert text in said, f"expected {text!r}, got {said!r}"
    assert "\n" not in said, said
    print(f"told: {said[-150:]}")


def saved_and_read(folder: Path, bundle: af.Bundle, frames: np.ndarray) -> None:
    """Put the step before the others of ACT; save it and read it again, with its state."""
    _, before = policy()
    before.steps.insert(0, TouchProcessorStep(bundle.path))
    before[0].live.remember(FaultSet((3,), 60))
    before.save_pretrained(folder / "policy")
    (first, *_) = json.loads((folder / "policy" / FILE).read_text())["steps"]
    assert first["registry_name"] == "adaptfault_touch"
    assert (folder / "policy" / first["state_file"]).is_file()
    again = PolicyProcessorPipeline.from_pretrained(folder / "policy", FILE)
    one = observation(frames[0])
    given = before(one)
    assert given[STATE].shape == (1, 4)  # LeRobot's own step adds a batch dimension here,
    assert given[SIDES[0]].shape == (6, 5)  # and none to touch
    for name, value in again(one).items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, given[name]), name
    valid = torch.cat([given[f"{side}.valid"].reshape(-1) for side in SIDES])
    assert np.flatnonzero(~valid.numpy()).tolist() == [3, *DEAD]
    scaled = (one[SIDES[0]] - 1) / 2  # ACT's own step scales them after this one
    mask = given[f"{SIDES[0]}.valid"]
    torch.testing.assert_close(given[SIDES[0]][mask], scaled[mask])
    loaded(folder, bundle)


def loaded(folder: Path, bundle: af.Bundle) -> None:
    """Read the pipeline beside other bundles, and after a maintenance."""
    other = make_bundle(folder / "other.bundle", SensorLayout(2, 4, 5, rate=20.0))
    override = {"adaptfault_touch": {"bundle": str(other.path)}}
    with told(ValueError, "is for an array of 2 x 4 x 5, and the policy was saved with one of 2 x"):
        PolicyProcessorPipeline.from_pretrained(folder / "policy", FILE, overrides=override)
    override = {"adaptfault_touch": {"bundle": str(other.path), "shape": None}}
    with told(ValueError, "the saved F is of 60 cells, and"):
        PolicyProcessorPipeline.from_pretrained(folder / "policy", FILE, overrides=override)
    with told(ValueError, "the policy declares no tactile feature; it declares observation.state"):
        before = TouchProcessorStep(bundle.path)
        before.transform_features({PipelineFeatureType.OBSERVATION: {STATE: features()[STATE]}})
    with told(ValueError, "declare 60 cells, and"):
        TouchProcessorStep(other.path).transform_features(
            {PipelineFeatureType.OBSERVATION: features()}
        )
    with told(NotCertified, "must not act: min_recall is 1.0, and"):
        TouchProcessorStep(bundle.path, min_recall=1.0).observation(observation(np.zeros(60)))
    deploy(bundle, DEAD)  # a maintenance run: what was saved before does not count any more
    (step, *_) = PolicyProcessorPipeline.from_pretrained(folder / "policy", FILE).steps
    assert set(step.live.fault_set) == set(DEAD)


def declared(bundle: af.Bundle) -> None:
    """Check what is declared."""
    _, before = policy()
    before.steps.insert(0, TouchProcessorStep(bundle.path))
    out = before.transform_features({PipelineFeatureType.OBSERVATION: features()})
    now = out[PipelineFeatureType.OBSERVATION]
    assert now.items() >= features().items()
    assert {name for name in now if name not in features()} == {f"{side}.valid" for side in SIDES}
    assert all(now[f"{side}.valid"] == now[side] for side in SIDES)


def shapes(bundle: af.Bundle, frames: np.ndarray) -> None:
    """Check each type, and one frame, a batch, and steps of time in it."""
    step = TouchProcessorStep(bundle.path)
    for dtype in (torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int32):
        for count in ((), (1,), (5,), (2, 3)):
            n = int(np.prod(count, dtype=int))
            one = observation(frames[:n].reshape(*count, 60), dtype)
            out = step.observation(dict(one))
            for side in SIDES:
                valid = out[f"{side}.valid"]
                assert out[side].dtype == dtype
                assert out[side].shape == one[side].shape == valid.shape
                assert torch.equal(out[side][valid], one[side][valid])
                assert torch.isfinite(out[side].double()).all()
                assert (~valid).sum() == n


def act_ignores_touch() -> None:
    """Show that ACT takes a feature of touch in its configuration, and never reads it."""
    torch.manual_seed(0)
    config, _ = policy()
    act = ACTPolicy(config).eval()
    batch = observation(np.zeros((1, 60)))
    with torch.no_grad():
        zeros = act.predict_action_chunk(dict(batch))
        ones = act.predict_action_chunk({**batch, **{side: batch[side] + 1 for side in SIDES}})
    assert torch.equal(zeros, ones)
    print("ACT of this LeRobot reads no feature of touch that it is given")


def found_by_lerobot(folder: Path) -> None:
    """Check that LeRobot's commands find the step without an import."""
    code = (
        "from lerobot.utils.import_utils import register_third_party_plugins as find; find();"
        "from lerobot.processor import ProcessorStepRegistry as R; R.get('adaptfault_touch')"
    )
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True)


def passed(folder: Path) -> None:
    """Take the step through everything."""
    assert ProcessorStepRegistry.get("adaptfault_touch") is TouchProcessorStep
    frames = np.concatenate(af.simulate(2, LAYOUT, n_frames=60, seed=2).frames).astype(float)[20:]
    act_ignores_touch()
    bundle = make_bundle(folder / "robot.bundle", LAYOUT)
    declared(bundle)
    shapes(bundle, frames)
    saved_and_read(folder, bundle, frames)
    found_by_lerobot(folder)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        passed(Path(place))
    print("LeRobot registers, declares, saves and reads the step")
