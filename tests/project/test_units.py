"""The units of examples/systemd and the line for cron do what their comments say."""

import configparser
import os
import shutil
import stat
import subprocess
from pathlib import Path

import pytest

from adaptfault.cli import main

UNITS = Path(__file__).parents[2] / "examples" / "systemd"
SERVICES = sorted(UNITS.glob("*.service"))
ALL = sorted([*SERVICES, *UNITS.glob("*.timer")])


def unit(path: Path) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(interpolation=None, comment_prefixes="#", strict=True)
    parser.optionxform = str
    parser.read(path)
    return parser


def command_of(path: Path) -> list[str]:
    """What a unit runs, if it is adaptfault."""
    words = unit(path)["Service"]["ExecStart"].split()
    return words[2:] if words[1] == "adaptfault" else []


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_accepts_the_units():
    found = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *map(str, ALL)],
        capture_output=True,
        text=True,
        check=False,
    )
    if "Failed to" in found.stderr and str(UNITS) not in found.stderr:
        pytest.skip(f"systemd-analyze does not work here: {found.stderr.splitlines()[0]}")
    own = [line for line in found.stderr.splitlines() if "adaptfault" in line]
    assert (found.returncode, own) == (0, [])


def test_units_that_others_name_exist():
    names = {path.name for path in ALL}
    for path in ALL:
        for named in unit(path)["Unit"].get("OnFailure", "").split():
            template, _, instance = named.partition("@")
            assert instance in ("", "%n.service")
            assert (f"{template}@.service" if instance else template) in names
        if path.suffix == ".timer":
            assert path.with_suffix(".service").name in names


def test_what_runs_adaptfault_tells_of_its_failure():
    running = [path for path in SERVICES if command_of(path)]
    assert [command_of(path)[0] for path in running] == ["listen", "maintain"]
    for path in running:
        assert unit(path)["Unit"]["OnFailure"] == "adaptfault-failure@%n.service"
    handler = unit(UNITS / "adaptfault-failure@.service")
    assert "OnFailure" not in handler["Unit"]
    assert "systemd-cat" in handler["Service"]["ExecStart"]


def test_degraded_but_handled_is_no_failure_of_maintenance():
    service = unit(UNITS / "adaptfault-maintain.service")["Service"]
    assert service["SuccessExitStatus"].split() == ["1"]


@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.stem)
def test_options_of_a_unit_exist(path, capsys):
    command = command_of(path)
    if not command:
        return
    with pytest.raises(SystemExit):
        main([command[0], "--help"])
    known = capsys.readouterr().out
    assert [word for word in command if word.startswith("--") and word not in known] == []


@pytest.mark.skipif(os.name != "posix", reason="cron runs commands with sh")
@pytest.mark.parametrize("code", [0, 1, 2, 3])
def test_cron_mails_what_needs_somebody_and_nothing_else(code, tmp_path):
    (line,) = [
        line
        for line in (UNITS / "adaptfault.cron").read_text().splitlines()
        if not line.startswith("#")
    ]
    command = line.split(maxsplit=5)[5].replace("/var/lib/robot", str(tmp_path))
    assert "%" not in command  # cron takes it for the end of a line
    program = tmp_path / "adaptfault"
    program.write_text(f"#!/bin/sh\necho ADAPTFAULT report\nexit {code}\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    printed = subprocess.run(
        ["/bin/sh", "-c", command],
        env={"PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    mailed = printed.stdout + printed.stderr
    assert mailed == ("ADAPTFAULT report\n" if code >= 2 else "")
