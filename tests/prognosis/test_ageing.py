"""The condition of cells is measured run by run, and what drifts in it is told, with intervals that
hold."""

import json
import shutil
from datetime import datetime, timedelta, timezone

import numpy as np
import pytest

from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.checksummed_json import Damaged
from adaptfault.bundle.journal import Entry
from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.prognosis.cell_condition import AgeingTable
from adaptfault.prognosis.trend import trends
from diagnostics import SensorLayout
from diagnostics.sensor.ageing import cell_condition

LAYOUT = SensorLayout(1, 6, 6, present=np.arange(36) != 35)
FREE = np.full(1, np.inf)


def presses(n: int, seed: int) -> list[np.ndarray]:
    """Recordings in which each press loads a third of the cells, over noise of 0.01."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(n):
        frames = 0.5 + rng.normal(0, 0.01, (40, 36))
        frames[10:30, rng.choice(36, 12, replace=False)] += rng.uniform(1.5, 3, 12)
        made.append(frames)
    return made


@pytest.fixture(scope="module")
def reference() -> list[np.ndarray]:
    return presses(60, 1)


def test_a_gain_an_offset_noise_and_blinks_of_one_cell_are_measured(reference):
    recordings = presses(60, 2)
    rng = np.random.default_rng(3)
    for frames in recordings:
        frames[:, 3] = 0.5 + 0.6 * (frames[:, 3] - 0.5)
        frames[:, 8] += 0.2
        frames[:, 11] += rng.normal(0, 0.03, 40)
        frames[18:20, 20] = 0.5
    condition = cell_condition(recordings, reference, LAYOUT)
    others = np.setdiff1d(np.arange(35), [3, 8, 11, 20])
    assert condition.gain[3] == pytest.approx(0.6, rel=0.15)
    assert condition.gain[others] == pytest.approx(1, rel=0.35)
    assert condition.offset[8] == pytest.approx(0.2 / 5, abs=0.003)
    assert condition.offset[others] == pytest.approx(0, abs=0.003)
    assert condition.noise[11] == pytest.approx(np.hypot(0.01, 0.03) / 5, rel=0.15)
    assert condition.noise[others] == pytest.approx(0.01 / 5, rel=0.15)
    assert condition.blinks[20] == pytest.approx(1 / 18, rel=0.1)
    assert (condition.blinks[others] == 0).all()
    assert np.isnan(condition.values[:, 35]).all()


def test_what_the_recordings_do_not_tell_is_nan(reference):
    idle = [np.full((40, 36), 0.5)]
    condition = cell_condition(idle, reference, LAYOUT)
    assert np.isnan(condition.gain).all()
    assert np.isnan(condition.blinks).all()
    assert (condition.noise[:35] == 0).all()
    for nothing in ([], [np.empty((0, 36))], [np.full((40, 36), np.nan)], [np.full((2, 36), 0.5)]):
        assert np.isnan(cell_condition(nothing, reference, LAYOUT).noise).all()


def noise(
    rng: np.random.Generator, n: int, m: int, heavy: bool, correlation: float = 0.0
) -> np.ndarray:
    made = rng.standard_t(3, (n, m)) if heavy else rng.normal(size=(n, m))
    for i in range(1, n):
        made[i] = correlation * made[i - 1] + np.sqrt(1 - correlation**2) * made[i]
    return made


@pytest.mark.parametrize(("n", "m", "correlation"), [(12, 60, 0.0), (40, 60, 0.5), (200, 4, 0.0)])
def test_stable_robots_show_no_trend_in_95_percent(n, m, correlation):
    rng = np.random.default_rng(n)
    without = np.full(m, np.inf)
    found = 0
    for robot in range(60):
        values = noise(rng, n, m, robot % 2 == 1, correlation)
        values += 0.5 * noise(rng, n, 1, False, correlation)  # cells share what a run does to all
        values[rng.random((n, m)) < 0.2] = np.nan
        found += bool(trends(np.cumsum(rng.uniform(1, 9, n)), values, -without, without).found)
    assert found <= 6  # 3 expected at most; 6 or fewer with probability 0.97


def test_rates_and_crossings_are_within_their_intervals_in_90_percent():
    rng = np.random.default_rng(4)
    rate = 0.004
    limit = 0.7
    held = []
    times = []
    drifts = 0
    for robot in range(80):
        when = np.cumsum(rng.uniform(3, 11, 14))
        values = 0.05 * noise(rng, 14, 3, robot % 2 == 1)
        values[:, 0] += rate * when
        found = {
            t.series: t for t in trends(when, values, np.full(3, -limit), np.full(3, limit)).found
        }
        drifts += 0 in found
        if (t := found.get(0)) is not None:
            held.append(t.rate_low <= rate <= t.rate_high)
            late = np.inf if t.crossing_high is None else t.crossing_high
            times.append(t.crossing_low <= limit / rate - when[-1] <= late)
    assert drifts > 70
    assert np.mean(held) >= 0.88
    assert np.mean(times) >= 0.88


def test_a_perfect_line_and_its_crossing_are_exact_and_few_runs_prove_nothing():
    when = np.arange(10.0)
    trend = trends(when, (2 - 0.1 * when)[:, None], np.array([0.5]), FREE).found[0]
    assert (trend.now, trend.rate, trend.crossing) == pytest.approx((1.1, -0.1, 6.0))
    assert (trend.crossing_low, trend.crossing_high) == pytest.approx((6, 6), abs=0.01)
    assert trends(when, np.ones((10, 1)), -FREE, FREE).found == ()
    assert trends(when[:4], when[:4, None], -FREE, FREE).found == ()
    assert trends(when[:0], np.empty((0, 1)), -FREE, FREE).found == ()
    many = trends(
        when[:6],
        np.random.default_rng(0).permuted(np.tile(when[:6, None], 50), axis=0),
        *2 * [np.ones(50)],
    )
    assert many.found == ()
    assert many.fewest_runs == 8
    with pytest.raises(ValueError, match="ascend"):
        trends(when[::-1], when[:, None], -FREE, FREE)
    with pytest.raises(ValueError, match="expected times"):
        trends(when, when, -FREE, FREE)


def test_runs_of_a_robot_show_the_cell_that_weakens_and_when_it_will_be_too_weak(
    linear_bundle, tmp_path, monkeypatch, capsys
):
    import power_cut

    import adaptfault as af

    path = tmp_path / "robot.bundle"
    shutil.copytree(linear_bundle, path)
    layout = Bundle.open(path).layout
    weak = layout.cell(0, 1, 1)
    command = ["history", str(path), "--trend"]
    assert main(command) == 0
    assert "no run has measured" in capsys.readouterr().out
    today = datetime(2026, 1, 1, tzinfo=timezone.utc)
    grasps = af.simulate(6, layout, n_frames=40, seed=100, classes=power_cut.CLASSES[1:])
    for week in range(10):
        rng = np.random.default_rng(week)
        frames = [
            np.abs(np.concatenate([f, 0 * f]) + rng.normal(0, 0.01, (80, layout.n_cells)))
            for f in grasps.frames
        ]
        for f in frames:
            f[:, weak] *= np.exp(-0.03 * week)
        save_npz(
            tmp_path / f"{week}.npz",
            Recordings(tuple(f.astype(np.float32) for f in frames), layout),
        )
        day = (today + timedelta(days=7 * week)).isoformat()
        monkeypatch.setattr("adaptfault.robot.maintenance.now", lambda day=day: day)
        assert main(["maintain", str(path), str(tmp_path / f"{week}.npz"), "--quiet"]) in (0, 1, 2)
    table = AgeingTable.of(Bundle.open(path))
    assert table.values.shape == (10, 4, layout.n_cells)
    assert table.times[-1] in table.last_alive
    capsys.readouterr()
    assert main([*command, "--picture", str(tmp_path / "trend.png")]) == 0
    text = capsys.readouterr().out
    assert "10 runs from 2026-01-01" in text
    assert f"{layout.place(weak)}: gain" in text
    assert (tmp_path / "trend.png").stat().st_size > 1000
    assert main([*command, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {d["cell"] for d in told["drifts"]} == {weak}
    drift = next(d for d in told["drifts"] if d["statistic"] == "gain")
    assert told["unit"] == "day"
    assert drift["rate_low"] <= -0.03 / 7 <= drift["rate_high"]
    assert main(["history", str(path), "--picture", "x.png"]) == 3


def test_a_row_of_a_wrong_size_is_damage(linear_bundle, tmp_path):
    shutil.copytree(linear_bundle, tmp_path / "robot.bundle")
    bundle = Bundle.open(tmp_path / "robot.bundle")
    bundle.journal.add(
        Entry("2026-01-01T00:00:00+00:00", "unchanged", {"version": 1}, condition=b"abc")
    )
    with pytest.raises(Damaged, match="wrong size"):
        AgeingTable.of(bundle)
