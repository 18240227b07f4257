"""A data set in parts: what was kept is not made again, and the verdict is that of the whole."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from adaptfault.cli import main
from adaptfault.data.simulated_grasps import simulate
from adaptfault.inspection import parts
from adaptfault.inspection.parts import Work, in_parts
from diagnostics import SensorLayout

LAYOUT = SensorLayout(1, 6, 6, full_scale=3.3, unit="V", rate=20.0)
STATED = ("--shape", "6x6", "--full-scale", "3.3", "--rate", "20")
OPTIONS = {"shape": (1, 6, 6), "full_scale": 3.3, "rate": 20.0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """24 recordings; a cell is stuck in the later half, and a file is damaged."""
    root = tmp_path_factory.mktemp("parts") / "set"
    root.mkdir()
    frames = simulate(4, LAYOUT, n_frames=50, seed=3).frames
    for number, one in enumerate(frames[:24]):
        readings = np.array(one, np.float32)
        if number >= 12:
            readings[:, 21] = 1.1
        np.savetxt(root / f"{number:02d}.csv", readings, delimiter=",", fmt="%.4f")
    (root / "broken.csv").write_text("1,2\nx\n")
    return root


def told(out: Path) -> dict:
    return json.loads(out.read_text())


def check(folder: Path, out: Path, *options: str) -> int:
    return main(["check", str(folder), *STATED, "--quiet", "--out", str(out), *options])


@pytest.mark.parametrize("options", [("1",), ("5",), ("60",), ("5", "--jobs", "2")])
def test_the_verdict_of_parts_is_that_of_the_whole(options, folder, tmp_path):
    assert check(folder, tmp_path / "whole.json", "--quick") == 1
    keep = ("--shard", *options, "--keep", str(tmp_path / "keep"))
    assert check(folder, tmp_path / "parts.json", *keep) == 1
    whole = told(tmp_path / "whole.json")
    merged = told(tmp_path / "parts.json")
    for name in ("inspection", "findings", "summary", "left_out", "leave_out", "severity"):
        assert merged[name] == whole[name]
    assert whole["inspection"]["diagnosis"]["faults"][0]["cells"] == [21]


def test_after_a_kill_only_the_parts_that_are_left_are_made(folder, tmp_path):
    keep = tmp_path / "keep"
    out = tmp_path / "out.json"
    arguments = ["check", str(folder), *STATED, "--shard", "12", "--keep", str(keep)]
    command = [sys.executable, "-m", "adaptfault", *arguments, "--out", str(out)]
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not list(keep.glob("*.npz")) and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(running.pid, signal.SIGKILL)
    running.wait()
    kept = {place: place.stat().st_mtime_ns for place in keep.glob("*.npz")}
    assert kept
    out.unlink(missing_ok=True)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert f"{len(kept)} of 12 parts were in" in done.stderr
    assert {place: place.stat().st_mtime_ns for place in kept} == kept
    check(folder, tmp_path / "whole.json", "--quick")
    assert told(out)["findings"] == told(tmp_path / "whole.json")["findings"]


def test_a_file_that_changed_is_read_anew_and_another_way_to_read_is_another_part(folder, tmp_path):
    copy = tmp_path / "set"
    copy.mkdir()
    for file in sorted(folder.glob("[0-9]*.csv"))[:6]:
        (copy / file.name).write_bytes(file.read_bytes())
    work = Work((str(copy),), OPTIONS, 3)
    assert in_parts(work, tmp_path / "keep")[1] == 0
    assert in_parts(work, tmp_path / "keep")[1] == 3
    assert in_parts(Work((str(copy),), {**OPTIONS, "rate": 40.0}, 3), tmp_path / "keep")[1] == 0
    os.utime(copy / "00.csv", ns=(1, 1))
    assert in_parts(work, tmp_path / "keep")[1] == 0


@pytest.mark.slow
def test_the_workers_of_a_cluster_do_it(folder, tmp_path):
    distributed = pytest.importorskip("distributed")
    work = Work((str(folder),), OPTIONS, 4)
    here, _ = in_parts(work, tmp_path / "here")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
    ) as cluster:
        there, _ = in_parts(work, tmp_path / "there", dask=cluster.scheduler_address)
    assert there.naming == here.naming
    np.testing.assert_array_equal(there.together.sums, here.together.sums)
    with pytest.raises(ValueError, match="address of a Dask scheduler"):
        in_parts(work, tmp_path / "nowhere", dask="nowhere")


def test_a_worker_that_is_lost_is_told_and_what_was_made_stays(folder, tmp_path, monkeypatch):
    def lost(work, number):
        if number == 2:
            raise MemoryError
        return made(work, number)

    made = parts.made
    monkeypatch.setattr(parts, "made", lost)
    work = Work((str(folder),), OPTIONS, 4)
    with pytest.raises(MemoryError):
        in_parts(work, tmp_path / "keep")
    monkeypatch.undo()
    assert in_parts(work, tmp_path / "keep")[1] == 2


@pytest.mark.parametrize(
    "options",
    [("--shard", "3"), ("--keep", "k"), ("--shard", "1/2", "--jobs", "2"), ("--shard", "0")],
)
def test_options_that_belong_together_are_asked_for(options, folder, tmp_path, capsys):
    given = [str(tmp_path / one) if one == "k" else one for one in options]
    assert main(["check", str(folder), *given, "--out", str(tmp_path / "o.npz")]) == 3
    assert "--shard" in capsys.readouterr().err
