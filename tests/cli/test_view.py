"""adaptfault view: recordings and their diagnosis as files for Foxglove and Rerun."""

import base64
import json

import numpy as np
import pytest

from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.viewers.timed_log import State
from diagnostics import Diagnosis, Fault, SensorLayout, inject

LAYOUT = SensorLayout(1, 2, 3, full_scale=1.0, unit="V", rate=50.0)


@pytest.fixture
def log(tmp_path, rng):
    """Three short recordings."""
    frames = tuple(rng.uniform(0, 1, (20, 6)).astype(np.float32) for _ in range(3))
    save_npz(tmp_path / "log.npz", Recordings(frames, LAYOUT))
    return tmp_path / "log.npz"


@pytest.fixture
def diagnosis(tmp_path):
    found = Diagnosis(LAYOUT, (Fault("short", (4,)),), np.zeros(6), np.ones(6, bool), 60, 3)
    (tmp_path / "diagnosis.json").write_text(json.dumps(found.to_dict()))
    return tmp_path / "diagnosis.json"


def grids(path, topic: str) -> list[dict]:
    reader = pytest.importorskip("mcap.reader")
    with open(path, "rb") as file:
        messages = reader.make_reader(file).iter_messages(topics=[topic])
        return [json.loads(message.data) for _, _, message in messages]


def states(path, pad: int) -> np.ndarray:
    """The states of a pad as a file shows them first, the top row first."""
    grid = grids(path, f"/tactile/{pad}/states")[0]
    packed = np.frombuffer(base64.b64decode(grid["data"]), np.uint8)
    return packed.reshape(-1, grid["column_count"], 5)[::-1, :, 0]


def test_a_diagnosis_of_a_file_is_shown_on_both(log, diagnosis, tmp_path, capsys):
    pytest.importorskip("rerun")
    outputs = ["--mcap", str(tmp_path / "o.mcap"), "--rrd", str(tmp_path / "o.rrd")]
    assert main(["view", str(log), "--diagnosis", str(diagnosis), *outputs, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["recordings"], told["frames"], told["fault_set"]) == (3, 60, [4])
    assert told["seconds"] == pytest.approx(3 * 0.4 + 2)
    assert (told["mcap"], told["rrd"]) == (outputs[1], outputs[3])
    assert len(grids(outputs[1], "/tactile/0/readings")) == 60
    assert states(outputs[1], 0).tolist() == [[1, 1, 1], [1, State.FAULTY, 1]]
    assert (tmp_path / "o.rrd").stat().st_size > 1000


def test_a_bundle_diagnoses_the_log_and_its_layout_is_used(
    made_bundle, later_grasps, broken_row, tmp_path, capsys
):
    layout = SensorLayout(2, 6, 5)
    frames = tuple(inject(r, [broken_row], layout).astype(np.float32) for r in later_grasps)
    save_npz(tmp_path / "today.npz", Recordings(frames, layout))
    out = str(tmp_path / "o.mcap")
    command = ["view", str(tmp_path / "today.npz"), "--bundle", str(made_bundle), "--mcap", out]
    assert main(command) == 0
    assert "5 of 60 cells faulty" in capsys.readouterr().out
    shown = np.concatenate([states(out, pad).ravel() for pad in range(2)])
    assert set(np.flatnonzero(shown == State.FAULTY)) == set(broken_row.cells)


def test_without_anything_to_compare_with_the_log_is_diagnosed_on_its_own(log, tmp_path, capsys):
    assert main(["view", str(log), "--mcap", str(tmp_path / "o.mcap")]) == 0
    assert "3 recordings, 3.2 s, " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "no output is named; give --mcap FILE.mcap for Foxglove, or --rrd FILE.rrd"),
        (["--mcap", "o.bag"], "--mcap o.bag: expected a name that ends in .mcap"),
        (["--rrd", "o.mcap"], "--rrd o.mcap: expected a name that ends in .rrd"),
        (["--rrd", ""], "--rrd '': name a file"),
        (["--rrd", "nowhere/o.rrd"], "the folder nowhere is not there"),
        (["--mcap", "o.mcap", "--diagnosis", "no.json"], "no.json: is not there"),
        (["--mcap", "o.mcap", "--diagnosis", "bad.json"], "bad.json: not a diagnosis"),
        (["--mcap", "o.mcap", "--diagnosis", "other.json"], "1 x 2 x 2"),
        (["--mcap", "o.mcap", "--trust", "bad.json"], "--trust needs a bundle"),
        (["--mcap", "o.mcap", "--bundle", "."], "expected a bundle"),
    ],
)
def test_unusable_options_are_named(options, message, log, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.json").write_text("{}")
    small = SensorLayout(1, 2, 2, full_scale=1.0, unit="V", rate=50.0)
    other = Diagnosis(small, (), np.zeros(4), np.ones(4, bool), 60, 3)
    (tmp_path / "other.json").write_text(json.dumps(other.to_dict()))
    assert main(["view", str(log), *options]) == 3
    assert message in capsys.readouterr().err
    assert not (tmp_path / "o.mcap").exists()
