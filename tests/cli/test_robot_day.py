"""A day of a robot's life, through the command line: every command as the robot would run it,
frames over a socket."""

import json
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from adaptfault.acquisition import format_packet
from adaptfault.bundle.bundle import Bundle
from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.data.windows import make_windows
from adaptfault.prediction.predictor import Predictor
from diagnostics import FaultKind, Line, SensorLayout, inject, line_fault

LAYOUT = SensorLayout(2, 6, 5)
RATE = 10.0


def run(*args: object) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-m", "adaptfault", *map(str, args)], capture_output=True, text=True
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, done.stdout


def listen(bundle: Path, frames: np.ndarray, folder: Path) -> list[dict]:
    """Send frames to `adaptfault listen`, which records them; return what it told."""
    command = [
        sys.executable,
        "-m",
        "adaptfault",
        "listen",
        str(bundle),
        "--port",
        "0",
        "--record",
        str(folder),
    ]
    command += ["--when", "always", "--frames", str(len(frames)), "--seconds", "120", "--json"]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe, text=True
    ) as station:
        port = int(station.stderr.readline().split("port ")[1].split(",")[0])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for i, frame in enumerate(frames):
                sender.sendto(format_packet("hand", i / RATE, frame), ("127.0.0.1", port))
                if i % 20 == 19:
                    time.sleep(0.02)
        out, err = station.communicate(timeout=150)
    assert station.returncode == 0, err
    return [json.loads(line) for line in out.splitlines()]


def broken(recordings, *faults):
    return [inject(r, faults, LAYOUT) for r in recordings]


@pytest.mark.slow
def test_a_day_of_a_robots_life(bundle, later_grasps, broken_row, tmp_path, capsys):
    def here(*args: object) -> tuple[int, str]:
        """The same command within this process: starting another one, and its export, take
        longer."""
        capsys.readouterr()
        return main([str(arg) for arg in args]), capsys.readouterr().out

    path = bundle.path
    column = line_fault(LAYOUT, Line(0, "column", 3), FaultKind.SHORT)

    # In the morning a row breaks. The monitor tells so while frames come in over UDP, and all is
    # recorded.
    morning = np.concatenate([*later_grasps[:6], *broken(later_grasps[6:14], broken_row)])
    told = listen(path, morning, tmp_path / "morning")
    assert [event["kind"] for event in told if event.get("kind") in ("class", "recorded")].count(
        "recorded"
    ) == 1
    assert any("pad 1, row 2 is short" in event.get("text", "") for event in told)
    assert told[-1]["counters"]["kept"] == len(morning)

    # At the dock: found, repaired, deployed on probation.
    code, out = run(
        "maintain", path, tmp_path / "morning", "--quiet", "--report", tmp_path / "skin.html"
    )
    assert code in (1, 2), out
    assert out.startswith("ADAPTFAULT "), out
    assert " deployed: " in out.splitlines()[0], out
    assert "pad 1, row 2 is short" in (tmp_path / "skin.html").read_text()
    assert bundle.active().fault_set == set(broken_row.cells)
    assert here("maintain", path, tmp_path / "morning", "--quiet")[1].count("used before") == 1

    # The new version runs, without torch, and once it has proved to work its probation is over.
    noon = broken(later_grasps[14:], broken_row)
    predictor = Predictor.load(path)
    assert (predictor.version, predictor.runtime) == (2, "onnx")
    told = listen(path, np.concatenate(noon), tmp_path / "noon")
    assert any(event.get("kind") == "confirmed" for event in told)
    assert json.loads(here("history", path, "--json")[1])["probation"] is False
    windows = make_windows(later_grasps[14:], None, LAYOUT).x
    same = predictor.predict(make_windows(noon, None, LAYOUT).x) == Predictor.load(path).predict(
        windows
    )
    assert same.all()  # the broken cells' values do not count

    # A second fault, on top of the first.
    save_npz(
        tmp_path / "evening.npz",
        Recordings(tuple(broken(later_grasps[:12], broken_row, column)), LAYOUT),
    )
    code, out = here("maintain", path, tmp_path / "evening.npz", "--quiet")
    assert code in (1, 2), out
    assert Bundle.open(path).active().fault_set == {*broken_row.cells, *column.cells}, out

    # Poison never deploys.
    rng = np.random.default_rng(0)
    save_npz(
        tmp_path / "poison.npz",
        Recordings(tuple(5 * rng.random((60, 60)) for _ in range(6)), LAYOUT),
    )
    code, out = here("maintain", path, tmp_path / "poison.npz", "--quiet")
    assert (code, " refused: " in out.splitlines()[0]) == (2, True), out
    assert bundle.active().number == 3

    # And back.
    code, out = here("rollback", path)
    assert (code, bundle.active().number) == (0, 2), out
    what = [entry["what"] for entry in json.loads(here("history", path, "--json")[1])["runs"]]
    assert what == ["deployed", "confirmed", "deployed", "refused", "rollback"]


OF_A_BUNDLE = [
    ("diagnose", "{log}", "--reference", "{bundle}"),
    ("check", "{log}", "--reference", "{bundle}"),
    ("view", "{log}", "--bundle", "{bundle}", "--mcap", "{out}"),
    ("maintain", "{bundle}", "{log}", "--dry-run"),
    ("predict", "{log}", "--bundle", "{bundle}"),
    ("restore", "{log}", "--bundle", "{bundle}", "--out", "{out}"),
    ("selftest", "{bundle}", "{log}", "--number", "2"),
    ("evaluate", "{bundle}", "{log}"),
]


@pytest.mark.parametrize("arguments", OF_A_BUNDLE, ids=lambda arguments: arguments[0])
@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"rate": 3.3}, "rate 3.3 Hz where 10 Hz is expected"),
        ({"full_scale": 50.0}, "full scale 50 N where 5 N is expected"),
        ({"shape": (1, 3, 10)}, "frames of 1 x 3 x 10"),
        ({"times": 1000.0}, "use recordings in the same unit"),
    ],
    ids=["rate", "full scale", "shape", "unit"],
)
def test_every_command_refuses_what_is_of_another_sensor_than_the_bundle(
    made_bundle, later_grasps, tmp_path, capsys, arguments, stated, said
):
    layout = Bundle.open(made_bundle).layout
    frames = np.stack([one[:20] for one in later_grasps[:6]])
    pads, rows, columns = stated.get("shape", layout.shape)
    frames = frames[..., : pads * rows * columns].reshape(6, 20, pads, rows, columns)
    beside = {"rate": layout.rate, "full_scale": layout.full_scale, "unit": layout.unit}
    known = {name: stated.get(name, value) for name, value in beside.items()}
    given = {} if "times" in stated else known
    labels = np.arange(6) % 3
    np.savez(tmp_path / "log.npz", frames=frames * stated.get("times", 1), labels=labels, **given)
    places = {"log": tmp_path / "log.npz", "bundle": made_bundle, "out": tmp_path / "out.mcap"}
    code = main([argument.format(**places) for argument in arguments])
    assert code == 3
    assert said in capsys.readouterr().err
