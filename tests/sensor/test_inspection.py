"""What is told of a log: findings about cells, wires and the whole sensor; the latter come before
blame."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import SIMULATED, SMALL_CLASSES

import adaptfault as af
from adaptfault.inspection.severity import NAMES
from diagnostics import (
    Fault,
    FaultKind,
    Line,
    SelfDiagnosis,
    SensorLayout,
    Verdict,
    inject,
    line_fault,
)

LAYOUT = SensorLayout(*SIMULATED.shape, full_scale=1023.0, unit="count", rate=20.0)
D = LAYOUT.n_cells
NOISE = 1.0  # counts


def readings(seed: int, grasps: int = 20) -> list[np.ndarray]:
    """Return grasps as counts of a sensor whose cells rest at 10 to 30 counts, with other gains and
    noise."""
    device = np.random.default_rng(5)
    rng = np.random.default_rng(seed)
    rest = device.uniform(10, 30, D)
    gain = device.uniform(0.7, 1.3, D)
    simulated = af.simulate(
        grasps // 2, SIMULATED, n_frames=60, seed=seed, classes=SMALL_CLASSES[1:]
    )
    loads = [frames * (1023 / 5) for frames in simulated.frames]
    return [
        counts(rest + gain * loads[i] + rng.normal(0, NOISE, loads[i].shape))
        for i in rng.permutation(len(loads))
    ]


def counts(frames: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(frames), 0, 1023).astype(np.float64)


@pytest.fixture(scope="module")
def reference() -> list[np.ndarray]:
    return readings(1, 60)


@pytest.fixture(scope="module")
def known(reference, made_once) -> SelfDiagnosis:
    def make(folder: Path) -> None:
        SelfDiagnosis(LAYOUT).fit(reference).save(folder / "known.npz")

    return SelfDiagnosis.load(made_once("known", make) / "known.npz")


@pytest.fixture(scope="module")
def log() -> list[np.ndarray]:
    return readings(2)


@pytest.fixture(scope="module")
def busy(log) -> int:
    """The cell that is loaded most."""
    return int(np.concatenate(log).mean(axis=0).argmax())


def names(inspection: af.Inspection) -> set[str]:
    return {finding.name for finding in inspection.findings}


def test_of_a_healthy_log_nothing_is_told(known, reference, log):
    found = af.inspect(log, known, reference=reference)
    assert (found.findings, found.severity, len(found.diagnosis.fault_set)) == ((), 0, 0)


def test_a_dead_cell_and_a_broken_row_are_findings_and_the_worst_decides(
    known, reference, log, busy
):
    single = af.inspect(
        [inject(r, [Fault("short", (busy,))], LAYOUT) for r in log], known, reference=reference
    )
    assert (names(single), single.severity, single.diagnosis.fault_set) == ({"fault"}, 1, {busy})
    row = line_fault(LAYOUT, Line(1, "row", 2), FaultKind.SHORT)
    wire = af.inspect([inject(r, [row], LAYOUT) for r in log], known, reference=reference)
    assert (names(wire), wire.severity) == ({"wire"}, 2)
    document = json.loads(json.dumps(wire.to_dict(), allow_nan=False))
    assert document["findings"] == [
        {
            "code": "TOUCH-102",
            "name": "wire",
            "severity": 2,
            "reason": wire.diagnosis.faults[0].reason,
        }
    ]


def hum(frames: np.ndarray, amplitude: float) -> np.ndarray:
    return counts(
        frames + amplitude * 1023 * (1 + np.sin(np.arange(len(frames)) / 2.3))[:, None] / 2
    )


@pytest.mark.parametrize("amplitude", [0.06, 0.1])
def test_hum_of_all_cells_is_told_and_taken_out_and_a_dead_cell_beside_it_is_found(
    known, reference, log, busy, amplitude
):
    humming = [hum(r, amplitude) for r in log]
    found = af.inspect(humming, known, reference=reference)
    assert "hum" in names(found)
    assert not found.diagnosis.fault_set
    assert not known.diagnose(humming).fault_set
    for frames in humming:
        frames[:, busy] = 1023
    assert busy in af.inspect(humming, known, reference=reference).diagnosis.fault_set


def test_a_ramp_of_all_cells_is_told_and_blames_no_cell(known, reference, log):
    ramp = [counts(r + 0.15 * 1023 * i / len(log)) for i, r in enumerate(log)]
    found = af.inspect(ramp, known, reference=reference)
    assert "ramp" in names(found)
    assert found.diagnosis.fault_set == set()


def test_a_constant_shift_of_all_cells_is_an_offset_and_blames_no_cell(known, reference, log):
    found = af.inspect([counts(r + 0.1 * 1023) for r in log], known, reference=reference)
    assert names(found) == {"offset"}
    assert found.change.offset == pytest.approx(102, abs=3)
    assert found.diagnosis.fault_set == set()


def test_crosstalk_of_a_pad_is_told_and_blames_no_cell(known, reference, log):
    def crossed(frames: np.ndarray) -> np.ndarray:
        pads = frames.reshape(len(frames), 2, -1)
        return counts(
            (pads + 0.3 * (pads.mean(axis=2, keepdims=True) - 20)).reshape(len(frames), D)
        )

    found = af.inspect([crossed(r) for r in log], known, reference=reference)
    assert "crosstalk" in names(found)
    assert found.diagnosis.fault_set == set()


def test_a_dead_converter_is_no_disturbance(known, reference, log):
    dead = [r.copy() for r in log]
    for frames in dead:
        frames[:, : D // 2] = 0
    found = af.inspect(dead, known, reference=reference)
    assert found.diagnosis.fault_set == set(range(D // 2))
    assert names(found) == {"wire"}


@pytest.mark.parametrize("times", [5, 30])
def test_more_noise_of_all_cells_is_told(known, reference, log, times):
    rng = np.random.default_rng(0)
    noisy = [counts(r + rng.normal(0, times * NOISE, r.shape)) for r in log]
    found = af.inspect(noisy, known, reference=reference)
    assert "noise" in names(found)
    assert found.severity >= 1


def test_lost_bits_of_the_converter_are_told(known, reference, log):
    assert "quantised" in names(af.inspect([r // 64 * 64 for r in log], known, reference=reference))


def fewer_bits(frames: np.ndarray) -> np.ndarray:
    return frames // 32 * 32


def saturated(frames: np.ndarray) -> np.ndarray:
    return np.minimum(8 * frames, 700)


@pytest.mark.parametrize(("changed", "name"), [(fewer_bits, "quantised"), (saturated, "saturated")])
def test_behind_a_changed_converter_a_dead_cell_is_not_alive_and_at_most_one_other_is_blamed(
    known, reference, log, busy, changed, name
):
    seen = [changed(r) for r in log]
    for frames in seen:
        frames[:, busy] = 0
    found = af.inspect(seen, known, reference=reference)
    assert name in names(found)
    # where nearly all loads are the top, they tell nothing of a cell at rest
    unknown = found.diagnosis.verdicts.ravel()[busy] == Verdict.UNTESTED
    assert busy in found.diagnosis.fault_set or (unknown and name == "saturated")
    assert len(found.diagnosis.fault_set) <= 2


def test_each_cell_that_creeps_by_its_own_offset_is_a_ramp_and_none_is_blamed(
    known, reference, log
):
    offset = np.random.default_rng(0).uniform(0, 0.08 * 1023, D)
    creeping = [counts(r + offset * i / len(log)) for i, r in enumerate(log)]
    found = af.inspect(creeping, known, reference=reference)
    assert "ramp" in names(found)
    assert not found.diagnosis.fault_set
    assert not known.diagnose(creeping).fault_set


def test_a_pad_that_nothing_touches_is_not_faulty_but_untested_and_a_dead_cell_on_it_is_found(
    known, reference, log
):
    rng = np.random.default_rng(0)
    untouched = [r.copy() for r in log]
    idle = np.quantile(np.concatenate(reference)[:, D // 2 :], 0.02, axis=0)
    for frames in untouched:
        frames[:, D // 2 :] = counts(idle + rng.normal(0, NOISE, (len(frames), D // 2)))
        frames[:, -1] = 1023
    found = af.inspect(untouched, known, reference=reference)
    assert found.diagnosis.fault_set == {D - 1}
    assert any("press pad 1" in advice for advice in found.diagnosis.coverage.advice)
    assert found.severity >= 1


def test_a_pad_that_one_recording_does_not_touch_is_not_told(known, reference, log):
    one = log[0].copy()
    idle = np.quantile(np.concatenate(reference)[:, D // 2 :], 0.02, axis=0)
    one[:, D // 2 :] = counts(idle)
    found = af.inspect([one], known, reference=reference)
    assert found.diagnosis.possible == ()
    assert found.diagnosis.fault_set == set()


def test_a_number_that_a_driver_writes_for_no_value_is_told_with_its_count(
    known, reference, log, busy
):
    marked = [r.copy() for r in log]
    for frames in marked:
        frames[:, busy] = 65535
    found = af.inspect(marked, known, reference=reference)
    reason = next(finding.reason for finding in found.findings if finding.name == "sentinel")
    assert reason.startswith(f"{sum(map(len, log))} readings (1.7%) are 65535")
    assert found.diagnosis.fault_set == {busy}
    nothing = af.inspect([np.full_like(r, 65535) for r in log], known, reference=reference)
    assert (names(nothing), nothing.severity) == ({"sentinel", "silent_array"}, 2)


def test_an_array_without_any_change_is_one_finding_and_no_fault(known, reference, log):
    found = af.inspect([0 * r for r in log], known, reference=reference)
    assert (names(found), found.severity, found.diagnosis.faults) == ({"silent_array"}, 2, ())


def test_frames_that_are_scaled_by_their_own_extremes_are_told(log):
    layout = SensorLayout(*SIMULATED.shape, full_scale=1.0, unit="", rate=20.0)

    def scaled(frames: np.ndarray) -> np.ndarray:
        return (frames - frames.min(axis=1, keepdims=True)) / np.ptp(frames, axis=1, keepdims=True)

    found = af.inspect([scaled(r) for r in log], SelfDiagnosis(layout))
    assert "normalised" in names(found)
    assert found.severity == 2


def test_a_cold_start_without_reference_is_inspected(log, busy):
    dead = [inject(r, [Fault("short", (busy,))], LAYOUT) for r in log]
    found = af.inspect(dead, SelfDiagnosis(LAYOUT))
    assert busy in found.diagnosis.fault_set
    assert names(found) <= set(NAMES)


def test_a_log_of_another_shape_or_without_frames_is_refused(known):
    with pytest.raises(ValueError, match="60"):
        af.inspect(np.zeros((5, 7)), known)
    with pytest.raises(ValueError, match="no frames"):
        af.inspect([np.zeros((0, D))], known)
