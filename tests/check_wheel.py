"""Installs the wheels where there is nothing else, and uses them from another folder: python
tests/check_wheel.py dist

First the core alone, then the packages of ``packages/`` beside it. Not a test of pytest's: it takes
minutes, and pip has to fetch what the packages need. ``make wheel-check`` runs it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
import venv
import zipfile
from collections.abc import Iterable
from pathlib import Path

HOME = Path(__file__).resolve().parents[1]
ROOMS = ("adaptfault", "diagnostics")
CORE = """
import sys, adaptfault, diagnostics
for package in (adaptfault, diagnostics):
    assert package.__file__.startswith(sys.prefix), package.__file__
    for name in package.__all__:
        getattr(package, name)
print(f"{len(adaptfault.__all__) + len(diagnostics.__all__)} public names, all there")
"""
ALONE = """
import sys, adaptfault
for name, package in zip(sys.argv[1::2], sys.argv[2::2]):
    try:
        getattr(adaptfault, name)
    except ImportError as error:
        assert f"pip install {package}" in str(error), error
    else:
        raise AssertionError(f"the core brings {name}")
"""
BESIDE = """
import sys, adaptfault, adaptfault.bench, adaptfault.firmware, adaptfault.fleet, adaptfault.lerobot
import adaptfault.paper, adaptfault.prognosis, adaptfault.ros2, adaptfault.viewers
import diagnostics.simulation.circuit as circuit
for package in (adaptfault.bench, circuit, sys.modules[adaptfault.Station.__module__]):
    assert package.__file__.startswith(sys.prefix), package.__file__
"""
APART = {
    "export-monitor": "adaptfault-firmware",
    "listen": "adaptfault-station",
    "reproduce": "adaptfault-paper",
    "fleet maintain": "adaptfault-fleet",
    "view": "adaptfault-viewers",
}
"""The package that brings a command."""
NAMES = {
    "Station": "adaptfault-station",
    "Fleet": "adaptfault-fleet",
    "diagnostic_array": "adaptfault-viewers",
}
"""The package that brings a public name."""
ROUNDS = 5  # of each start that is timed; the best counts
BAD_INPUT = 3


def left_out(wheel: Path, source: Path) -> set[str]:
    """Return the files of the packages that the wheel lacks: templates and py.typed go missing
    easily."""
    files = (path for room in ROOMS for path in (source / room).rglob("*"))
    wanted = {
        str(p.relative_to(source)) for p in files if p.is_file() and "__pycache__" not in p.parts
    }
    return wanted - set(zipfile.ZipFile(wheel).namelist())


def wheel_of(source: Path, dist: Path) -> Path:
    """Return the wheel of a package, after a look for every file of it."""
    name = "adaptfault" if source == HOME else source.name.replace("-", "_")
    (wheel,) = dist.glob(f"{name}-*.whl")
    if missing := left_out(wheel, source):
        sys.exit(f"{wheel.name} lacks {', '.join(sorted(missing))}")
    print(f"{wheel.name}: {wheel.stat().st_size / 1e3:.0f} kB, every file is in it")
    return wheel


class Elsewhere:
    """An empty environment, and a folder that is not the repository's."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "elsewhere"
        self.folder.mkdir()
        venv.create(folder / "empty", with_pip=True)
        self.python = folder / "empty" / "bin" / "python"
        self.adaptfault = self.python.with_name("adaptfault")
        self.environment = {
            name: value
            for name, value in os.environ.items()
            if not name.startswith(("PYTHON", "VIRTUAL_ENV"))
        }

    def run(self, *command: str | Path, quiet: bool = False) -> float:
        """Run a command that has to succeed; returns its seconds."""
        began = time.perf_counter()
        out = subprocess.DEVNULL if quiet else None
        subprocess.run(command, cwd=self.folder, env=self.environment, stdout=out, check=True)
        return time.perf_counter() - began

    def install(self, wheels: Iterable[Path]) -> None:
        """Install wheels, and let pip look for conflicts."""
        pip = [self.python, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        self.run(*pip, "install", "-c", HOME / "constraints.txt", *wheels)
        self.run(*pip, "check")

    def told(self, command: str) -> str:
        """Return what a command writes that finds its package missing."""
        words = [self.adaptfault, *command.split(), HOME / "README.md"]
        done = subprocess.run(
            words, cwd=self.folder, env=self.environment, capture_output=True, text=True
        )
        assert done.returncode == BAD_INPUT, done
        return done.stderr


def main(dist: Path) -> None:
    core = wheel_of(HOME, dist.resolve())
    others = [wheel_of(source, dist.resolve()) for source in sorted(HOME.glob("packages/*"))]
    with tempfile.TemporaryDirectory() as folder:
        elsewhere = Elsewhere(Path(folder))
        print("installing the core into an empty environment (torch is large)", flush=True)
        elsewhere.install([core])
        elsewhere.run(elsewhere.python, "-c", CORE)
        names = [word for pair in NAMES.items() for word in pair]
        elsewhere.run(elsewhere.python, "-c", ALONE, *names)
        for command, package in APART.items():
            (line,) = elsewhere.told(command).splitlines()
            assert f"pip install {package}" in line, line
        for start in (
            [elsewhere.adaptfault, "--help"],
            [elsewhere.python, "-c", "import adaptfault"],
            [elsewhere.python, "-c", "import diagnostics"],
        ):
            best = min(elsewhere.run(*start, quiet=True) for _ in range(ROUNDS))
            what = f"{start[0].name} {' '.join(start[1:])}"
            print(f"{best:.2f} s, the best of {ROUNDS}: {what}", flush=True)
        elsewhere.run(elsewhere.adaptfault, "demo")
        report = elsewhere.folder / "adaptfault-demo" / "report.html"
        assert "data:image/png;base64," in report.read_text()
        elsewhere.install(others)
        elsewhere.run(elsewhere.python, "-c", CORE)
        elsewhere.run(elsewhere.python, "-c", BESIDE)
        for command in APART:
            elsewhere.run(elsewhere.adaptfault, *command.split(), "--help", quiet=True)
        print(f"{len(others)} packages beside it, their commands all there")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
