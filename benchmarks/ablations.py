"""What does each rule of the diagnosis carry? python benchmarks/ablations.py [RULE ...] [-- options
of diagnosis.py]

Removes one rule at a time from a copy of ``diagnostics``, measures the benchmark with it, and names
the rows that are worse than with the rule, beyond their noise. Without RULE: all. The options
choose arrays, rows and splits:

    python benchmarks/ablations.py jumps tempering -- --arrays hand fingertips --rows cells onset
    --splits 0
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "diagnostics"
RULES = {
    "whole": ("__init__.py", "", ""),  # nothing is removed
    "jumps": (
        "evidence/jumps.py",
        "return cls(np.minimum(np.log(0.5 + 0.5 * ratio), SUSPICIOUS))",
        "return cls.silent()",
    ),
    "tempering": ("evidence/conditional_test.py", "return tempered", "return never"),
    "inflation": (
        "evidence/conditional_test.py",
        "return np.clip(half / MEDIAN_ERROR, 1.0, _MAX_INFLATION)",
        "return np.ones(len(half))",
    ),
    "prior of a rest": (
        "evidence/spatial.py",
        "cells.scored & (came_to_rest | (surprisal > 0))",
        "cells.scored & (surprisal > 0)",
    ),
    "pad level": ("evidence/stream_state.py", "if reference.beside is not None:", "if False:"),
    "first predictors": (
        "evidence/spatial.py",
        "cells.eligible & cells.runs.moved & plausible",
        "cells.eligible & cells.runs.moved",
    ),
    "exchanged loads": (
        "events/contact_events.py",
        "begins = self._begins(root, before, numbers, root_near, start)",
        "begins = []",
    ),
    "exchanged loads in a hold": (
        "events/contact_events.py",
        "min(_EXCHANGED, _OUTLYING * float(np.quantile(share, _QUANTILE)))",
        "_EXCHANGED",
    ),
    "cells that persist": (
        "events/contact_events.py",
        "at[persists.sum(axis=1) <= _PERSISTING * own.sum(axis=1)].tolist()",
        "at.tolist()",
    ),
    "events that persist": (
        "events/contact_events.py",
        "if same or (follows and kept[-1].persists(part, root_near, start, jumped)):",
        "if same:",
    ),
    "location of the load": (
        "events/contact_events.py",
        "return size <= _MIN_AMPLITUDE**2 or",
        "return True or",
    ),
    "release of held loads": (
        "events/contact_events.py",
        "_WEAKEST * largest, _MIN_AMPLITUDE, _LEAST_OF_HELD * float(ahead[0] @ held)",
        "_WEAKEST * largest, _MIN_AMPLITUDE",
    ),
    "frames of a release": (
        "events/contact_events.py",
        "begin += _releasing_frames(root[begin:], last)",
        "pass",
    ),
    "late prevalence": (
        "decision/calibration.py",
        "late = scored & began",
        "began &= False; late = scored & began",
    ),
    "discount of few recordings": (
        "decision/calibration.py",
        "_MAX_DISCOUNT = 0.5",
        "_MAX_DISCOUNT = 0.0",
    ),
    "nearest false discovery rate": (
        "decision/calibration.py",
        "excess <= np.maximum(shortfall, 0.0)",
        "excess <= 0.0",
    ),
    "first, rough calibration": (
        "decision/calibration.py",
        "for n in stages:",
        "for n in stages[1:]:",
    ),
    "second line cover": (
        "decision/root_causes.py",
        "if 0 < singles < sum(cause.proven for _, _, cause in causes):",
        "if False:",
    ),
    "objects beside faults": (
        "diagnosis.py",
        "for beside in (False, True):",
        "for beside in (False,):",
    ),
    "half of the samples": ("healthy/cross_fitting.py", "_SAMPLES = 100_000", "_SAMPLES = 50_000"),
}


def without(rule: str, folder: Path) -> Path:
    """Return a folder with a copy of the package from which a rule is removed."""
    file, old, new = RULES[rule]
    root = folder / rule.replace(" ", "_")
    shutil.copytree(PACKAGE, root / PACKAGE.name, ignore=shutil.ignore_patterns("__pycache__"))
    changed = root / PACKAGE.name / file
    text = changed.read_text(encoding="utf-8")
    if old and text.count(old) != 1:
        raise SystemExit(f"{rule}: {file} holds {text.count(old)} times, not once: {old}")
    changed.write_text(text.replace(old, new) if old else text, encoding="utf-8")
    return root


def main() -> int:
    parser = argparse.ArgumentParser(description="What does each rule of the diagnosis carry?")
    parser.add_argument("rules", nargs="*", metavar="RULE", help=f"of: {', '.join(RULES)}")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("ablations"),
        help="folder of the counts (default ablations)",
    )
    given = sys.argv[1:]
    end = given.index("--") if "--" in given else len(given)
    options = parser.parse_args(given[:end])
    rules = options.rules or list(RULES)
    if unknown := set(rules) - set(RULES):
        parser.error(f"no rule {sorted(unknown)[0]!r}: use {', '.join(RULES)}")
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for rule in dict.fromkeys(["whole", *rules]):
            print(f"== {rule}", flush=True)
            counts = {
                name: str(options.out / f"{name.replace(' ', '_')}.jsonl")
                for name in (rule, "whole")
            }
            against = [] if rule == "whole" else ["--against", counts["whole"]]
            command = [
                sys.executable,
                str(Path(__file__).with_name("diagnosis.py")),
                *given[end + 1 :],
            ]
            environment = {**os.environ, "PYTHONPATH": str(without(rule, Path(folder)))}
            subprocess.run(
                [*command, "--out", counts[rule], *against], env=environment, check=False
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
