"""Frames of a scan in files: they are kept apart from readings, and none of them is lost."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptfault.cli import main
from adaptfault.data.recordings import load
from adaptfault.data.recordings.recording import Block
from adaptfault.data.recordings.scans import scan_of, without_scan
from diagnostics import SensorLayout
from diagnostics.simulation.circuit import Circuit, StuckCell
from diagnostics.simulation.scan import scan_circuit

LAYOUT = SensorLayout(1, 6, 5, full_scale=255, unit="count")
D = LAYOUT.n_cells
SCAN = scan_circuit(
    Circuit(SensorLayout(1, 6, 5), faults=(StuckCell(7, np.inf),)), np.full(D, 0.01), repeats=5
)


def readings(frames: int = 12) -> np.ndarray:
    return np.random.default_rng(0).integers(2, 255, (frames, D))


def table(levels, frames) -> str:
    """Return CSV with a column of levels; NaN: empty."""
    lines = [",".join(["scan", *(f"c{i}" for i in range(D))])]
    for level, frame in zip(levels, frames, strict=True):
        first = "" if np.isnan(level) else f"{level:.9g}"
        lines.append(",".join([first, *(f"{value:.9g}" for value in frame)]))
    return "\n".join(lines) + "\n"


def mixed() -> tuple[np.ndarray, np.ndarray]:
    """Return levels and frames: readings, a scan, readings."""
    given_readings = readings()
    none = np.full(6, np.nan)
    levels = np.concatenate([none, SCAN.levels, none])
    return levels, np.concatenate([given_readings[:6], SCAN.readings, given_readings[6:]])


def assert_apart(recordings) -> None:
    np.testing.assert_array_equal(np.concatenate(recordings.frames), readings())
    np.testing.assert_allclose(recordings.scan.levels, SCAN.levels)
    np.testing.assert_allclose(recordings.scan.readings, SCAN.readings, rtol=1e-6)


def test_a_column_scan_takes_its_frames_out_of_the_readings(tmp_path):
    (tmp_path / "log.csv").write_text(table(*mixed()))
    assert_apart(load(tmp_path / "log.csv", layout=LAYOUT).recordings)


def test_so_does_an_array_scan_of_one_recording(tmp_path):
    levels, frames = mixed()
    np.savez(tmp_path / "log.npz", frames=frames, scan=levels)
    assert_apart(load(tmp_path / "log.npz", layout=LAYOUT).recordings)


@pytest.mark.parametrize("stacked", [True, False], ids=["padded", "one behind the other"])
def test_so_does_an_array_scan_of_several_recordings(tmp_path, stacked):
    levels, frames = mixed()
    lengths = [10, len(levels) - 10]
    if stacked:
        padded = np.zeros((2, max(lengths), D))
        scan = np.full(padded.shape[:2], np.nan)
        for i, part in enumerate((slice(0, 10), slice(10, None))):
            padded[i, : lengths[i]] = frames[part]
            scan[i, : lengths[i]] = levels[part]
        np.savez(tmp_path / "log.npz", frames=padded, scan=scan, lengths=lengths)
    else:
        np.savez(tmp_path / "log.npz", frames=frames, scan=levels, lengths=lengths)
    assert_apart(load(tmp_path / "log.npz", layout=LAYOUT).recordings)


def test_a_file_of_a_scan_alone_is_no_recording_and_is_not_lost(tmp_path):
    (tmp_path / "a.csv").write_text(table(np.full(12, np.nan), readings()))
    (tmp_path / "a_scan.csv").write_text(table(SCAN.levels, SCAN.readings))
    loaded = load(tmp_path, layout=LAYOUT)
    assert len(loaded.recordings) == 1
    assert_apart(loaded.recordings)


def test_a_column_of_this_name_that_holds_something_else_is_ignored_with_a_warning(tmp_path):
    (tmp_path / "log.csv").write_text(table(np.arange(12) % 2, readings()))
    loaded = load(tmp_path / "log.csv", layout=LAYOUT)
    assert loaded.recordings.scan is None
    np.testing.assert_array_equal(loaded.recordings.frames[0], readings())
    assert any("'scan' is ignored" in str(problem) for problem in loaded.problems)


def test_an_array_scan_of_another_length_is_refused_in_one_line(tmp_path):
    np.savez(tmp_path / "log.npz", frames=readings(), scan=np.zeros(3))
    with pytest.raises(ValueError, match=r"array 'scan' is float64 \[3\]; expected one number"):
        load(tmp_path / "log.npz", layout=LAYOUT)


def test_a_scan_of_another_array_is_left_out_with_a_warning(tmp_path):
    (tmp_path / "a.csv").write_text(table(np.full(12, np.nan), readings()))
    np.savez(tmp_path / "b.npz", frames=SCAN.readings[:, :6], scan=SCAN.levels)
    loaded = load(tmp_path, layout=LAYOUT)
    assert loaded.recordings.scan is None
    assert any("of another array" in str(problem) for problem in loaded.problems)


levels = st.lists(st.sampled_from([np.nan, 0.0, 0.25, 1.0]), min_size=1, max_size=12)


@given(levels)
def test_each_frame_of_a_block_is_a_reading_or_of_a_scan(given_levels):
    scan = np.array(given_levels)
    frames = np.random.default_rng(0).random((len(scan), 3))
    block = Block(frames, np.arange(len(scan)), np.arange(len(scan), dtype=float), scan=scan)
    rest = without_scan(block)
    taken = scan_of(block)
    assert len(rest.values) + len(taken) == len(scan)
    np.testing.assert_array_equal(rest.values, frames[np.isnan(scan)])
    np.testing.assert_array_equal(rest.lines, np.flatnonzero(np.isnan(scan)))
    assert [level for level, _ in taken] == scan[~np.isnan(scan)].tolist()


def test_a_mask_of_recordings_with_a_scan_is_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "log.csv").write_text(table(*mixed()))
    out = str(tmp_path / "valid.npz")
    arguments = ["check", str(tmp_path / "log.csv"), "--shape", "6x5", "--write-valid", out]
    assert main([*arguments, "--full-scale", "255"]) == 3
    assert "leave the scan out" in capsys.readouterr().err.strip().splitlines()[-1]


def test_diagnose_tells_what_the_scan_says_with_nobody_touching(tmp_path, capsys):
    rest = np.full((40, D), 3)
    (tmp_path / "today.csv").write_text(table(np.full(40, np.nan), rest))
    (tmp_path / "today_scan.csv").write_text(table(SCAN.levels, SCAN.readings))
    arguments = ["diagnose", str(tmp_path), "--shape", "6x5", "--full-scale", "255", "--json"]
    assert main(arguments) == 1
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    (fault,) = found["faults"]
    assert fault["cells"] == [7]
    assert "does not answer the scan" in fault["reason"]
    assert f"scan: {D} of {D} cells tested" in captured.err


def test_where_crossings_conduct_alike_the_option_states_that_lines_are_held(tmp_path, capsys):
    healthy = scan_circuit(Circuit(SensorLayout(1, 6, 5)), np.full(D, 0.01), repeats=5)
    frames = np.concatenate([np.full((40, D), 2), healthy.readings])
    (tmp_path / "layout.json").write_text(json.dumps(LAYOUT.to_dict()))
    levels = np.concatenate([np.full(40, np.nan), healthy.levels])
    (tmp_path / "log.csv").write_text(table(levels, frames))
    untested = {}
    for stated in ([], ["--lines-held"]):
        main(["diagnose", str(tmp_path), "--json", *stated])
        captured = capsys.readouterr()
        untested[len(stated)] = json.loads(captured.out)["coverage"]["untested"]
        assert ("state --lines-held" in captured.err) == (not stated)
    assert untested == {0: list(range(D)), 1: []}
