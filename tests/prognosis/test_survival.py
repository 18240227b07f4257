"""Survival of wires and cells over a fleet: intervals hold for known hazards, robots that fail more
are named first."""

import json
import shutil
from datetime import datetime, timedelta, timezone

import numpy as np
import pytest

from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.journal import Entry
from adaptfault.cli import main
from adaptfault.prognosis.survival import Lifetimes, Survival
from diagnostics import Fault, FaultKind, Line, line_fault

SHAPE = 1.8
SCALE = 3000.0


def fleet(seed: int, *, differ: float = 0.0, robots: int = 60) -> Lifetimes:
    """Lifetimes of 20 units on each robot, watched from some age on, with a Weibull hazard that
    differs by robot."""
    rng = np.random.default_rng(seed)
    rows = []
    for robot in range(robots):
        factor = rng.gamma(1 / differ, differ) if differ else 1.0
        entry = rng.uniform(0, 300)
        stop = entry + rng.uniform(200, 900)
        ages = SCALE * ((entry / SCALE) ** SHAPE + rng.exponential(size=20) / factor) ** (1 / SHAPE)
        rows += [(entry, age, True, robot, 1) for age in ages[ages < stop]]
        rows.append((entry, stop, False, robot, max(1, int((ages >= stop).sum()))))
    return Lifetimes(*map(np.array, zip(*rows, strict=True)))


@pytest.mark.parametrize("differ", [0.0, 0.5])
def test_intervals_hold_in_90_percent_of_fleets_with_known_hazards(differ):
    shape = []
    curve = []
    rate = []
    hazard = (500 / SCALE) ** SHAPE
    truth = np.exp(-hazard) if not differ else (1 + differ * hazard) ** (-1 / differ)
    for seed in range(80):
        survival = Survival.fit(fleet(seed, differ=differ))
        shape.append(survival.shape_low <= SHAPE <= survival.shape_high)
        low, high = survival.at(500)[1:]
        curve.append(low <= truth <= high)
        life = survival.lifetimes
        exposure = (life.units * (life.end - life.entry)).sum()
        expected = (
            life.units * ((life.end / SCALE) ** SHAPE - (life.entry / SCALE) ** SHAPE)
        ).sum()
        rate.append(survival.rate_low <= 1000 * expected / exposure <= survival.rate_high)
    for held in (shape, curve, rate):
        assert np.mean(held) >= 0.84  # 0.9 less two standard errors


def test_the_robots_that_fail_more_are_expected_to_go_on_and_the_others_are_near_the_fleet():
    life = fleet(1, differ=1.0, robots=200)
    survival = Survival.fit(life)
    spreads = [Survival.fit(fleet(seed, differ=1.0, robots=200)).spread for seed in range(8)]
    assert np.mean(spreads) == pytest.approx(1, abs=0.3)
    expected, low, high = survival.next_faults(30)
    assert ((low <= expected) & (expected <= high)).all()
    past = np.bincount(life.robot, life.failed, 200)
    assert expected[past >= 3].mean() > 3 * expected[past == 0].mean()
    same = Survival.fit(fleet(1, robots=200))
    assert same.spread < 0.3


def test_a_fleet_without_faults_has_an_upper_limit_and_few_faults_a_constant_hazard():
    life = Lifetimes(
        np.zeros(2), np.full(2, 1000.0), np.zeros(2, bool), np.arange(2), np.full(2, 50)
    )
    none = Survival.fit(life)
    assert (none.rate_low, none.shape, none.spread) == (0, 1, pytest.approx(0.001))
    assert none.rate_high == pytest.approx(-np.log(0.05) / 100, rel=1e-6)
    assert none.next_faults(30)[0] == pytest.approx([0, 0])
    assert json.dumps(none.to_dict(), allow_nan=False)
    one = Survival.fit(
        Lifetimes(life.entry, life.end, np.array([True, False]), life.robot, np.array([1, 99]))
    )
    assert (one.shape, one.scale) == (1, 100_000)
    with pytest.raises(ValueError, match="entry < end"):
        Lifetimes(life.end, life.end, life.failed, life.robot, life.units)
    with pytest.raises(ValueError, match="one length"):
        Lifetimes(life.end[:1], life.end, life.failed, life.robot, life.units)


def test_the_command_line_reads_lifetimes_from_journals_and_names_whom_to_service(
    linear_bundle, tmp_path, capsys
):
    listed = ""
    for name in ("a", "b", "new"):
        shutil.copytree(linear_bundle, tmp_path / f"{name}.bundle")
        listed += f'[[robots]]\nname = "{name}"\nbundle = "{name}.bundle"\nrecordings = "log"\n'
        bundle = Bundle.open(tmp_path / f"{name}.bundle")
        row = line_fault(bundle.layout, Line(0, "row", 2), "open")
        cell = Fault(FaultKind.OPEN, (0,))
        created = datetime.fromisoformat(bundle.about["created"]).astimezone(timezone.utc)
        faults = {"a": [[], [row], [row, cell]], "b": [[], [], []], "new": []}[name]
        for month, known in enumerate(faults, 1):
            document = {
                "version": 1,
                "reason": "",
                "used": ["log"],
                "faults": [fault.to_dict() for fault in known],
            }
            bundle.journal.add(
                Entry((created + timedelta(days=100 * month)).isoformat(), "unchanged", document)
            )
    (tmp_path / "f.toml").write_text(listed)
    arguments = ["fleet", "survival", str(tmp_path / "f.toml")]
    assert main([*arguments, "--json", "--picture", str(tmp_path / "s.png")]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (tmp_path / "s.png").stat().st_size > 1000
    assert told["service"][0]["robot"] in "ab"
    assert {robot["robot"]: robot["known"] for robot in told["service"]} == {"a": 2, "b": 0}
    wires = told["units"]["wires"]
    cells = told["units"]["cells"]
    assert (wires["faults"], cells["faults"]) == (1, 1)
    assert [point["days"] for point in wires["curve"]] == pytest.approx([150])
    assert [point["days"] for point in cells["curve"]] == pytest.approx([250])
    assert told["left_out"] == ["new: no run used recordings after its first day"]
    assert main(arguments) == 0
    assert "whom to service in the next 30 days:" in capsys.readouterr().out
    assert main([*arguments, "--days", "0"]) == 3
