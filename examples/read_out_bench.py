"""How many open and shorted crossings and lines a scan of the read-out finds with nobody touching,
on the circuit of an array.

    python examples/read_out_bench.py [--arrays 200] [--small]

The first rows are of scans that do not state that lines are held, and of the same ones stating it;
the last ones of a read-out that lets all lines float which it does not select.

Each array has two open crossings, a shorted one of up to 1 kiloohm, and every second one a row or
column that is cut somewhere. Preload, leakage to ground (1 megaohm to 1 gigaohm) and the noise of
the converter (12 bits) differ from array to array; where lines float, leakage differs in addition
by a factor of ten from line to line.
"""

import argparse
from collections import Counter
from dataclasses import replace

import numpy as np

from diagnostics import Line, SensorLayout, judge_scan
from diagnostics.evidence.read_out import ReadOut
from diagnostics.simulation.circuit import Circuit, CutLine, ShortedLine, StuckCell
from diagnostics.simulation.scan import scan_circuit

SIZES = ((16, 16), (11, 10))
READ_OUTS = {"grounded": 100.0, "virtual ground": 1.0}  # ohms of the divider
LEAKS = {  # where lines float
    "1 megaohm to 1 gigaohm": (6, 9),
    "0.1 to 1 megaohm": (5, 6),
    "1 to 100 kiloohm": (3, 5),
}
PRELOAD = 0.02  # newton at most, of 5


def scanned(circuit: Circuit, rng: np.random.Generator, *, stated: bool | None = None) -> ReadOut:
    """Return what a scan says of an untouched array; ``stated``: whether lines are held."""
    layout = circuit.layout
    idle = rng.uniform(0, PRELOAD, layout.n_cells)
    noise = float(rng.choice([0.5, 1.0, 2.0]))
    scan = scan_circuit(circuit, idle, noise=noise, seed=int(rng.integers(1 << 30)))
    return judge_scan(replace(scan, holds_lines=stated), layout)


def broken(layout: SensorLayout, rng: np.random.Generator, *, cut: bool) -> tuple:
    """Return faults of a netlist, and which crossings are open and shorted, bool ``[D]``."""
    first, second, third = rng.choice(layout.n_cells, 3, replace=False).tolist()
    ohms = float(rng.choice([0.0, rng.uniform(0, 1000)]))
    faults = [StuckCell(first, np.inf), StuckCell(second, np.inf), StuckCell(third, ohms)]
    is_open = np.isin(np.arange(layout.n_cells), [first, second])
    is_short = np.arange(layout.n_cells) == third
    if cut:
        line = [one for one in layout.lines if one.kind in ("row", "column")]
        line = line[rng.integers(len(line))]
        before = int(rng.integers(len(layout.cells_on(line)) - 2))
        faults.append(CutLine(line, before))
        beyond = layout.cells_on(line)[before:]
        is_open[beyond] = True
        is_short[beyond] = False
    return tuple(faults), is_open, is_short


def crossings(layout: SensorLayout, load: float, arrays: int, *, stated: bool | None) -> Counter:
    """Return counts of crossings over many arrays whose lines are held."""
    rng = np.random.default_rng(0)
    count: Counter = Counter()
    for i in range(arrays):
        faults, is_open, is_short = broken(layout, rng, cut=i % 2 == 0)
        leak = 10 ** rng.uniform(6, 9)
        circuit = Circuit(layout, faults=faults, load_ohms=load, leak_ohms=leak)
        found = scanned(circuit, rng, stated=stated)
        told = np.isin(np.arange(layout.n_cells), [c for f in found.faults for c in f.cells])
        healthy = ~is_open & ~is_short
        count["open"] += int(is_open.sum())
        count["open found"] += int((told & is_open).sum())
        count["open alive"] += int((found.alive & (is_open | is_short)).sum())
        count["short"] += int(is_short.sum())
        count["short found"] += int((told & is_short).sum())
        count["blamed"] += int((told & healthy).sum())
        count["untested"] += int((~found.alive & ~told).sum())
        count["cells"] += layout.n_cells
    return count


def lines(layout: SensorLayout, load: float, arrays: int) -> list[str]:
    """Return how often a whole line that fails is named, and how many other cells are blamed."""
    told = []
    for what in ("floating", "on ground", "on the supply"):
        rng = np.random.default_rng(1)
        named = blamed = 0
        for i in range(arrays):
            kind = "column" if i % 2 else "row"
            size = layout.cols if kind == "column" else layout.rows
            line = Line(0, kind, int(rng.integers(size)))
            fault = CutLine(line) if what == "floating" else ShortedLine(line, what.split()[-1])
            found = scanned(Circuit(layout, faults=(fault,), load_ohms=load), rng)
            named += any(one.line == line for one in found.faults)
            others = {c for one in found.faults for c in one.cells}
            blamed += len(others - set(layout.cells_on(line).tolist()))
        told.append(f"{what}: {named} of {arrays} named, {blamed} other cells blamed")
    return told


def floating(layout: SensorLayout, leaks: tuple[float, float], arrays: int) -> Counter:
    """Return counts of open crossings where the read-out lets all lines float that it does not
    select; ``leaks``: logarithms of the least and the highest leakage in ohms."""
    rng = np.random.default_rng(2)
    count: Counter = Counter()
    for i in range(arrays):
        faults, is_open, is_short = broken(layout, rng, cut=i % 2 == 0)
        leak = 10 ** rng.uniform(*leaks)
        lines = [line for line in layout.lines if line.kind in ("row", "column")]
        more = [ShortedLine(line, "ground", leak * 10 ** rng.uniform(0, 1)) for line in lines]
        found = scanned(Circuit(layout, "floating", (*faults, *more)), rng)
        told = np.isin(np.arange(layout.n_cells), [c for f in found.faults for c in f.cells])
        count["open"] += int(is_open.sum())
        count["alive"] += int((found.alive & is_open).sum())
        count["found"] += int((told & is_open).sum())
        count["blamed"] += int((told & ~is_open & ~is_short).sum())
    return count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arrays", type=int, default=200)
    parser.add_argument("--small", action="store_true", help="4 arrays")
    args = parser.parse_args()
    arrays = 4 if args.small else args.arrays
    for rows, cols in SIZES:
        layout = SensorLayout(1, rows, cols)
        for name, load in READ_OUTS.items():
            for stated in (None, True):
                count = crossings(layout, load, arrays, stated=stated)
                print(
                    f"{rows} x {cols}, {name}, {'' if stated else 'not '}stated, {arrays} arrays:"
                    f" open {count['open found']}/{count['open']}, short"
                    f" {count['short found']}/{count['short']}, of both called ALIVE"
                    f" {count['open alive']}, healthy blamed {count['blamed']}, untested"
                    f" {count['untested']} of {count['cells']} cells"
                )
            for text in lines(layout, load, max(arrays // 10, 4)):
                print(f"    line {text}")
        for name, leaks in LEAKS.items():
            count = floating(layout, leaks, arrays)
            print(
                f"{rows} x {cols}, lines float, leakage {name}, {arrays} arrays: of"
                f" {count['open']} open {count['alive']} called ALIVE, {count['found']} found;"
                f" healthy blamed {count['blamed']}"
            )


if __name__ == "__main__":
    main()
