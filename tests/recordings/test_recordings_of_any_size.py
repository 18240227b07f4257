"""Recordings that are larger than memory: the same answers as when they are loaded, and a bounded
memory."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recording_files import csv_blocks

from adaptfault.cli import main
from adaptfault.data.recordings import (
    InputError,
    Recordings,
    load,
    open_recordings,
    save_npz,
)
from adaptfault.data.recordings.formats import spans
from adaptfault.data.recordings.opened import Opened
from diagnostics import SensorLayout

LAYOUT = SensorLayout.paper()
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def log(grasps):
    values = np.concatenate(grasps.frames[::7]).astype(np.float32).copy()
    values.reshape(-1, 2, 11, 10)[:, 1, 5] = 5.0
    values[500:520, 7] = np.nan
    return values


def written(folder, log, kind):
    folder.mkdir(exist_ok=True)
    match kind:
        case "npy":
            np.save(folder / "a.npy", log[:900])
            np.save(folder / "b.npy", log[900:].reshape(-1, 2, 11, 10))
        case "counts":
            np.save(folder / "a.npy", np.nan_to_num(log * 819).astype(np.uint16))
        case "several":
            np.save(folder / "a.npy", log[:1500].reshape(-1, 100, 220))
        case "by column":
            np.save(folder / "a.npy", np.asfortranarray(log))
        case "csv":
            np.savetxt(folder / "a.csv", log[:1500], delimiter=",", fmt="%.4f")
        case "npz":
            save_npz(folder / "a.npz", Recordings((log[:1000], log[1000:1500]), LAYOUT))
        case "bag":
            rosbags = pytest.importorskip("rosbags")
            assert rosbags
            from test_bags import tactile, write_bag

            write_bag(folder / "a", tactile(log[:2000]))
    return folder


@pytest.mark.parametrize("kind", ["npy", "counts", "several", "by column", "csv", "npz", "bag"])
def test_a_log_of_any_size_is_diagnosed_alike(tmp_path, log, kind, monkeypatch, capsys):
    folder = str(written(tmp_path / "log", log, kind))
    said = []
    for size in (None, 700 * 220):
        if size is not None:
            monkeypatch.setattr(Opened.parts, "__defaults__", (size,))
            monkeypatch.setitem(open_recordings.__kwdefaults__, "room", 0)
            monkeypatch.setattr(spans, "PIECE", 100_000)
        shape = [] if kind in ("npz", "bag") else ["--shape", "2x11x10"]
        assert main(["diagnose", folder, "--json", *shape]) == 2
        said.append(json.loads(capsys.readouterr().out))
    assert said[0] == said[1]
    assert any("pad 1, row 5 is short" in fault["reason"] for fault in said[0]["faults"])


def test_a_long_log_is_inspected_part_by_part_with_its_wires_put_back(
    small_grasps, monkeypatch, tmp_path, capsys
):
    layout = small_grasps.layout
    grid = np.stack(small_grasps.frames).reshape(len(small_grasps), -1, *layout.shape)
    healthy = grid[::2]
    swapped = grid[1::2].copy()
    swapped[:, :, 0, [1, 4]] = swapped[:, :, 0, [4, 1]]
    for name, frames in (("healthy", healthy), ("today", swapped)):
        recordings = tuple(one.reshape(-1, layout.n_cells) for one in frames)
        save_npz(tmp_path / f"{name}.npz", Recordings(recordings, layout))
    monkeypatch.setattr(Opened.parts, "__defaults__", (swapped.size // 2,))
    command = [
        "diagnose",
        str(tmp_path / "today.npz"),
        "--reference",
        str(tmp_path / "healthy.npz"),
    ]
    assert main([*command, "--json", "--quiet"]) == 2
    found = json.loads(capsys.readouterr().out)
    assert any("rows 1 and 4" in reason for reason in map(str, found["rewiring"]))
    assert found["faults"] == []
    assert found["n_recordings"] == len(swapped)


def test_what_is_odd_is_counted_over_all_pieces(tmp_path, log):
    values = log[:1000].copy()
    values[30, 3] = np.inf
    values[900, 4:6] = -7.0
    np.save(tmp_path / "a.npy", values)
    opened = open_recordings(tmp_path, full_scale=5.0, room=0)
    seen = np.concatenate(list(opened.pieces(64)))
    values[30, 3] = np.nan
    np.testing.assert_array_equal(seen, values)
    loaded = load(tmp_path, full_scale=5.0)
    problems = [problem.message for problem in (*opened.problems, *opened.late_problems)]
    assert problems == [problem.message for problem in loaded.problems]
    assert [text.partition(": ")[2].split(";")[0] for text in problems] == [
        "1 infinite reading, first in frame 30: taken as missing",
        "20 missing readings, first in frame 500: kept as missing",
        "2 readings outside 0..5 N, first in frame 900, the farthest -7: kept",
    ]


@pytest.mark.parametrize("size", [1, 7, 30, 31, 32, 1000])
@pytest.mark.parametrize("end", [b"", b"3,4", b"3,4,", b"3,4,5,6,7,8", b"3,4,5\0\0\0"])
def test_a_csv_in_pieces_of_any_size_is_what_is_read_at_once(tmp_path, size, end):
    head = ",".join(f"cell_{i}" for i in range(6))
    text = f"{head}\n0,1,2,3,4,5\n\n1,1,2,3,,5\r\n2,1,2,3,4,nan\n".encode()
    (tmp_path / "a.csv").write_bytes(text + end)
    (whole,) = csv_blocks(tmp_path / "a.csv")
    pieces = list(csv_blocks(tmp_path / "a.csv", size))
    values = np.concatenate([piece.values for piece in pieces if len(piece.values)])
    np.testing.assert_array_equal(values, whole.values)
    assert [line for piece in pieces for line in piece.lines] == whole.lines.tolist()
    assert tuple(problem for piece in pieces for problem in piece.problems) == whole.problems


@pytest.mark.parametrize(
    ("bad", "expected"), [("1,2", "line 5: 2 values where"), ("1,x,3", "line 5, column 2: 'x'")]
)
def test_a_bad_line_of_a_csv_in_pieces_is_named(tmp_path, bad, expected):
    (tmp_path / "a.csv").write_text("1,2,3\n" * 4 + bad + "\n" + "1,2,3\n" * 4)
    for size in (1, 1000):
        with pytest.raises(InputError, match=expected):
            list(csv_blocks(tmp_path / "a.csv", size))


def test_layouts_are_settled_as_when_loading(tmp_path):
    values = np.zeros((5000, 6), np.uint16)
    values[4999, 3] = 1000  # in the last block
    np.save(tmp_path / "a.npy", values)
    opened = open_recordings(tmp_path, layout=(1, 2, 3), room=0)
    assert opened.layout == load(tmp_path, layout=(1, 2, 3)).recordings.layout
    assert opened.layout.full_scale == 1023
    table = tmp_path / "tables.csv"
    table.write_text(
        "cell,raw,force\n" + "".join(f"{cell},0,0\n{cell},1000,4\n" for cell in range(6))
    )
    opened = open_recordings(tmp_path / "a.npy", layout=(1, 2, 3), calibration=table, room=0)
    assert (opened.layout.unit, opened.layout.full_scale) == ("N", 4.0)
    assert max(piece.max() for piece in opened.pieces()) == 4.0


@pytest.mark.parametrize("spoil", ["cut", "none", "rate"])
def test_a_file_that_does_not_fit_is_an_input_error(tmp_path, spoil):
    np.save(tmp_path / "a.npy", np.zeros((10, 220), np.float32))
    if spoil == "cut":
        data = (tmp_path / "a.npy").read_bytes()
        (tmp_path / "a.npy").write_bytes(data[:-100])
    if spoil == "none":
        (tmp_path / "a.npy").unlink()
    options = {"rate": -1} if spoil == "rate" else {}
    with pytest.raises(InputError):
        open_recordings(tmp_path, **options)


def test_a_file_of_another_width_is_left_out(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((10, 220), np.float32))
    np.save(tmp_path / "b.npy", np.zeros((10, 219), np.float32))
    opened = open_recordings(tmp_path)
    assert sum(len(piece) for piece in opened.pieces()) == 10
    assert "b.npy" in next(p.message for p in opened.problems if p.level == "error")


def test_memory_does_not_grow_with_the_recording(tmp_path):
    code = (
        "import resource, sys\n"
        "from adaptfault.data.recordings import open_recordings\n"
        "opened = open_recordings(sys.argv[1], room=0)\n"
        "print(sum(len(piece) for piece in opened.pieces()))\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    peaks = []
    for frames in (10_000, 200_000):
        path = tmp_path / "log.npy"
        with open(path, "wb") as file:
            header = {"descr": "<f4", "fortran_order": False, "shape": (frames, 220)}
            np.lib.format.write_array_header_1_0(file, header)
            file.truncate(file.tell() + frames * 880)  # zeros that take no room
        child = [sys.executable, "-c", code, str(path)]
        seen, peak = subprocess.run(
            child, cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.split()
        assert int(seen) == frames
        peaks.append(int(peak) / 1e3)
    assert path.stat().st_size > 170e6
    assert peaks[1] - peaks[0] < 25  # MB
