"""Sensors whose reading falls with load, or rests in the middle."""

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import without_export

from adaptfault.acquisition.switch import parse_when
from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from diagnostics import Diagnosis, Fault, FaultKind, Monitor, SelfDiagnosis, SensorLayout, inject
from diagnostics.preprocessing.load import LoadDirection

FULL = 5.0
FAULTS = [
    Fault(FaultKind.OPEN, (14,)),
    Fault(FaultKind.SHORT, (17,)),
    Fault(FaultKind.STUCK, (42,), value=1.5),
    Fault(FaultKind.OPEN, tuple(range(20, 25)), onset=200),
]


def frames_of(recordings: Recordings) -> list[np.ndarray]:
    return [np.asarray(frames, dtype=np.float64) for frames in recordings.frames]


def turned(frames: list[np.ndarray]) -> list[np.ndarray]:
    return [FULL - f for f in frames]


def middled(frames: list[np.ndarray]) -> list[np.ndarray]:
    """Return readings that rest near half of full scale; load moves every other cell up, the others
    down."""
    cells = np.arange(frames[0].shape[1])
    rest = FULL / 2 + 0.02 * (cells % 7)
    return [rest + np.where(cells % 2, 0.45, -0.45) * f for f in frames]


@pytest.fixture(scope="module")
def healthy(small_grasps: Recordings) -> list[np.ndarray]:
    return frames_of(small_grasps)[::2]


@pytest.fixture(scope="module")
def log(later_grasps: list[np.ndarray], small_grasps: Recordings) -> list[np.ndarray]:
    whole = np.concatenate([np.asarray(f, dtype=np.float64) for f in later_grasps])
    return [inject(whole, FAULTS, replace(small_grasps.layout, rest="low"), seed=1)]


@pytest.fixture(scope="module")
def low(healthy: list[np.ndarray], small_grasps: Recordings) -> SelfDiagnosis:
    return SelfDiagnosis(replace(small_grasps.layout, rest="low")).fit(healthy)


@pytest.fixture(scope="module")
def high(healthy: list[np.ndarray], small_grasps: Recordings) -> SelfDiagnosis:
    return SelfDiagnosis(replace(small_grasps.layout, rest="high")).fit(turned(healthy))


def same(one: Diagnosis, other: Diagnosis) -> bool:
    cells = [[(f.cells, f.line) for f in d.faults] for d in (one, other)]
    return bool((one.verdicts == other.verdicts).all()) and cells[0] == cells[1]


def test_a_sensor_that_rests_high_gets_the_verdicts_of_one_that_rests_low(low, high, log):
    expected = low.diagnose(log)
    found = high.diagnose(turned(log))
    assert {14, 17, 42} <= set(expected.fault_set)
    assert same(expected, found)
    np.testing.assert_allclose(found.probability, expected.probability, atol=1e-3)


def test_faults_are_reported_in_the_sensors_own_readings(low, high, log):
    before = {f.cells: f for f in low.diagnose(log).faults}
    after = {f.cells: f for f in high.diagnose(turned(log)).faults}
    assert before.keys() == after.keys()
    for cells, fault in before.items():
        assert fault.value is not None
        assert after[cells].value == pytest.approx(FULL - fault.value)
    assert after[14,].kind is FaultKind.SHORT
    assert after[17,].kind is FaultKind.OPEN
    assert "reads 3.5 N" in after[42,].reason


def test_the_monitor_says_the_same_frame_by_frame(low, high, log):
    monitors = Monitor(low, wait=True), Monitor(high, wait=True)
    first = log[0][: len(log[0]) // 2]
    told = [
        [(fault.cells, fault.line) for frame in frames for fault in monitor.update(frame)]
        for monitor, frames in zip(monitors, (first, FULL - first), strict=True)
    ]
    assert told[0] == told[1] != []
    assert same(monitors[0].diagnosis(), monitors[1].diagnosis())


def test_without_a_reference_the_declared_direction_holds(log, small_grasps):
    layout = small_grasps.layout
    expected = SelfDiagnosis(layout).diagnose(log)
    found = SelfDiagnosis(replace(layout, rest="high")).diagnose(turned(log))
    assert len(expected.fault_set) > 0
    assert same(expected, found)


def test_readings_that_no_converter_gives_are_missing_in_any_direction(high, log):
    spoiled = FULL - log[0]
    spoiled[10, 3] = np.inf
    spoiled[11, 4] = -7.0
    (fault,) = high.diagnose([spoiled]).transport
    assert (fault.kind, fault.frames) == ("invalid", 2)


@pytest.mark.slow
def test_cells_that_rest_in_the_middle_are_diagnosed_and_named_by_what_they_read(
    low, healthy, log, small_grasps
):
    layout = replace(small_grasps.layout, rest="middle")
    fitted = SelfDiagnosis(layout).fit(middled(healthy))
    clean = middled([np.clip(log[0], 0, FULL)])[0]
    clean[:, [14, 17]] = 0.0, FULL
    diagnosis = fitted.diagnose([clean])
    told = {cell: fault for fault in diagnosis.faults for cell in fault.cells}
    assert (told[14].kind, told[17].kind, told[42].kind) == (
        FaultKind.OPEN,
        FaultKind.SHORT,
        FaultKind.STUCK,
    )
    assert told[42].value == pytest.approx(middled([np.full((1, 60), 1.5)])[0][0, 42], abs=0.05)
    assert len(diagnosis.fault_set - set(low.diagnose(log).fault_set)) == 0


def test_a_fitted_direction_is_stored_and_a_wrong_one_is_refused(high, low, log):
    about, arrays = high.state()
    again = SelfDiagnosis.from_state(json.loads(json.dumps(about)), arrays)
    assert same(again.diagnose(turned(log)), high.diagnose(turned(log)))
    about, arrays = low.state()
    about["load"] = {
        "direction": "up",
        "rest": {"array": "r", "dtype": "float64", "shape": [60], "finite": True},
    }
    about["load"]["full_scale"] = 5.0
    with pytest.raises(ValueError, match="damaged: expected a direction of load"):
        SelfDiagnosis.from_state(about, {**arrays, "r": np.zeros(60)})


def contacts(cells: int, seed: int = 0) -> list[np.ndarray]:
    """Return 30 recordings in which each cell is loaded a fifth of the time."""
    rng = np.random.default_rng(seed)
    recordings = []
    for _ in range(30):
        frames = rng.normal(0, 0.01, (60, cells))
        at = int(rng.integers(45))
        frames[at : at + 12] += (
            rng.uniform(0, 4, cells) * np.sin(np.linspace(0, np.pi, 12))[:, None]
        )
        recordings.append(frames)
    return recordings


def test_the_direction_is_learned_where_it_is_beyond_doubt():
    layout = SensorLayout(1, 5, 6)
    loads = contacts(30)
    assert LoadDirection.fit(loads, layout) is None
    learned = LoadDirection.fit([FULL - f for f in loads], layout)
    assert learned is not None
    assert learned.direction == "high"
    rest = np.linspace(2, 3, 30)
    signs = np.random.default_rng(1).choice([-0.5, 0.5], (30, 30))
    learned = LoadDirection.fit(
        [rest + sign * f for sign, f in zip(signs, loads, strict=True)], layout
    )
    assert learned is not None
    assert learned.direction == "middle"
    np.testing.assert_allclose(learned.rest, rest, atol=0.02)


def test_what_is_loaded_most_of_the_time_and_what_never_moves_counts_as_resting_low(
    healthy, small_grasps
):
    layout = SensorLayout(1, 5, 6)
    held = [
        np.where(np.arange(60)[:, None] < 50, np.random.default_rng(1).uniform(1, 4, 30), 0.0)
        for _ in range(20)
    ]
    assert LoadDirection.fit(held, layout) is None
    assert LoadDirection.fit([np.zeros((50, 30))], layout) is None
    assert LoadDirection.fit(healthy, small_grasps.layout) is None


def test_during_contact_means_during_load():
    layout = SensorLayout(1, 2, 3, rest="high")
    rule = parse_when("contact", layout)
    nothing = np.zeros(6, bool)
    clock = None
    assert not rule(np.full(6, 5.0), nothing, clock)  # type: ignore[arg-type]
    assert rule(np.full(6, 4.0), nothing, clock)  # type: ignore[arg-type]


def test_the_command_line_reads_the_direction_from_a_layout_file(
    tmp_path, capsys, log, small_grasps
):
    layout = replace(small_grasps.layout, rest="high")
    (tmp_path / "skin.json").write_text(json.dumps(layout.to_dict()))
    np.savetxt(tmp_path / "log.csv", FULL - log[0], delimiter=",", fmt="%.6f")
    options = ["--layout", str(tmp_path / "skin.json"), "--json", "--quiet"]
    assert main(["diagnose", str(tmp_path / "log.csv"), *options]) in (1, 2)
    found = Diagnosis.from_dict(json.loads(capsys.readouterr().out))
    assert found.layout == layout
    assert same(found, SelfDiagnosis(small_grasps.layout).diagnose(log))


@pytest.mark.slow
def test_a_bundle_keeps_the_direction_and_maintains_by_it(tmp_path, capsys, small_grasps, log):
    layout = replace(small_grasps.layout, rest="high", wiring="bus")
    (tmp_path / "skin.json").write_text(json.dumps(layout.to_dict()))
    flipped = replace(small_grasps, frames=tuple(FULL - np.asarray(f) for f in small_grasps.frames))
    save_npz(tmp_path / "grasps.npz", flipped)
    out = tmp_path / "robot.bundle"
    log_file = tmp_path / "log.npy"
    np.save(log_file, FULL - log[0])
    options = ["--layout", str(tmp_path / "skin.json"), "--quiet"]
    with without_export():
        assert (
            main(
                [
                    "train",
                    str(tmp_path / "grasps.npz"),
                    "--out",
                    str(out),
                    "--epochs",
                    "1",
                    *options,
                ]
            )
            == 0
        )
        capsys.readouterr()
        assert main(["maintain", str(out), str(log_file), "--dry-run", "--json", "--quiet"]) in (
            1,
            2,
        )
    report = json.loads(capsys.readouterr().out)
    diagnosis = Diagnosis.from_dict(report["diagnosis"])
    assert diagnosis.layout == layout
    assert {14, 17, 42} <= set(diagnosis.fault_set)
    assert "row" not in str(diagnosis).split("tested")[-1]


@pytest.mark.parametrize("rest", ["low", "high"])
def test_a_cell_that_holds_a_count_is_told_with_the_count_that_it_reads_mostly(
    healthy, later_grasps, small_grasps, rest
):
    """Three counts of the run are lower by 3, as where a cell settles: the middle is no reading."""
    most = 1023
    layout = replace(small_grasps.layout, rest=rest, full_scale=float(most), unit="count")

    def counts(frames):
        loads = np.rint(np.asarray(frames, np.float64) / FULL * most)
        return most - loads if rest == "high" else loads

    fitted = SelfDiagnosis(layout).fit([counts(frames) for frames in healthy])
    log = counts(np.concatenate(later_grasps))
    log[:, 27] = 40
    log[:3, 27] = 37
    fault = next(fault for fault in fitted.diagnose([log]).faults if 27 in fault.cells)
    assert fault.value == 40.0
    assert "reads 40 count" in fault.reason
