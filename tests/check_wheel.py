"""Installs the wheel where there is nothing else, and uses it from another folder: python
tests/check_wheel.py dist

Not a test of pytest's: it takes minutes, and pip has to fetch what the package needs.
``make wheel-check`` runs it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
import venv
import zipfile
from pathlib import Path

HOME = Path(__file__).resolve().parents[1]
PACKAGES = ("adaptfault", "diagnostics")
USE = """
import sys, adaptfault, diagnostics
for package in (adaptfault, diagnostics):
    assert package.__file__.startswith(sys.prefix), package.__file__
    for name in package.__all__:
        getattr(package, name)
print(f"{len(adaptfault.__all__) + len(diagnostics.__all__)} public names, all there")
"""
ROUNDS = 5  # of each start that is timed; the best counts


def left_out(wheel: Path) -> set[str]:
    """Return the files of the packages that the wheel lacks: templates and py.typed go missing
    easily."""
    files = (path for package in PACKAGES for path in (HOME / package).rglob("*"))
    wanted = {
        str(p.relative_to(HOME)) for p in files if p.is_file() and "__pycache__" not in p.parts
    }
    return wanted - set(zipfile.ZipFile(wheel).namelist())


def main(dist: Path) -> None:
    (wheel,) = dist.resolve().glob("adaptfault-*.whl")
    if missing := left_out(wheel):
        sys.exit(f"{wheel.name} lacks {', '.join(sorted(missing))}")
    print(
        f"{wheel.name}: {wheel.stat().st_size / 1e3:.0f} kB, every file of {' and '.join(PACKAGES)}"
        " is in it"
    )
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    with tempfile.TemporaryDirectory() as folder:
        elsewhere = Path(folder, "elsewhere")
        elsewhere.mkdir()
        venv.create(Path(folder, "empty"), with_pip=True)
        python = Path(folder, "empty", "bin", "python")

        def run(*command: str | Path, quiet: bool = False) -> float:
            began = time.perf_counter()
            out = subprocess.DEVNULL if quiet else None
            subprocess.run(command, cwd=elsewhere, env=environment, stdout=out, check=True)
            return time.perf_counter() - began

        def pip(*arguments: str | Path) -> None:
            run(python, "-m", "pip", "--quiet", "--disable-pip-version-check", *arguments)

        print("installing it into an empty environment (torch is large)", flush=True)
        pip("install", "-c", HOME / "constraints.txt", wheel)
        pip("check")
        run(python, "-c", USE)
        adaptfault = python.with_name("adaptfault")
        for start in (
            [adaptfault, "--help"],
            [python, "-c", "import adaptfault"],
            [python, "-c", "import diagnostics"],
        ):
            best = min(run(*start, quiet=True) for _ in range(ROUNDS))
            print(
                f"{best:.2f} s, the best of {ROUNDS}: {start[0].name} {' '.join(start[1:])}",
                flush=True,
            )
        run(adaptfault, "demo")
        assert (
            "data:image/png;base64," in (elsewhere / "adaptfault-demo" / "report.html").read_text()
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
