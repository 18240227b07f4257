"""The reproduction, through the command line and piece by piece."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.data.simulated_grasps import simulate
from adaptfault.data.windows import Windows, make_windows, split
from adaptfault.evaluation.scores import accuracy_interval
from adaptfault.paper.bench import Bench, Setup
from adaptfault.paper.claims import judge
from adaptfault.paper.ledger import Ledger, Result, mean
from adaptfault.paper.settings import PAPER_CELLS, Settings, Task, aware, is_aware
from diagnostics import SensorLayout

SMALL = SensorLayout(2, 6, 5)
TINY = Settings(
    seeds=(0, 1),
    epochs=1,
    learning_rate=1e-3,
    network={"padding": "valid", "init": "glorot"},
    patience=None,
    counts=(2, 5),
    adapted=(0, 5),
    scratch=(5,),
    samples=(64,),
    warm=True,
    aware_epochs=1,
    aware_kinds=("blocks",),
    future=5,
    judged=10,
    wiring=1,
    windows=2,
    single=4,
)


@pytest.fixture(scope="module")
def grasps() -> Recordings:
    return simulate(8, SMALL, n_frames=40, seed=1, classes=("nothing", "softer", "harder"))


@pytest.fixture
def bench(grasps: Recordings, tmp_path: Path) -> Bench:
    windows = make_windows(grasps.frames, grasps.labels, SMALL)
    return Bench(Setup(grasps, windows, TINY, tmp_path, "cpu", False, lambda text: None), 0)


@pytest.fixture(scope="module")
def home(grasps: Recordings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("paper")
    save_npz(home / "grasps.npz", grasps)
    return home


def command(home: Path, *more: str) -> list[str]:
    return [
        "reproduce",
        "--recordings",
        str(home / "grasps.npz"),
        "--epochs",
        "1",
        "--seeds",
        "0",
        "1",
        *more,
    ]


@pytest.mark.slow
def test_a_run_that_is_killed_goes_on_where_it_was_and_measures_nothing_twice(home, capsys):
    out = home / "killed"
    run = command(home, "--figure", "2", "--figure", "3", "--out", str(out), "--quiet")
    code = "import sys; from adaptfault.cli import main; sys.exit(main(sys.argv[1:]))"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *run], env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    results = out / "results.jsonl"
    while process.poll() is None and not (
        results.exists() and results.read_bytes().count(b"\n") >= 3
    ):
        time.sleep(0.05)  # however long that takes here
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = results.read_bytes()
    assert before.count(b"\n") >= 3
    results.write_bytes(before + b'{"task": {"figu')  # what a kill in the midst of a line leaves
    base = (out / "models" / "base0" / "manifest.json").stat().st_mtime_ns
    assert main(run) == 0
    after = results.read_bytes()
    assert after.startswith(before)
    tasks = [json.dumps(json.loads(line)["task"]) for line in after.splitlines()]
    assert len(tasks) == len(set(tasks)) == 18
    assert (out / "models" / "base0" / "manifest.json").stat().st_mtime_ns == base
    assert not list((out / "models").glob("*.training"))
    page = (out / "README.md").read_text()
    for figure in ("figure2", "figure3", "single_faults"):
        assert f"]({figure}.png)" in page
        assert (out / f"{figure}.png").read_bytes().startswith(b"\x89PNG")
    assert "near chance" in page
    assert str(out / "README.md") in capsys.readouterr().out
    with (out / "figure2.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["faults"] for row in rows} == {"none", "open", "short"}
    assert all(
        0 <= float(row["low"]) <= float(row["accuracy"]) <= float(row["high"]) <= 1 for row in rows
    )
    assert json.loads((out / "versions.json").read_text())["versions"]["torch"]


def test_a_folder_of_another_run_is_refused(home, capsys):
    out = ["--out", str(home / "other"), "--figure", "3", "--quiet"]
    assert main(command(home, *out)) == 0
    assert main(command(home, *out, "--seeds", "4")) == 3
    assert "holds a run with other settings: give another --out" in capsys.readouterr().err
    assert (home / "other" / "figure3.png").exists()


def test_an_unknown_device_is_one_line(home, capsys):
    assert main(command(home, "--device", "warp", "--out", str(home / "x"), "--quiet")) == 3
    assert "--device warp" in capsys.readouterr().err


def test_windows_added_can_be_chosen_but_not_none(home, capsys):
    assert main(command(home, "--samples", "0", "--out", str(home / "x"), "--quiet")) == 3
    assert "--samples 0" in capsys.readouterr().err
    out = home / "few"
    assert (
        main(command(home, "--figure", "3", "--samples", "64", "32", "--out", str(out), "--quiet"))
        == 0
    )
    assert json.loads((out / "config.json").read_text())["settings"]["samples"] == [32, 64]


@pytest.mark.slow
def test_every_strategy_of_every_figure_answers_every_test_window(bench):
    tasks = [t for t in TINY.tasks(60, (2, 4, 5, 6, 7)) if t.seed == 0]
    assert {t.figure for t in tasks} == {2, 4, 5, 6, 7}
    for task in tasks:
        predicted = bench.predict(task)
        assert predicted.shape == bench.test.y.shape
        assert set(predicted.tolist()) <= {0, 1, 2}
    assert len(bench.validation) == 10 < len(split(bench.setup.windows, seed=0)[1])


def test_open_and_short_hit_the_same_cells_each_recording_its_own_and_fewer_are_among_more(bench):
    healthy = bench.whole.x
    opened = bench.broken("open", 5)
    short = bench.broken("short", 5)
    more = bench.broken("short", 10)
    first = np.unique(bench.whole.recording, return_index=True)[1]
    hit = (short[first] == 1).all(1) & ~(healthy[first] == 1).all(1)
    assert (hit.sum(1) == 5).all()
    assert len({tuple(row) for row in hit}) > 1
    assert (opened[first].transpose(0, 2, 1)[hit] == 0).all()
    assert (more[first].transpose(0, 2, 1)[hit] == 1).all()
    untouched = ~np.repeat(
        hit[np.searchsorted(np.unique(bench.whole.recording), bench.whole.recording)][:, None],
        10,
        1,
    )
    np.testing.assert_array_equal(short[untouched], healthy[untouched])


def test_the_causal_correction_goes_over_whole_recordings(bench):
    x = bench.broken("short", 3)
    out = bench._waiting(x)
    for number in np.unique(bench.whole.recording):
        of = bench.whole.recording == number
        stuck = (x[of] == 1).all((0, 1))
        assert stuck.sum() >= 3
        frames = out[of].reshape(-1, 60)[:, stuck]
        assert (frames[:4] == 1).all()
        assert (frames[4:] == 0).all()


def test_few_windows_of_a_recording_are_tested_but_all_recordings(bench):
    numbers, counts = np.unique(bench.test.recording, return_counts=True)
    np.testing.assert_array_equal(numbers, np.unique(bench.whole.recording))
    assert (counts == 2).all()


def result(seed: int, right: list[int], task: Task | None = None) -> Result:
    y = np.ones(4 * len(right), int)
    predicted = np.concatenate([[1] * r + [0] * (4 - r) for r in right])
    test = Windows(np.zeros((len(y), 1, 1)), y, np.repeat(np.arange(len(right)), 4))
    return Result.of(
        replace(task or Task(2, 0, "short", 5, "nothing"), seed=seed), test, predicted, 0.0
    )


def test_the_mean_of_seeds_is_clustered_by_recording():
    results = [result(0, [4, 4, 1]), result(1, [4, 3, 0])]
    m = mean(results)
    assert m.accuracy == pytest.approx((9 + 7) / 24)
    right = np.concatenate([[1] * r + [0] * (4 - r) for r in (4, 4, 1, 4, 3, 0)])
    assert (m.low, m.high) == pytest.approx(
        accuracy_interval(right, np.tile(np.repeat(np.arange(3), 4), 2))
    )
    assert m.spread == pytest.approx(np.std([9 / 12, 7 / 12], ddof=1))
    with pytest.raises(ValueError, match="no results"):
        mean([])


def test_results_survive_the_way_through_the_file(tmp_path):
    first = Ledger(tmp_path / "r.jsonl")
    first.add(result(0, [4, 2]))
    assert Ledger(tmp_path / "r.jsonl").results == first.results


def test_a_page_reads_the_same_whatever_was_measured_first(tmp_path):
    ledger = Ledger(tmp_path / "r.jsonl")
    tasks = [Task(2, 0, "short", k, "nothing") for k in (2, 5, 10)]
    for task in (tasks[2], tasks[0], tasks[1]):
        ledger.add(result(0, [4, 2], task))
    ledger.arrange(tasks[:2])
    assert list(ledger.results) == tasks


def judged(tmp_path: Path, short: list[int], opened: list[int], free: list[int]) -> dict[str, str]:
    ledger = Ledger(tmp_path / "r.jsonl")
    for faults, k, right in (("none", 0, free), ("short", 5, short), ("open", 5, opened)):
        ledger.add(result(0, right, Task(2, 0, faults, k, "nothing")))
    ledger.add(result(0, opened, Task(6, 0, "short", 5, "correct to 0")))
    return {c.statement.split()[0]: c.verdict for c in judge(ledger, TINY, n_classes=7, present=60)}


def test_claims_are_judged_both_ways(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    full = [4] * 10
    poor = [0, 1, 0, 1, 1, 0, 1, 0, 1, 1]
    assert judged(tmp_path / "a", poor, full, full) == {
        "Five": "holds",
        "Open": "holds",
        "Short": "holds",
    }
    assert judged(tmp_path / "b", full, poor, full) == {
        "Five": "does not hold",
        "Open": "does not hold",
        "Short": "holds",
    }


def test_fault_aware_training_is_judged_beside_as_many_fault_free_steps(tmp_path):
    verdicts = []
    for number, control in enumerate(([2] * 20, [4] * 20)):
        ledger = Ledger(tmp_path / f"{number}.jsonl")
        for strategy, right in (
            (aware(0), [1] * 20),
            (aware(64), [4] * 20),
            (aware(64, "none"), control),
        ):
            ledger.add(result(0, right, Task(4, 0, "mixed", 5, strategy)))
            ledger.add(result(0, [4] * 20, Task(4, 0, "none", 0, strategy)))
        (claim,) = judge(ledger, TINY, n_classes=7, present=60)
        verdicts.append(claim.verdict)
    assert verdicts == ["holds", "holds in part"]


@pytest.mark.parametrize("kind", ["cells", "lines", "blocks", "none"])
def test_the_name_of_a_strategy_tells_its_samples_and_their_faults(kind):
    assert is_aware(aware(64, kind)) == (64, kind)
    assert is_aware("correct to 0, wait 5") is None


def test_a_sensor_with_broken_wiring_has_the_same_faults_in_all_recordings(bench):
    for kind, sizes in (("lines", {5, 6}), ("blocks", set(range(1, 17)))):
        causes = bench.causes(kind, 2)
        assert [len(cause.cells) in sizes for cause in causes] == [True, True]
        cells = sorted({cell for cause in causes for cell in cause.cells})
        x = bench._injected(causes).x[..., cells]
        assert (x == x[:1, :1]).all()
        assert set(np.unique(x)) <= {0, 1}
        assert bench.causes(kind, 2) == causes


def test_other_arrays_get_sizes_that_fit():
    settings = Settings.full()
    assert settings.sizes(settings.adapted, 220) == (0, 5, 10, 20, 50, 100, 150, 200)
    assert settings.sizes(settings.adapted, 136) == (0, 5, 10, 20, 50, 62, 93, 124)
    assert settings.sizes(settings.adapted, 8) == (0, 4, 5, 7)


def test_no_task_is_listed_twice_and_each_figure_has_its_own():
    for settings in (
        Settings.full(),
        Settings.quick(simulated=True),
        Settings.quick(simulated=False),
    ):
        tasks = list(settings.tasks(220, (2, 4, 5, 6, 7)))
        assert len(tasks) == len(set(tasks))
        assert {t.seed for t in tasks} == {0, 1, 2}
        assert aware(max(settings.samples)) in {t.strategy for t in tasks if t.figure == 7}
    assert SensorLayout.paper().n_cells == PAPER_CELLS
