"""A robot's sensor as a profile for a simulator: what it reads, and that a diagnosis finds its F
again."""

import json

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptfault.bench.profile import SensorProfile
from adaptfault.bench.score import Score
from adaptfault.bench.simulators import MujocoTactile, genesis_options, simulated_log
from adaptfault.schemas import schema_of
from diagnostics import Fault, FaultKind, Line, SelfDiagnosis, SensorLayout, line_fault

LAYOUT = SensorLayout(2, 4, 5)
D = LAYOUT.n_cells
cells = st.integers(0, D - 1)
kinds = st.sampled_from([FaultKind.OPEN, FaultKind.SHORT, FaultKind.NOISY, FaultKind.LATE])


@st.composite
def profiles(draw):
    """Draw a sensor of the layout."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    faults = tuple(Fault(draw(kinds), (cell,)) for cell in draw(st.sets(cells, max_size=3)))
    return SensorProfile(
        LAYOUT,
        faults,
        rest=rng.uniform(0, 0.1, D),
        gain=rng.uniform(0.5, 1.5, D),
        offset=rng.uniform(-0.05, 0.05, D),
        noise=np.full(D, draw(st.sampled_from([0.0, 0.01]))),
        crosstalk=np.full((2, 2), draw(st.sampled_from([0.0, 0.3]))),
        step=draw(st.sampled_from([0.0, 0.05])),
    )


@given(profiles(), st.integers(0, 100))
def test_a_profile_is_as_its_schema_says_and_reads_the_same_when_it_was_written(profile, seed):
    document = json.loads(json.dumps(profile.to_dict()))
    jsonschema.Draft202012Validator(schema_of(document["schema"])).validate(document)
    again = SensorProfile.from_dict(document)
    loads = np.random.default_rng(seed).uniform(0, 5, (7, D))
    np.testing.assert_array_equal(again.apply(loads, seed=seed), profile.apply(loads, seed=seed))
    for name in document:
        with pytest.raises(ValueError, match=r"is missing|expected schema"):
            SensorProfile.from_dict({key: v for key, v in document.items() if key != name})


@given(profiles(), st.integers(0, 100))
def test_readings_are_whole_steps_within_the_range_and_dead_cells_do_not_hear_the_load(
    profile, seed
):
    rng = np.random.default_rng(seed)
    loads, others = rng.uniform(0, 5, (2, 9, D))
    read = profile.apply(loads, seed=seed)
    assert read.min() >= 0
    assert read.max() <= LAYOUT.full_scale
    if profile.step:
        steps = read / profile.step
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
    dead = [f.cells[0] for f in profile.faults if f.kind in (FaultKind.OPEN, FaultKind.SHORT)]
    np.testing.assert_array_equal(read[:, dead], profile.apply(others, seed=seed)[:, dead])


@given(st.integers(0, 100))
def test_a_healthy_profile_changes_nothing(seed):
    loads = np.random.default_rng(seed).uniform(0, 5, (5, D))
    np.testing.assert_array_equal(SensorProfile.healthy(LAYOUT).apply(loads), loads)


def test_the_terms_are_those_of_the_formula():
    loads = np.zeros((1, D))
    loads[0, LAYOUT.cell(0, 1, 2)] = 2.0
    zeros = np.zeros(D)
    share = np.array([[0.5, 0.0], [0.25, 0.0]])
    profile = SensorProfile(LAYOUT, (), zeros + 0.1, zeros + 2.0, zeros + 0.3, zeros, share)
    read = LAYOUT.grid(profile.apply(loads))[0]
    assert read[0, 1, 2] == pytest.approx(2.0 * (0.1 + 2.0) + 0.3)
    assert read[0, 1, 0] == pytest.approx(2.0 * (0.1 + 0.5 * 2.0) + 0.3)
    assert read[0, 3, 2] == pytest.approx(2.0 * (0.1 + 0.25 * 2.0) + 0.3)
    np.testing.assert_allclose(read[1], 0.5)


def test_a_diagnosis_of_simulated_frames_finds_f_again_and_the_same_profile(fitted, grasps):
    layout = grasps.layout
    row = line_fault(layout, Line(1, "row", 5), FaultKind.OPEN)
    faults = (row, Fault(FaultKind.STUCK, (44,), value=1.25), Fault(FaultKind.SHORT, (7,)))
    healthy = SensorProfile.healthy(layout)
    given_ = SensorProfile(
        layout, faults, healthy.rest, healthy.gain, healthy.offset, healthy.noise, healthy.crosstalk
    )
    read, truth = simulated_log(given_, grasps.frames[1::2])
    diagnosis = fitted.diagnose(read)
    assert diagnosis.fault_set == given_.fault_set
    score = Score()
    score.add({"faulty": sorted(diagnosis.fault_set)}, truth, layout.n_cells)
    assert score.recall.value == score.precision.value == 1.0
    assert truth["dead"] == sorted(given_.fault_set)
    assert truth["wires"] == [(1, "row", 5)]
    found = SensorProfile.measured(read, diagnosis, fitted)
    assert found.fault_set == given_.fault_set
    again = fitted.diagnose([found.apply(frames, seed=0) for frames in grasps.frames[::2]])
    assert again.fault_set == given_.fault_set


def test_noise_step_and_rest_are_those_that_were_put_in():
    rng = np.random.default_rng(0)
    zeros = np.zeros(D)
    made = SensorProfile(
        LAYOUT,
        (Fault(FaultKind.STUCK, (3,), value=2.0),),
        zeros + 0.2,
        zeros + 1.0,
        zeros,
        rng.uniform(0.01, 0.03, D),
        np.zeros((2, 2)),
        step=0.005,
    )
    loads = np.zeros((400, D))
    loads[200:, ::2] = 1.0
    log = [made.apply(loads, seed=seed) for seed in range(3)]
    diagnosis = SelfDiagnosis(LAYOUT).diagnose(log)
    found = SensorProfile.measured(log, diagnosis, SelfDiagnosis(LAYOUT))
    alive = np.delete(np.arange(D), 3)
    np.testing.assert_allclose(found.noise[alive], made.noise[alive], rtol=0.25)
    np.testing.assert_allclose(found.rest[alive], 0.2, atol=0.06)
    assert found.step == pytest.approx(0.005)


@given(profiles(), st.permutations(range(D)), st.integers(0, 99))
def test_the_readings_of_mujoco_go_through_a_profile_as_frames_do(profile, order, seed):
    sensor = MujocoTactile(LAYOUT, depth=0.002, order=order)
    rng = np.random.default_rng(seed)
    depths, slides = rng.uniform(0, 0.002, (4, D)), rng.normal(size=(4, 2, 2, D // 2))
    channels = np.concatenate([depths.reshape(4, 2, 1, -1), slides], axis=2)
    raw = channels.reshape(4, -1)
    loads = sensor.loads(raw)
    np.testing.assert_allclose(loads, depths[:, order] * 2500)
    read = sensor.through(profile, raw, seed=seed)
    np.testing.assert_allclose(sensor.loads(read), profile.apply(loads, seed=seed), atol=1e-9)
    dead = np.isin(order, [order[cell] for cell in profile.fault_set])
    slid = read.reshape(4, 2, 3, -1)[:, :, 1:]
    moved = np.swapaxes(slid, 1, 2).reshape(8, D)[:, order]
    assert not moved[:, list(profile.fault_set)].any()
    assert moved[:, ~dead].any() or dead.all()


PRESSED = """
<mujoco>
  <asset><mesh name="skin" builtin="plate" params="4 5" scale=".05 .05 .01"/></asset>
  <worldbody>
    <geom name="pad" type="box" size=".05 .05 .005" pos="0 0 -.005" {collides}/>
    <body pos="0.01 0 .0195"><freejoint/><geom type="sphere" size=".02" mass=".1"/></body>
  </worldbody>
  <sensor><tactile geom="pad" mesh="skin"/></sensor>
</mujoco>
"""


def test_mujoco_gives_depths_channel_after_channel_and_refuses_a_pad_that_does_not_collide():
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(PRESSED.format(collides=""))
    data = mujoco.MjData(model)
    for _ in range(500):
        mujoco.mj_step(model, data)
    layout = SensorLayout(1, 4, 5)
    assert data.sensordata.shape == (3 * layout.n_cells,)
    depth, *slides = data.sensordata.reshape(3, -1)
    assert depth.max() > 1e-3
    assert depth.min() >= 0
    assert np.abs(slides).max() < 1e-3  # metres a second: it lies still
    sensor = MujocoTactile(layout, depth=0.005)
    touched = np.flatnonzero(sensor.loads(data.sensordata[None])[0])
    dead = SensorProfile.healthy(layout)
    profile = SensorProfile(
        layout,
        (Fault(FaultKind.OPEN, touched.tolist()),),
        dead.rest,
        dead.gain,
        dead.offset,
        dead.noise,
        dead.crosstalk,
    )
    assert not sensor.through(profile, data.sensordata[None]).any()
    with pytest.raises(ValueError, match="at least one collision geom"):
        mujoco.MjModel.from_xml_string(PRESSED.format(collides='contype="0" conaffinity="0"'))


def test_options_of_genesis_hold_a_gain_of_the_force():
    zeros = np.zeros(D)
    profile = SensorProfile(LAYOUT, (), zeros, zeros + 4.0, zeros, zeros + 0.1, np.zeros((2, 2)))
    options = genesis_options(profile, normal_exponent=2.0)
    assert options["probe_gain"] == [2.0] * D
    assert options["noise"] == pytest.approx(0.1)


def test_what_fits_no_profile_is_told_in_one_line(tmp_path):
    healthy = SensorProfile.healthy(LAYOUT)
    other = SensorProfile.healthy(SensorLayout(1, 4, 5))
    sensor = MujocoTactile(LAYOUT, depth=0.001)
    told = {
        "expected .n, 120., depth and two tangents": lambda: sensor.loads(np.zeros((1, 119))),
        "a depth is negative": lambda: sensor.loads(np.full((1, 120), -1.0)),
        "the profile is of 1 x 4 x 5 cells": lambda: sensor.through(other, np.zeros((1, 120))),
        "depth is 0: expected metres": lambda: MujocoTactile(LAYOUT, depth=0),
        "order names 1 of 40 taxels": lambda: MujocoTactile(LAYOUT, 1, order=[0] * 40),
        "expected .T, 40.": lambda: healthy.apply(np.zeros((3, 39))),
        "a fault names cell 99": lambda: _with(faults=(Fault(FaultKind.OPEN, (99,)),)),
        "noise is .3.: expected finite numbers .40.": lambda: _with(noise=np.zeros(3)),
        "expected gains above 0": lambda: _with(gain=np.zeros(D)),
        "crosstalk has a share outside": lambda: _with(crosstalk=np.ones((2, 2))),
    }
    for text, call in told.items():
        with pytest.raises(ValueError, match=text) as error:
            call()
        assert "\n" not in str(error.value)
    healthy.write(tmp_path / "hand.json")
    assert SensorProfile.read(tmp_path / "hand.json").layout == LAYOUT
    (tmp_path / "hand.json").write_text("{}")
    with pytest.raises(ValueError, match=r"hand.json: expected schema 'adaptfault.profile/1'"):
        SensorProfile.read(tmp_path / "hand.json")


def _with(**changed) -> SensorProfile:
    return SensorProfile(**{**vars(SensorProfile.healthy(LAYOUT)), **changed})
