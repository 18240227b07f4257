"""The benchmark runs any detector with ``fit`` and ``detect`` on the logs that ours gets."""

import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import diagnosis
from arrays import Array, grasps, simulated
from own_method import FIGURES_OF_F, ROWS_OF_F, OwnMethod
from rows import ROWS

from adaptfault.bench.methods import DIAGNOSER, find_method
from diagnostics import SensorLayout

HOME = Path(__file__).resolve().parents[2]
LAYOUT = SensorLayout(1, 4, 4)
TINY = Array("tiny", ("cells", "healthy", "lines", "cold"), simulated(grasps(LAYOUT), 28), 2)


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The detector of the page, in a module of the working directory."""
    page = (HOME / "docs" / "bench.md").read_text()
    code, _ = re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    (tmp_path / "method_of_the_page.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    return "method_of_the_page:MyDetector"


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(diagnosis, "ARRAYS", [TINY])
    monkeypatch.setattr(sys, "argv", ["diagnosis.py", "--jobs", "1", "--splits", "0", *arguments])
    return diagnosis.main()


def test_a_detector_has_a_column_beside_ours_in_the_same_table(example, monkeypatch, capsys):
    out = ["--out", "counts.jsonl"]
    assert run(monkeypatch, "--method", example, "baselines:Constant", *out) == 0
    shown = capsys.readouterr().out
    head, *lines = shown.splitlines()
    assert head.split()[::2] == ["SelfDiagnosis", example, "baselines:Constant"]
    assert [line[:91].split(None, 1)[1].strip() for line in lines[:-1]] == [
        "16 % dead: precision",
        "16 % dead: recall",
        "healthy: false alarms",
    ]
    assert lines[-1] == "left out, they need more than F: lines, cold"
    counts = [json.loads(line) for line in Path("counts.jsonl").read_text().splitlines()]
    testable = {
        count.get("method", ""): count["of"]
        for count in counts
        if count["row"] == "16 % dead: recall"
    }
    assert len(testable) == 3
    assert len(set(testable.values())) == 1  # the same logs and faults
    assert run(monkeypatch, "--method", example, "baselines:Constant", *out) == 0
    assert capsys.readouterr().out == shown
    assert len(Path("counts.jsonl").read_text().splitlines()) == len(counts)


def test_every_row_of_a_detector_needs_no_more_than_f():
    bench = TINY.bench(0, 0, 1)
    bench.method = "baselines:Constant"
    for row in set(ROWS_OF_F) - {"moving"}:
        names = [count.row for count in ROWS[row](bench)]
        assert any(name.endswith(FIGURES_OF_F) for name in names), row


def test_a_constant_cell_and_one_without_a_reading_are_faulty_for_the_baseline():
    frames = np.random.default_rng(0).random((20, 16))
    frames[:, 3] = 0.4
    frames[:, 5] = np.nan
    frames[::2, 7] = np.nan
    found = OwnMethod("baselines:Constant", LAYOUT).fit([frames]).diagnose([frames[:9], frames[9:]])
    assert set(found.fault_set) == {3, 5}


def test_a_detector_gets_copies_and_positions_without_a_cell_are_not_counted(tmp_path, monkeypatch):
    (tmp_path / "method_that_writes.py").write_text(
        "class Writes:\n"
        "    def fit(self, recordings, layout):\n"
        "        recordings[0][:] = 9\n"
        "    def detect(self, recordings):\n"
        "        recordings[0][:] = 9\n"
        "        return recordings[0][0] == 9\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    present = np.ones((1, 2, 3), bool)
    present[0, 0, 0] = False
    layout = SensorLayout(1, 2, 3, present=present)
    frames = np.zeros((4, 6))
    found = OwnMethod("method_that_writes:Writes", layout).fit([frames]).diagnose([frames])
    assert set(found.fault_set) == {1, 2, 3, 4, 5}
    assert not frames.any()


def test_what_is_no_detector_is_refused_with_what_to_do(tmp_path, monkeypatch, capsys):
    (tmp_path / "method_of_a_kind.py").write_text(
        "class Half:\n"
        "    def fit(self, recordings, layout): ...\n"
        "class Numbers(Half):\n"
        "    def detect(self, recordings): return [1, 2]\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match="expected module:Name, such as my_package:MyDetector"):
        find_method("baselines", DIAGNOSER)
    with pytest.raises(ValueError, match="baselines has no Nothing; correct the name"):
        find_method("baselines:Nothing", DIAGNOSER)
    with pytest.raises(ValueError, match=r"it has no detect; a method has fit.*add what"):
        find_method("method_of_a_kind:Half", DIAGNOSER)
    with pytest.raises(ImportError, match="no_such_module cannot be imported"):
        find_method("no_such_module:Name", DIAGNOSER)
    with pytest.raises(ValueError, match=r"returned int64 of shape \(2,\); expected bool of"):
        OwnMethod("method_of_a_kind:Numbers", LAYOUT).diagnose([np.zeros((3, 16))])
    with pytest.raises(SystemExit):
        run(monkeypatch, "--method", "baselines:Constant", "--speed")
    assert "--against and --speed are for ours alone: leave them out" in capsys.readouterr().err


def test_capa_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "skchange", None)
    monkeypatch.setitem(sys.modules, "skchange.detectors", None)
    with pytest.raises(SystemExit):
        run(monkeypatch, "--method", "baselines:Capa")
    assert "pip install 'skchange>=0.18'" in capsys.readouterr().err


@dataclass
class Held:
    """Has the methods of CAPA that are called: the frames at the end that are one and the same."""

    max_segment_length: int

    def fit(self, x: np.ndarray) -> None:
        assert x.shape == (40, 1)  # the reference

    def predict_segment_anomalies(self, x: np.ndarray) -> np.ndarray:
        assert x.shape == (self.max_segment_length, 1)
        changed = np.flatnonzero(np.diff(x[:, 0]))
        start = changed[-1] + 1 if len(changed) else 0
        return np.array([[start, len(x)]])


def test_capa_calls_a_cell_faulty_whose_anomaly_lasts_for_the_last_quarter(monkeypatch):
    monkeypatch.setitem(sys.modules, "skchange", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "skchange.detectors", SimpleNamespace(CAPA=Held))
    healthy, frames = np.random.default_rng(0).random((2, 40, 16))
    frames[:, 2] = 0.5
    frames[30:, 4] = 0.5
    frames[31:, 6] = 0.5
    frames[:, 8] = np.nan
    own = OwnMethod("baselines:Capa", LAYOUT).fit([healthy])
    assert set(own.diagnose([frames[:25], frames[25:]]).fault_set) == {2, 4, 8}
