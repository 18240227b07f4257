"""Measures the diagnosis on all arrays and prints one table: python benchmarks/diagnosis.py
[--quick] [--against FILE]

Every row is measured several times, with another half of the recordings as reference, other random
draws in the fit, and other logs and faults. ``+-`` is the standard error of the mean over these
repeats, and no less than that of the cases counted. ``--against FILE`` compares with an earlier
table, repeat by repeat, and names the rows that got worse by more than twice the noise; the exit
code is then 1. ``--out FILE`` keeps the counts (JSON lines); a run that was cut off goes on where
it stopped. Real arrays are read from ``../shared/data`` and left out where that is absent.

``--method my_package:MyDetector`` runs somebody's own detector on the same logs, and prints its
figures beside ours: those that need no more than F. See ``docs/bench.md``.

The method is chosen on splits 0 and 1. Splits 2 and 3 are for the end: ``--splits 2 3``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from arrays import ARRAYS, SPEED, Array
from disturbances import ROWS as OF_DISTURBANCES
from joblib import Parallel, delayed, parallel_config
from own_method import ROWS_OF_F, needs_only_f
from rows import ROWS as OF_FAULTS
from tqdm import tqdm

from adaptfault.bench.methods import DIAGNOSER, find_method

ROWS = OF_FAULTS | OF_DISTURBANCES
Key = tuple[str, str]  # array, row
Samples = dict[tuple[int, int], dict]  # by split and repeat


def measured(
    array: Array, split: int, repeat: int, logs: int, rows: tuple[str, ...], method: str = ""
) -> list[dict]:
    """Return the counts of one array, one half of its recordings and one draw of faults.

    ``method`` is ``module:Name`` of a detector, measured in place of the diagnosis.
    """
    bench = array.bench(split, repeat, logs)
    bench.method = method
    found = []
    about = {"array": array.name, "split": split, "repeat": repeat, "logs": logs}
    if method:
        about["method"] = method
    for name in rows:
        began = time.perf_counter()
        counts = list(ROWS[name](bench))
        if method:
            counts = [count for count in counts if needs_only_f(count.row)]
        taken = round(time.perf_counter() - began, 1)
        found += [{**about, **vars(count), "seconds": taken} for count in counts]
    return found


def by_row(counts: list[dict]) -> dict[Key, Samples]:
    """Sort counts by array and row."""
    rows: dict[Key, Samples] = defaultdict(dict)
    last = ""
    for count in counts:
        name = count["row"]
        if name.startswith(" "):
            name = f"{last}:{name[1:]}"
        else:
            last = name.split(":")[0]
        rows[count["array"], name][count["split"], count["repeat"]] = count
    return rows


def value_and_noise(samples: Samples) -> tuple[float, float]:
    """Return the pooled ratio and its standard error."""
    part, of = (
        np.array([s[name] for s in samples.values()], dtype=float) for name in ("part", "of")
    )
    if not of.sum():
        return float("nan"), float("nan")
    value = part.sum() / of.sum()
    some = of > 0
    each = part[some] / of[some]
    between = float(each.std(ddof=1) / np.sqrt(len(each))) if len(each) > 1 else 0.0
    unit = next(iter(samples.values()))["unit"]
    if unit == "products":
        return float(value), max(between, 0.05 * float(value))
    if unit or not 0 <= value <= 1:  # a rate of rare events
        rate = 1e6 if "1e6" in unit else 1.0
        counted = rate * np.sqrt(max(part.sum() / rate, 1.0)) / of.sum()
    else:
        counted = np.sqrt(max(value * (1 - value), 1 / (of.sum() + 2)) / of.sum())
    return float(value), max(between, float(counted))


def shown(value: float, unit: str) -> str:
    if np.isnan(value):
        return "-"
    return f"{value:.1f} {unit}" if unit else f"{value:.4f}"


def table(counts: list[dict], against: list[dict] | None) -> list[str]:
    """Print the table; return the rows that got worse beyond their noise."""
    before = by_row(against or [])
    worse = []
    print(
        f"{'':24}{'':55}{'value':>22}{'+-':>9}"
        + (f"{'before':>22}{'change':>10}" if against else "")
    )
    for key, samples in by_row(counts).items():
        (value, noise), first = value_and_noise(samples), next(iter(samples.values()))
        line = f"{key[0]:24}{key[1]:55}{shown(value, first['unit']):>22}{noise:9.4f}"
        both = {
            k: s
            for k, s in before.get(key, {}).items()
            if k in samples and samples[k]["logs"] == s["logs"]
        }
        if both:
            (now, _), (then, spread) = (
                value_and_noise({k: samples[k] for k in both}),
                value_and_noise(both),
            )
            change = (now - then) * (1 if first["higher"] else -1)
            line += f"{shown(then, first['unit']):>22}{now - then:+10.4f}"
            if change < -2 * max(spread, noise):
                worse.append(
                    f"{key[0]}, {key[1]}: {then:.4f} -> {now:.4f} (noise {max(spread, noise):.4f})"
                )
                line += "  WORSE"
        print(line)
    return worse


def of_method(counts: list[dict], method: str) -> dict[Key, Samples]:
    """Sort the counts of a detector, or of ours ("")."""
    return by_row([count for count in counts if count.get("method", "") == method])


def table_of_methods(counts: list[dict], methods: list[str]) -> None:
    """Print our figures and those of detectors on the same logs, a column each."""
    columns = {name: of_method(counts, name) for name in ("", *methods)}
    keys = dict.fromkeys(key for name in methods for key in columns[name])
    heads = ["SelfDiagnosis", *methods]
    width = max(24, *(len(head) + 2 for head in heads))
    print(f"{'':91}" + "".join(f"{head:>{width}}{'+-':>13}" for head in heads))
    for key in keys:
        rows = [columns[name].get(key, {}) for name in columns]
        # the draws that all of them saw
        common = [
            draw
            for draw in rows[0]
            if len({row[draw]["logs"] if draw in row else None for row in rows}) == 1
        ]
        line = f"{key[0]:36}{key[1]:55}"
        for row in rows:
            samples = {draw: row[draw] for draw in common}
            text = spread = "-"
            if any(sample["of"] for sample in samples.values()):
                value, noise = value_and_noise(samples)
                text = shown(value, samples[common[0]]["unit"])
                spread = f"{noise:.4f}"
            line += f"{text:>{width}}{spread:>13}"
        print(line)


def chosen(name: str, wanted: list[str]) -> bool:
    """Return whether an array is named, or is one of a kind: ``fabric`` for ``fabric, 16 x 16``."""
    return name in wanted or (
        name.split(",")[0] in wanted and name.split(",")[0] not in {a.name for a in ARRAYS}
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        description="Measures the diagnosis on all arrays", epilog=f"rows: {', '.join(ROWS)}"
    )
    parser.add_argument(
        "--quick", action="store_true", help="the main rows of a few arrays: minutes"
    )
    parser.add_argument(
        "--splits",
        type=int,
        nargs="+",
        default=[0, 1],
        help="halves of the recordings (default 0 1)",
    )
    arrays_help = "only these arrays, or these kinds: fabric, posture"
    parser.add_argument("--arrays", nargs="+", metavar="TEXT", help=arrays_help)
    parser.add_argument("--rows", nargs="+", choices=ROWS, metavar="ROW", help="only these rows")
    parser.add_argument("--speed", action="store_true", help="only speed, in one process")
    parser.add_argument("--jobs", type=int, default=-1, help="processes (default: one a core)")
    parser.add_argument(
        "--out", type=Path, help="JSON lines of the counts; a run that was cut off goes on there"
    )
    parser.add_argument("--against", type=Path, help="counts of an earlier version")
    method_help = "detectors with fit and detect, such as my_package:MyDetector, beside ours"
    parser.add_argument("--method", nargs="+", default=[], metavar="MODULE:NAME", help=method_help)
    options = parser.parse_args()
    if options.method and (options.against or options.speed):
        parser.error(
            "--method prints detectors beside ours; --against and --speed are for ours alone: leave"
            " them out"
        )
    for name in options.method:
        try:
            find_method(name, DIAGNOSER)()
        except (ImportError, ValueError) as error:
            parser.error(str(error))
    kept = (
        [json.loads(line) for line in options.out.read_text().splitlines()]
        if options.out and options.out.exists()
        else []
    )
    done = {
        (
            c["array"],
            c["split"],
            c["repeat"],
            c["logs"],
            c["row"].startswith("fit"),
            c.get("method", ""),
        )
        for c in kept
    }
    jobs = []
    absent = []
    more_than_f: dict[str, None] = {}
    for array in SPEED if options.speed else ARRAYS:
        logs, rows = (array.quick, array.quick_rows) if options.quick else (array.logs, array.rows)
        rows = tuple(row for row in rows if not options.rows or row in options.rows)
        if not logs or not rows or (options.arrays and not chosen(array.name, options.arrays)):
            continue
        if options.method:
            more_than_f.update(dict.fromkeys(row for row in rows if row not in ROWS_OF_F))
            rows = tuple(row for row in rows if row in ROWS_OF_F)
        if not rows:
            continue
        if not array.available:
            absent.append(array.name)
            continue
        for repeat in range(1 if options.quick else array.repeats):
            for split in options.splits[:1] if options.speed else options.splits:
                for method in ("", *options.method):
                    if (array.name, split, repeat, logs, options.speed, method) not in done:
                        jobs.append((array, split, repeat, logs, rows, method))
    with parallel_config(backend="loky", inner_max_num_threads=1):
        work = Parallel(n_jobs=1 if options.speed else options.jobs, return_as="generator")
        for counts in tqdm(
            work(delayed(measured)(*job) for job in jobs),
            total=len(jobs),
            disable=None,
            unit="array",
        ):
            kept += counts
            if options.out:
                with options.out.open("a") as file:
                    file.writelines(json.dumps(count) + "\n" for count in counts)
    against = (
        [json.loads(line) for line in options.against.read_text().splitlines()]
        if options.against
        else None
    )
    worse = []
    if options.method:
        table_of_methods(kept, options.method)
    else:
        worse = table([count for count in kept if not count.get("method")], against)
    if more_than_f:
        print(f"left out, they need more than F: {', '.join(more_than_f)}")
    for text in absent:
        print(f"left out, no recordings at hand: {text}")
    for text in worse:
        print(f"WORSE: {text}")
    if against is not None and not worse:
        print("no row is worse than before beyond its noise")
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
