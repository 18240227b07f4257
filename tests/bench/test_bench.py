"""The bench: others enter it by the door that ours enters by, and nobody sees the truth."""

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from adaptfault.bench.__main__ import main
from adaptfault.bench.folder import SMALL, Bench, Size, make
from adaptfault.bench.score import accuracies, scores, submission
from adaptfault.data.recordings import load

HOME = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(HOME / "benchmarks"))

OURS = "adaptfault.bench.methods"
METHODS = """
import os
import signal

import numpy as np

class All:
    def fit(self, recordings, layout):
        self.cells = layout.n_cells
    def detect(self, recordings):
        return np.ones(self.cells, bool)

class Killed(All):
    calls = 0
    def detect(self, recordings):
        Killed.calls += 1
        if Killed.calls == 4 and os.environ.get("KILL"):
            os.kill(os.getpid(), signal.SIGKILL)
        return recordings[0][0] > 0.1 * recordings[0].max()

class Fails(All):
    def detect(self, recordings):
        if len(recordings) < 10:
            raise RuntimeError("no\\nlicence")
        return np.ones(3, bool)

class First:
    def fit(self, x, y, faults, layout):
        self.y = y
    def predict(self, x):
        return np.full(len(x), self.y[0])

class Halves(First):
    def predict(self, x):
        return np.full(len(x), 0.5)
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    home = tmp_path_factory.mktemp("bench")
    truth = make(home / "logs", home / "truth", 3, SMALL)
    truth.rename(home / "truth.json")
    (home / "methods_of_others.py").write_text(METHODS)
    return home


@pytest.fixture
def place(home, tmp_path, monkeypatch) -> Path:
    """A copy of it, as the working directory."""
    shutil.copytree(home, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return tmp_path


def run(method: str, out: str = "sub.json", role: str = "diagnoser") -> int:
    return main(["run", "logs", f"--{role}", method, "--out", out])


def told_truth(place: Path) -> dict:
    return json.loads((place / "truth.json").read_text())


def of_all(place: Path, name: str):
    bench = Bench(place / "logs")
    return scores(submission(place / name, bench), bench, told_truth(place))["all"]


def test_a_perfect_method_scores_1(place):
    truth = told_truth(place)
    assert run("methods_of_others:All") == 0
    assert run("methods_of_others:First", "repaired.json", "repairer") == 0
    perfect = json.loads(Path("sub.json").read_text())
    for name, told in truth["logs"].items():
        hidden = set(told["dead"]) - set(told["testable"])
        perfect["results"][name] = {"faulty": told["testable"], "untested": sorted(hidden)}
        perfect["results"][name] |= {"wires": told["wires"], "seconds": 1.0}
    Path("sub.json").write_text(json.dumps(perfect))
    score = of_all(place, "sub.json")
    shares = score.precision, score.recall, score.wires
    assert [share.value for share in shares] == [1, 1, 1]
    assert score.honest.part == score.honest.of
    assert score.blamed.part == score.undecided.part == 0
    perfect = json.loads(Path("repaired.json").read_text())
    for name, told in truth["repairs"].items():
        perfect["results"][name]["predicted"] = told["y"]
    assert {share.value for share in accuracies(perfect, truth).values()} == {1.0}


def test_a_method_that_blames_all_cells_has_the_precision_of_the_base_rate(place):
    assert run("methods_of_others:All") == 0
    score = of_all(place, "sub.json")
    logs = Bench(place / "logs").manifest["logs"]
    truth = told_truth(place)["logs"]
    broken = [name for name, told in truth.items() if told["dead"]]
    dead = sum(len(truth[name]["dead"]) for name in broken)
    assert score.precision.value == dead / sum(logs[name]["cells"] for name in broken)
    assert score.recall.value == score.honest.value == 1
    healthy = [logs[name]["cells"] for name in truth if name not in broken]
    assert score.blamed.value == np.mean(healthy)
    assert score.wires.of == 0  # it names none


def test_the_folder_does_not_hold_the_truth(place):
    manifest = Bench(place / "logs").manifest
    truth = told_truth(place)
    kinds = {told["kind"] for told in truth["logs"].values()}
    assert kinds == {"healthy", "disturbed", "dead", "dead later", "wires", "moving"}
    assert "kind" not in json.dumps(manifest)
    for task in [*manifest["logs"].values(), *manifest["repairs"].values()]:
        assert load(place / "logs" / task["file"]).recordings.labels is None
    (order, *_) = [told["y"] for told in truth["repairs"].values()]
    assert order != sorted(order)


def test_the_same_seed_gives_the_same_bench_and_another_one_another(tmp_path):
    size = Size(("finger, rest wanders",), 1, 4, 2, 1)
    seeds = {"a": 5, "b": 5, "c": 6}
    names = [make(tmp_path / name, tmp_path, seed, size) for name, seed in seeds.items()]
    assert names[0] == names[1] != names[2]
    assert Bench(tmp_path / "a").identity == Bench(tmp_path / "b").identity
    assert Bench(tmp_path / "a").identity != Bench(tmp_path / "c").identity


def test_a_changed_byte_of_a_log_or_of_the_truth_is_refused(place, capsys):
    assert run("methods_of_others:All") == 0
    truth = bytearray(Path("truth.json").read_bytes())
    truth[-1] ^= 1
    Path("changed.json").write_bytes(truth)
    assert main(["score", "logs", "changed.json", "sub.json"]) == 3
    assert "the truth of logs has" in capsys.readouterr().err
    log = Path("logs/log-003.npz")
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 1
    log.write_bytes(data)
    assert run("methods_of_others:All", "new.json") == 3
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "log-003.npz was changed" in error
    assert not Path("new.json").exists()


def without_seconds(path: str) -> str:
    found = json.loads(Path(path).read_text())
    for result in found["results"].values():
        del result["seconds"]
    return json.dumps([found["bench"], found["method"], found["results"]])


def test_killed_and_started_again_gives_the_same_file(place, monkeypatch):
    name = "methods_of_others:Killed"
    command = [sys.executable, "-m", "adaptfault.bench", "run", "logs", "--diagnoser", name]
    monkeypatch.setenv("KILL", "1")
    monkeypatch.setenv("PYTHONPATH", f"{HOME}:{place}")
    killed = subprocess.run([*command, "--out", "sub.json"], capture_output=True)
    assert killed.returncode == -signal.SIGKILL
    first = json.loads(Path("sub.json").read_text())["results"]
    assert len(first) == 3
    monkeypatch.delenv("KILL")
    assert run(name) == 0
    assert json.loads(Path("sub.json").read_text())["results"].items() >= first.items()
    assert run(name, "whole.json") == 0
    assert without_seconds("sub.json") == without_seconds("whole.json")


def test_our_own_methods_enter_by_the_same_door(place, monkeypatch):
    monkeypatch.setattr(f"{OURS}.EPOCHS", 1)
    assert run(f"{OURS}:Cold", "cold.json") == 0
    assert run(f"{OURS}:Fitted", "fitted.json") == 0
    cold = of_all(place, "cold.json")
    fitted = of_all(place, "fitted.json")
    assert cold.blamed.part == fitted.blamed.part == 0
    assert fitted.recall.part > cold.recall.part > 0
    assert fitted.wires.value == 1
    versions = json.loads(Path("fitted.json").read_text())["versions"]
    assert versions["numpy"] == np.__version__
    assert main(["score", "logs", "truth.json", "cold.json", "fitted.json", "--page", "p.md"]) == 0
    page = Path("p.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith(f"| `{OURS}")]
    assert len(rows) == 4
    assert rows[1].split("|")[2].strip() == str(fitted.precision)


def test_our_repair_enters_by_the_same_door(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(f"{OURS}.EPOCHS", 1)
    truth = make(Path("logs"), Path("truth"), 0, Size(("finger, rest wanders",), 1, 2, 4, 2))
    assert run(f"{OURS}:Repaired", "sub.json", "repairer") == 0
    found = submission(Path("sub.json"), Bench(Path("logs")))
    reached = accuracies(found, json.loads(truth.read_text()))
    assert list(reached) == ["none", "10 %", "50 %", "a line"]
    assert sum(share.part for share in reached.values()) > sum(s.of for s in reached.values()) / 7


def test_a_method_that_fails_is_told_in_a_line_and_nothing_else_is_lost(place, capsys):
    assert run("methods_of_others:Fails") == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("log-")]
    results = json.loads(Path("sub.json").read_text())["results"]
    assert len(lines) == len(results) == len(told_truth(place)["logs"])
    assert sum("detect raised RuntimeError: no licence; mend it" in line for line in lines) > 5
    assert any("detect returned bool of shape (3,); expected bool of shape" in x for x in lines)
    assert main(["score", "logs", "truth.json", "sub.json"]) == 0
    assert f"| {len(results)} |" in capsys.readouterr().out  # failed, as no answer
    assert run("methods_of_others:Halves", "repaired.json", "repairer") == 1
    assert "expected whole numbers of shape (14,), the class of each" in capsys.readouterr().err


def test_a_submission_that_is_cut_off_unfinished_or_of_another_seed_is_refused(place, capsys):
    assert run("methods_of_others:All") == 0

    def refused(expected: str, *arguments: str) -> None:
        assert main([*arguments]) == 3
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert expected in error

    score = ["score", "logs", "truth.json", "changed.json"]
    data = Path("sub.json").read_text()
    Path("changed.json").write_text(data[:-40])
    refused("it is cut off or damaged", *score)
    found = json.loads(data)
    del found["results"]["log-002"]
    Path("changed.json").write_text(json.dumps(found))
    refused("1 of 11 logs are missing; run the same command to finish it", *score)
    Path("changed.json").write_text(json.dumps(found | {"bench": "0" * 64}))
    refused("is of bench 000000000000..., logs is", *score)
    Path("changed.json").write_text(json.dumps(found | {"schema": "other"}))
    refused("expected schema adaptfault.submission/1, got other", *score)
    again = ["run", "logs", "--diagnoser", "methods_of_others:Killed", "--out", "sub.json"]
    refused("is of method methods_of_others:All, expected methods_of_others:Killed", *again)
    refused("logs holds files; choose a new folder", "make", "logs")


def test_tsb_ad_reads_the_exported_logs_back(place):
    import pandas as pd

    assert main(["export", "logs", "truth.json", "--tsb-ad", "tsb"]) == 0
    bench = Bench(place / "logs")
    faulty = [x for x in told_truth(place)["logs"].items() if "1" in x[1]["shows"]]
    files = sorted(Path("tsb").iterdir())
    assert len(files) == len(faulty) > 4
    for file, (name, told) in zip(files, faulty, strict=True):
        # as TSB_AD/benchmark_exp/Run_Detector_M.py reads it
        table = pd.read_csv(file).dropna()
        data = table.iloc[:, 0:-1].values.astype(float)
        label = table["Label"].astype(int).to_numpy()
        train = int(file.name.split(".")[0].split("_")[-3])
        first = int(file.name.split(".")[0].split("_")[-1])
        about = bench.manifest["logs"][name]
        log = np.concatenate(bench.recordings(about["file"]).frames)
        assert np.array_equal(data[train:], log)
        assert not label[:train].any()
        assert first == np.flatnonzero(label)[0] >= train
        assert "".join(map(str, label[train:])) == told["shows"]


@pytest.mark.parametrize("name", ["Zeros", "Mean", "Knn", "Trees"])
def test_a_baseline_of_the_repair_does_not_depend_on_what_dead_cells_read(name):
    import baselines

    rng = np.random.default_rng(0)
    y = np.arange(60) % 3
    x = rng.random((60, 4, 16), dtype=np.float32) + y[:, None, None]
    faults = np.arange(16) % 5 == 0
    method = getattr(baselines, name)()
    method.fit(x, y, ~faults, None)
    method.fit(x, y, faults, None)
    garbled = np.where(faults, rng.random(x.shape), x)
    assert np.array_equal(method.predict(garbled), method.predict(x))
    assert (method.predict(x) == y).mean() > 0.9


def test_saqc_calls_a_cell_faulty_that_is_constant_over_the_last_quarter():
    pytest.importorskip("saqc", reason="SaQC is missing: pip install saqc")
    import baselines

    frames = np.random.default_rng(0).random((40, 4))
    frames[28:, 1] = 0.5
    frames[33:, 2] = 0.5
    frames[:30, 3] = 0.5
    assert baselines.Saqc().fit([frames], None).detect([frames]).tolist() == [0, 1, 0, 0]
