"""The simulated grasps: what the physics promises, and that the result looks like a real array."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from adaptfault.data.recordings import Recordings
from adaptfault.data.simulated_grasps import (
    CLASS_NAMES,
    Readout,
    hysteresis,
    relaxing_pressure,
    simulate,
)
from diagnostics import SensorLayout

ROOT = Path(__file__).parents[2]
REAL = ROOT.parent / "shared" / "data" / "sdh2x13x6_grasps36.npz"


@pytest.fixture(scope="module")
def grasps() -> Recordings:
    return simulate(60)


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "simulated_vs_real", ROOT / "examples" / "simulated_vs_real.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def statistics(grasps: Recordings, example: ModuleType) -> dict[str, float]:
    return example.statistics(grasps, grasps.layout.present, grasps.layout.full_scale)


def frames_of(grasps: Recordings, name: str) -> np.ndarray:
    return np.stack(
        [f for f, k in zip(grasps, grasps.labels, strict=True) if grasps.class_names[k] == name]
    )


def test_there_are_as_many_recordings_of_each_class_as_asked_for(grasps: Recordings):
    assert grasps.class_names == CLASS_NAMES
    assert np.bincount(grasps.labels).tolist() == [60] * 7
    assert {f.shape for f in grasps} == {(100, 220)}
    assert {f.dtype for f in grasps} == {np.dtype("float32")}
    assert grasps.names[0] == "nothing/0000"
    assert grasps.names[-1] == "harder/0059"


def test_the_same_seed_gives_the_same_recordings_and_another_seed_others():
    first = simulate(2, seed=3)
    again = simulate(2, seed=3)
    other = simulate(2, seed=4)
    np.testing.assert_array_equal(first.frames, again.frames)
    touched = first.labels > 0
    assert not any(np.array_equal(a, b) for a, b, t in zip(first, other, touched, strict=True) if t)


def test_a_class_does_not_change_when_others_are_left_out():
    everything = simulate(2, seed=1)
    some = simulate(2, seed=1, classes=("harder", "void"))
    assert some.labels.tolist() == [0, 0, 1, 1]
    np.testing.assert_array_equal(frames_of(everything, "void"), frames_of(some, "void"))


def test_another_sensor_differs_in_gain_and_not_in_what_it_touches():
    one = simulate(2, classes=("normal",))
    other = simulate(2, classes=("normal",), sensor_seed=1)
    a = np.stack(one.frames)
    b = np.stack(other.frames)
    both = (a > 0.5) & (b > 0.5)
    assert not np.array_equal(a, b)
    assert 0.1 < np.std(np.log(a[both] / b[both])) < 0.3
    spread = Readout.draw(SensorLayout(1, 60, 60)).gain
    assert 0.1 < spread.std() < 0.2


@pytest.mark.parametrize(
    ("layout", "n_frames"),
    [
        (SensorLayout(3, 4, 7, full_scale=4095, unit="counts", rate=100), 40),
        (SensorLayout(1, 13, 6, full_scale=1, unit="bar", rate=2), 7),
        (SensorLayout(2, 24, 16), 3),
        (SensorLayout(2, 1, 1), 1),
    ],
    ids=str,
)
def test_any_array_can_be_simulated(layout: SensorLayout, n_frames: int):
    grasps = simulate(8, layout, n_frames=n_frames)
    frames = np.stack(grasps.frames)
    assert grasps.layout == layout
    assert frames.shape == (56, n_frames, layout.n_cells)
    assert 0.1 * layout.full_scale < frames.max() <= layout.full_scale
    in_touch = layout.grid(frames[8:].max(1)).max((2, 3)) > 0
    assert in_touch.mean() > 0.95, "nearly every grasp reaches every pad"


def test_positions_without_a_cell_read_zero():
    present = np.ones((2, 5, 6), bool)
    present[:, :2, 3:] = False
    frames = np.stack(simulate(5, SensorLayout(2, 5, 6, present=present)).frames)
    assert not frames[..., ~present.ravel()].any()
    assert frames[..., present.ravel()].any(axis=(0, 1)).all()


def test_idle_cells_read_exactly_zero(grasps: Recordings):
    assert not frames_of(grasps, "nothing").any()
    corners = grasps.layout.grid(frames_of(grasps, "softer"))[..., [0, 0, -1, -1], [0, -1, 0, -1]]
    assert (corners == 0).mean() > 0.95


def test_readings_lie_on_converter_steps(grasps: Recordings):
    counts = np.stack(grasps.frames[::7]).astype(np.float64) / 5 * 4095
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-3)
    other = simulate(1, SensorLayout(2, 4, 4, full_scale=4095, unit="counts"), n_frames=5)
    assert all(np.array_equal(f, np.rint(f)) for f in other)


def test_a_healthy_cell_rarely_passes_two_newtons(grasps: Recordings):
    readings = np.stack(grasps.frames)
    assert (readings[readings > 0] > 2).mean() < 0.01
    assert readings.max() < 4
    assert 0.2 < np.median(readings[readings > 0]) < 1


def test_a_grasp_is_felt_from_the_first_frames_on(grasps: Recordings):
    felt = np.stack(grasps.frames)[grasps.labels > 0, 2]
    assert ((felt > 0).sum(1) > 20).all()


def test_the_force_falls_while_the_closing_is_held():
    compression = np.full((300, 1), 0.5, np.float32)
    pressure = relaxing_pressure(compression, np.array([2.0]), np.array([3.0]), rate=10)[:, 0]
    assert pressure[0] == pytest.approx(1)
    assert (np.diff(pressure) <= 0).all()
    assert pressure[-1] == pytest.approx(0.65, rel=0.01)
    after_tau = 0.65 + 0.35 * np.exp(-1)
    assert pressure[30] == pytest.approx(after_tau, rel=0.01)


def test_a_held_block_relaxes_in_the_recordings_too(grasps: Recordings):
    force = frames_of(grasps, "normal").sum(-1)
    assert (force[:, 60] < 0.95 * force[:, 12]).mean() > 0.95


def test_nothing_pulls_when_the_pads_open_again():
    compression = np.array([1.0, 1.0, 1.0, 0.1, 0.0, 0.0, 1.0], np.float32)[:, None]
    pressure = relaxing_pressure(compression, np.array([1.0]), np.array([0.2]), rate=10)[:, 0]
    assert (pressure >= 0).all()
    assert not pressure[4:6].any()
    assert pressure[6] > 0.9


def test_loading_and_unloading_follow_different_curves():
    load = np.concatenate([np.linspace(0, 1, 50), np.linspace(1, 0, 50)[1:]])[:, None]
    shown = hysteresis(load)[:, 0]
    loading = shown[:50]
    unloading = shown[49:][::-1]
    assert (unloading >= loading).all()
    assert (unloading - loading)[25] == pytest.approx(0.1 * load[25, 0])
    assert shown[-1] == 0, "free of load, nothing remains"


def test_noise_grows_with_the_load():
    readout = Readout.draw(SensorLayout(1, 4, 4))
    load = np.broadcast_to(
        np.array([0.2, 2.0], np.float32)[:, None, None, None, None], (2, 2000, 1, 4, 4)
    )
    light, heavy = readout.read(load, np.random.default_rng(0)).std(1)
    assert (heavy > 3 * light).all()
    assert (light > 0).all()


def test_a_harder_block_pushes_back_with_more_force_at_the_same_closing(grasps: Recordings):
    force = {name: frames_of(grasps, name)[:, 15].sum(-1).mean() for name in CLASS_NAMES}
    assert force["softer"] < 0.7 * force["normal"] < 0.7 / 1.4 * force["harder"]


def test_both_pads_carry_the_same_force(grasps: Recordings):
    force = grasps.layout.grid(frames_of(grasps, "normal")[:, 15]).sum((2, 3))
    assert abs(force[:, 0].mean() / force[:, 1].mean() - 1) < 0.1
    assert np.corrcoef(force.T)[0, 1] > 0.3


def test_an_inclusion_raises_the_peak_and_a_void_lowers_the_force(grasps: Recordings):
    hold = {name: frames_of(grasps, name)[:, 30] for name in CLASS_NAMES}
    assert hold["foreign matter"].max(-1).mean() > 1.4 * hold["normal"].max(-1).mean()
    assert hold["void"].sum(-1).mean() < 0.9 * hold["normal"].sum(-1).mean()


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("readings exactly 0", 0.3, 0.8),
        ("cells still through a recording", 0.15, 0.9),
        ("R2 from the other cells, median", 0.94, 0.99),
        ("R2 from the other cells, worst tenth", 0.63, 0.95),
        ("components for 90.0% of the variance", 9, 27),
        ("components for 99.0% of the variance", 19, 65),
        ("components for 99.9% of the variance", 51, 130),
    ],
)
def test_the_recordings_look_like_those_of_real_arrays(
    statistics: dict[str, float], name: str, low: float, high: float
):
    assert low <= statistics[name] <= high


@pytest.mark.skipif(not REAL.exists(), reason="the real recordings are not beside the repository")
def test_the_same_statistics_of_a_real_hand_are_near(
    statistics: dict[str, float], example: ModuleType
):
    recordings, present, full_scale = example.load(str(REAL))
    real = example.statistics(recordings, present, full_scale)
    assert real["components for 99.0% of the variance"] == pytest.approx(52, abs=2), (
        "as measured before the simulator was written"
    )
    for name in statistics:
        if name.startswith("R2"):
            assert abs(statistics[name] - real[name]) < 0.12
        if name.startswith("components"):
            assert 0.4 < statistics[name] / real[name] < 2


def test_the_example_prints_one_column_without_a_file(
    grasps: Recordings,
    example: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setattr(example, "simulate", lambda n: grasps)
    example.main([])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["simulated"]
    assert len(lines) == 1 + 9


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_per_class": 0}, "n_per_class >= 1, a whole number; got 0"),
        ({"n_per_class": 2.5}, "n_per_class >= 1, a whole number; got 2.5"),
        ({"n_frames": 0}, "n_frames >= 1"),
        ({"seed": -1}, "seed >= 0"),
        ({"classes": ("normal", "rotten")}, "rotten"),
        ({"classes": ("normal", "normal")}, "each once"),
        ({"classes": ()}, r"got \(\)"),
        ({"classes": "normal"}, "got 'normal'"),
    ],
)
def test_bad_arguments_are_told_in_one_line(arguments: dict, message: str):
    with pytest.raises(ValueError, match=message) as known_values:
        simulate(**{"n_per_class": 1, "n_frames": 2, **arguments})
    assert "\n" not in str(known_values.value)
