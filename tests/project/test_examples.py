"""Every example runs as its first line says, and on recordings where it takes some.
``make examples`` shows them.

Those that are marked slow run there and in ``make test-all``, not in ``make test``.
"""

import contextlib
import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest
from _pytest.mark import ParameterSet

from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz

HOME = Path(__file__).parents[2] / "examples"
EXAMPLES = sorted(HOME.glob("*.py"))
# What an example takes on recordings, as small as it goes.
ON_RECORDINGS = {
    "adaptation_figures.py": ["--epochs", "1", "--cases", "1", "--only", "fill"],
    "any_model.py": ["--small", "--only", "MLP"],
    "compare_classification.py": ["--small", "--only", "adaptfault"],
    "compare_keras.py": ["--epochs", "1", "--windows", "32"],
    "esp32_sender.py": ["--frames", "20"],
    "fine_tuning.py": ["--small"],
    "forecast_intervals.py": ["--small"],
    "monitor_alarms.py": ["--small"],
    "simulated_vs_real.py": [],
    "wrong_fault_set.py": ["--draws", "1"],
}
ON_SIMULATED = {"new_objects.py"}  # they need more objects than the recordings here have
LESS = {  # they take minutes
    "attack.py": ["--small"],
    "design_study.py": ["--small"],
    "force.py": ["--grasps", "8", "--epochs", "1"],
    "fine_tuning.py": ["--small"],
    "forecast_intervals.py": ["--small"],
    "new_objects.py": ["--small"],
    "read_out_bench.py": ["--small"],
    "restore_speed.py": ["--grasps", "1", "--repeats", "5"],
    "ros_latency.py": ["--seconds", "1", "--rates", "100"],
    "soak.py": ["--hours", "12", "--frames", "500"],
    "any_model.py": ["--small"],
    "fleet_scaling.py": ["--robots", "4", "--batch", "2", "--adapted", "1"],
    "iclabel.py": ["--components", "5"],
    "mujoco_bench.py": ["--small"],
    "lerobot_policy.py": ["--quick"],
    "mujoco_gripper.py": ["--grasps", "1"],
    "mujoco_lift.py": ["--episodes", "2"],
    "mujoco_policy.py": ["--quick"],
}
SLOW = {  # they take long, or a test of the library proves the same
    "any_model.py",
    "adaptation_figures.py",
    "circuit_vs_injector.py",
    "compare_classification.py",
    "compare_keras.py",
    "core_speed.py",
    "deploy_speed.py",
    "esp32_sender.py",
    "design_study.py",
    "fine_tuning.py",
    "fleet_scaling.py",
    "force.py",
    "forecast_intervals.py",
    "new_objects.py",
    "attack.py",
    "iclabel.py",
    "io_errors.py",
    "kill_maintenance.py",
    "lerobot_policy.py",
    "lerobot_set.py",
    "monitor_alarms.py",
    "monitor_cost.py",
    "mujoco_bench.py",
    "mujoco_gripper.py",
    "mujoco_lift.py",
    "mujoco_policy.py",
    "own_model.py",
    "picture.py",
    "power_cut.py",
    "relay.py",
    "repair.py",
    "restore_speed.py",
    "ros_latency.py",
    "scale_curves.py",
    "simulated_vs_real.py",
    "soak.py",
    "udp_soak.py",
    "wrong_fault_set.py",
}
SLOW_ON_RECORDINGS = {
    "any_model.py",
    "adaptation_figures.py",
    "compare_classification.py",
    "compare_keras.py",
    "fine_tuning.py",
    "forecast_intervals.py",
    "monitor_alarms.py",
    "wrong_fault_set.py",
}
# others do without, and say so
NEEDS = {
    "deploy_speed.py": "onnxruntime",
    "iclabel.py": "mne_icalabel",
    "lerobot_policy.py": "lerobot",
    "mujoco_bench.py": "mujoco",
    "mujoco_gripper.py": "mujoco",
    "mujoco_lift.py": "mujoco",
    "mujoco_policy.py": "mujoco",
    "ros_latency.py": "rclpy",
}


def skip_without_its_package(name: str) -> None:
    """Skip the test of an example that needs a package which is not here."""
    if (package := NEEDS.get(name)) and importlib.util.find_spec(package) is None:
        pytest.skip(f"{name} needs {package}")


def run(example: Path, folder: Path, *arguments: str | Path) -> str:
    """Run an example without a warning; return what it prints."""
    skip_without_its_package(example.name)
    # rclpy brings a parser that imports sre_parse.
    environment = {**os.environ, "PYTHONWARNINGS": "error,ignore:module 'sre_:DeprecationWarning"}
    command = [sys.executable, example, *arguments]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def marked(names: Iterable[str], slow: set[str]) -> list[ParameterSet]:
    return [
        pytest.param(name, marks=pytest.mark.slow if name in slow else (), id=name)
        for name in names
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", [path.name for path in EXAMPLES if '"--only"' in path.read_text()])
def test_an_example_says_what_it_can_be_told_to_pick(name: str, tmp_path: Path):
    assert "--only ONLY" in (said := run(HOME / name, tmp_path, "--help")) or "--only NAME" in said


@pytest.mark.parametrize("name", marked([path.name for path in EXAMPLES], SLOW))
def test_the_example_runs(name: str, tmp_path: Path):
    said = run(HOME / name, tmp_path, *LESS.get(name, []))
    assert said.strip()
    assert "nan" not in said.lower().split()


@pytest.mark.parametrize("name", marked(ON_RECORDINGS, SLOW_ON_RECORDINGS))
def test_the_example_runs_on_recordings(name: str, small_grasps: Recordings, tmp_path: Path):
    save_npz(tmp_path / "grasps.npz", small_grasps)
    said = run(HOME / name, tmp_path, "grasps.npz", *ON_RECORDINGS[name])
    assert any(character.isdigit() for character in said)  # its figures


@pytest.mark.parametrize("name", [path.stem for path in EXAMPLES if "__main__" in path.read_text()])
def test_what_an_example_imports_is_there(name: str):
    """Also of those that are slow: a move within the library breaks them first."""
    skip_without_its_package(f"{name}.py")
    spec = importlib.util.spec_from_file_location(f"example_{name}", HOME / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    finally:
        del sys.modules[spec.name]
    assert callable(module.main)


def test_no_example_that_takes_recordings_is_left_out():
    takes = {
        path.name
        for path in EXAMPLES
        if 'argument("recording' in path.read_text() or "[REC" in path.read_text()
    }
    assert takes == ON_RECORDINGS.keys() | ON_SIMULATED


@pytest.mark.slow
def test_the_first_hour_ends_with_the_right_verdict_on_a_small_skin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Every command runs in this process, because importing torch for each takes longer than all of
    them."""
    call = tmp_path / "call"
    answer = tmp_path / "answer"
    os.mkfifo(call)
    os.mkfifo(answer)
    client = tmp_path / "client.sh"
    client.write_text(f"printf '%s\\n' \"$@\" > {call}; read -r code < {answer}; exit $code\n")
    environment = {
        "ADAPTFAULT": f"sh {client}",
        "EPOCHS": "1",
        "GRASPS": "6",
        "SHAPE": "6x6",
        "OUT": str(tmp_path),
    }
    script = [
        "sh",
        "-c",
        f'sh {HOME / "first_hour.sh"} "$OUT" skin; code=$?; echo end > {call}; exit $code',
    ]
    with subprocess.Popen(
        script, env={**os.environ, **environment}, stdout=subprocess.PIPE, text=True
    ) as running:
        while (arguments := call.read_text().splitlines()) != ["end"]:
            code = 3
            # of an unknown option: the script waits for an answer
            with contextlib.suppress(SystemExit):
                code = main([*arguments, "--quiet"])
            answer.write_text(f"{code}\n")
        said, _ = running.communicate()
    assert running.returncode == 0, said[-2000:] + capsys.readouterr().err[-2000:]
    assert "first_hour: skin: verdict right" in said


@pytest.mark.slow
@pytest.mark.parametrize("array", ["skin", "lerobot", "fabric", "icub", "insole", "sdh"])
def test_the_first_hour_ends_with_the_right_verdict_on_every_array(array: str, tmp_path: Path):
    data = HOME.parents[1] / "shared/data"
    if array not in ("skin", "lerobot") and not data.is_dir():
        pytest.skip("the real recordings are not here")
    command = f"{sys.executable} -W error -m adaptfault"
    environment = {
        **os.environ,
        "ADAPTFAULT": command,
        "DATA": str(data),
        "EPOCHS": "1",
        "GRASPS": "8",
        "SLIDES": "::6",
        "PYTHON": sys.executable,
    }
    environment["PYTHONPATH"] = str(HOME.parent)
    done = subprocess.run(
        ["sh", HOME / "first_hour.sh", tmp_path, array],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert f"first_hour: {array}: verdict right" in done.stdout
    assert re.search(rf"first_hour: {array}: \d+ s for train, exit code 0", done.stdout)
    for page in ("later.html", "diagnosis.html", "maintenance.html", "report.html"):
        assert (tmp_path / array / page).stat().st_size > 10_000
