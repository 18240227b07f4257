"""Writes the tables of the result pages from what was measured: python benchmarks/pages.py

``table.jsonl`` holds the counts of ``benchmarks/diagnosis.py --out``. ``figures.jsonl`` holds
figures without counts, each with where it is ``from``; where both have a figure, this one is newer.
``before``: of the engine that the one model replaced, as all of ``table.jsonl``; beside newer ones
they are headed *before*. After a run that replaces ``table.jsonl``, ``--measured`` deletes from
``figures.jsonl`` what it measured anew.

``other_figures.jsonl`` holds the cells of other tables, in the order of their rows and columns,
each with the command it is ``from``: ``value`` with a ``spread`` or a ``unit``; ``best`` is what
others reach, of them ``by``. ``examples/speed`` and ``examples/scale`` hold what their scripts
measured.

A table stands between ``<!-- table: NAME -->`` and ``<!-- end -->``; what surrounds it is written
by hand. ``--check`` writes nothing and names the pages that differ; the exit code is then 1.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path

from arrays import ARRAYS
from diagnosis import Key, Samples, by_row, value_and_noise
from other_sensors import DRIFTS, SENSORS

HERE = Path(__file__).parent
PAGES = HERE.parent / "docs"
EXAMPLES = HERE.parent / "examples"
LIFE = ("hand", "fingertips", "soles", "sliding finger")
ABSENT = "-"
FILES = ("table", "figures", "other_figures")
Table = list[Sequence[str]]  # rows, the first is the head


@dataclass
class Measured:
    """What was measured, by array and row.

    Args:
        counts: lines of table.jsonl.
        figures: lines of figures.jsonl.
        others: lines of other_figures.jsonl.
    """

    counts: list[dict]
    figures: list[dict]
    others: list[dict] = field(default_factory=list)

    @classmethod
    def read(cls) -> Measured:
        """Read the files."""
        return cls(*(lines_of(HERE / f"{name}.jsonl") for name in FILES))

    @cached_property
    def samples(self) -> dict[Key, Samples]:
        """The counts; of two runs of one draw, that with more logs."""
        return by_row(sorted(self.counts, key=lambda count: count["logs"]))

    @cached_property
    def newer(self) -> dict[Key, float]:
        """The figures without counts."""
        return {(figure["array"], figure["row"]): figure["value"] for figure in self.figures}

    @cached_property
    def since(self) -> dict[Key, float]:
        """Those of the one model."""
        return {
            (figure["array"], figure["row"]): figure["value"]
            for figure in self.figures
            if not figure["before"]
        }

    def value(self, array: str, row: str, split: int | None = None) -> float | None:
        """Return a figure, of all splits or of one; None where it was not measured."""
        if split is None and (array, row) in self.newer:
            return self.newer[array, row]
        samples = self.of(array, row, split)
        return value_and_noise(samples)[0] if samples else None

    def of(self, array: str, row: str, split: int | None = None) -> Samples:
        """Return the counts of a row, of all splits or of one."""
        samples = self.samples.get((array, row), {})
        return {draw: count for draw, count in samples.items() if split in (None, draw[0])}

    def cases(self, array: str, row: str, what: str = "of") -> float:
        """Return how many cases (``of``), found ones (``part``) or logs (``logs``) there were."""
        counts = list(self.of(array, row).values())
        if not counts:
            counts = [
                figure
                for figure in self.figures
                if (figure["array"], figure["row"]) == (array, row) and what in figure
            ]
        return sum(count[what] for count in counts)

    def left(self) -> list[dict]:
        """Return the figures of rows without counts."""
        rows = self.samples.keys()
        false_cells = {(array, "false cells") for array, row in rows if row == ALARMS}
        measured = rows | false_cells
        return [one for one in self.figures if (one["array"], one["row"]) not in measured]

    def splits(self, array: str) -> list[int]:
        """Return the splits that an array was measured on."""
        draws = [draw for (name, _), of in self.samples.items() if name == array for draw in of]
        return sorted({split for split, _ in draws})


def lines_of(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def shown(value: float | None, digits: int = 3) -> str:
    if value is None or value != value:
        return ABSENT
    return f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    return ABSENT if value is None or value != value else f"{100 * value:.3g} %"


def seconds(value: str) -> str:
    """Return seconds of a CSV file, in two digits."""
    return f"{float(f'{float(value):.2g}'):g} s"


def blamed(value: float | None) -> str:
    """Return cells blamed in a log."""
    return ABSENT if value is None else f"{value:.2g}" if value else "0"


DEAD = "16 % dead"
LATE = "16 % dead from 60 % of the log on"
LINES = "2 broken lines + 4 % of the cells: exact lines"
ALARMS = "healthy: false alarms"
COLD = f"no reference, {DEAD}"

OF_HAND = (  # what the page says, row of the table, --rows
    ("16 % dead: precision", f"{DEAD}: precision", "cells"),
    ("recall", f"{DEAD}: recall", "cells"),
    ("from 60 % of the log on: precision", f"{LATE}: precision", "onset"),
    ("recall", f"{LATE}: recall", "onset"),
    ("stuck in mid-range, dither 0.4 %: precision", "mid-range, dither 0.4 %: precision", "dither"),
    ("recall", "mid-range, dither 0.4 %: recall", "dither"),
    ("40 % dead: precision", "40 % dead: precision", "many"),
    ("recall", "40 % dead: recall", "many"),
    ("100 % dead: precision", "100 % dead: precision", "many"),
    ("recall", "100 % dead: recall", "many"),
    ("two broken lines + 4 % single cells: exact lines", LINES, "lines"),
    ("break inside a line: exact position", "a break inside a line: exact position", "cut"),
    ("stuck address bit: bit and level", "stuck address bit: bit and level named", "address"),
    ("healthy cells in F in 1e6 windows", "healthy, held: false alarms", "holds"),
    ("kind of fault right", "kind of fault right", "kind"),
    ("calibration error of P(faulty)", "P(faulty): calibration error", "calibration"),
    ("intermittent cells found and named", "intermittent: found and named", "changing"),
    ("noisy cells found and named", "noisy: found and named", "changing"),
    ("drifting cells found and named", "drift: found and named", "changing"),
    ("gain 0.2 found (30 recordings, cell loaded in 8)", "gain 0.2: found and named", "gain"),
    ("gain 0.35 found", "gain 0.35: found and named", "gain"),
    ("gain 0.5 found", "gain 0.5: found and named", "gain"),
    ("gain fading to 0.1 found", "gain fades to 0.1: found and named", "gain"),
    (
        "lost frames, frozen stream: cells in F for each log",
        "lost frames, frozen stream: cells blamed in a log",
        "transport",
    ),
)


def hand(measured: Measured) -> Table:
    """The hand, a column a split, and one of what was measured since."""
    splits = measured.splits("hand")
    since = [measured.since.get(("hand", row)) for _, row, _ in OF_HAND]
    head = ["", *(f"split {split}" for split in splits), *(["since, split 0"] * any(since)), "ROW"]
    table: Table = [head]
    for (name, row, rows), now in zip(OF_HAND, since, strict=True):
        figures = [shown(measured.value("hand", row, split)) for split in splits]
        figures += [shown(now)] * any(since)
        if set(figures) != {ABSENT}:
            table.append([name, *figures, f"`{rows}`"])
    return table


WIRINGS = ("two lines exchanged", "a pad mirrored", "lines shifted by one", "two pads exchanged")


def rewired(measured: Measured) -> Table:
    """Changes of the wiring that are undone exactly."""
    table: Table = [["array", *WIRINGS]]
    for name in ("hand", "fingertips", "soles", "grasps, 1 x 12 x 12"):
        cells = []
        for wiring in WIRINGS:
            row = f"{wiring}: undone"
            of = measured.cases(name, row)
            cells.append(f"{measured.cases(name, row, 'part')} of {of}" if of else ABSENT)
        table.append([name, *cells])
    return measured_rows(table)


def measured_rows(table: Table) -> Table:
    """Leave out the rows without a figure."""
    return [table[0], *(row for row in table[1:] if set(row[1:]) != {ABSENT})]


def dead(measured: Measured, array: str) -> list[str]:
    """Precision and recall of dead cells, and of those that die late."""
    rows = (f"{DEAD}: precision", f"{DEAD}: recall", f"{LATE}: precision", f"{LATE}: recall")
    return [shown(measured.value(array, row)) for row in rows]


def counted(measured: Measured) -> Measured:
    """Return what was measured without the figures that have no counts."""
    return replace(measured, figures=[])


def false_cells(measured: Measured, array: str) -> str:
    """Return healthy cells in F, in all healthy logs."""
    if (array, "false cells") in measured.newer:
        return f"{measured.newer[array, 'false cells']:g}"
    if not measured.of(array, ALARMS):
        return ABSENT
    return f"{measured.cases(array, ALARMS, 'part') / 1e6:.0f}"


HEAD = ["precision", "recall", "precision, late", "recall, late"]


def sensors(measured: Measured) -> Table:
    """The hand as other sensors would have read it, and after a drift: all of one run."""
    measured = counted(measured)
    table: Table = [["sensor or drift", *HEAD, "false cells"]]
    for name in (*SENSORS, *DRIFTS):
        array = "hand" if name == "as it is" else f"hand, {name}"
        label = f"drift: {name}" if name in DRIFTS else name
        table.append([label, *dead(measured, array), false_cells(measured, array)])
    return measured_rows(table)


def cold(measured: Measured) -> Table:
    """Without a reference."""
    table: Table = [["array", "precision", "recall", "false cells in a log"]]
    for array in ARRAYS:
        row = "no reference, healthy: false alarms"
        logs = measured.cases(array.name, row, "logs")
        wrong = measured.newer.get((array.name, row))
        if wrong is None and logs:
            wrong = measured.cases(array.name, row, "part") / 1e6 / logs
        shares = [measured.value(array.name, f"{COLD}: {what}") for what in ("precision", "recall")]
        table.append([array.name, *map(shown, shares), blamed(wrong)])
    return measured_rows(table)


def skins(measured: Measured) -> Table:
    """Simulated skins."""
    table: Table = [["skin", *HEAD, "exact lines", "false cells"]]
    for array in ARRAYS:
        if array.name.split(",")[0] in ("fabric", "posture"):
            lines = percent(measured.value(array.name, LINES))
            wrong = false_cells(measured, array.name)
            table.append([array.name, *dead(measured, array.name), lines, wrong])
    return measured_rows(table)


def by_array(
    measured: Measured, kind: str, rows: Iterable[tuple[str, str]], digits: int = 2
) -> Table:
    """Return a table with a column for each array of a kind.

    Args:
        measured: what was measured.
        kind: ``long logs`` or ``disturbed``.
        rows: what the page says, and row of the table.
        digits: of a figure.
    """
    rows = list(rows)
    of_rows = {row for _, row in rows}
    since = {array for array, row in measured.since if row in of_rows}
    columns: list[list[str]] = [["", *(name for name, _ in rows)]]
    for name in LIFE:
        array = f"{name}, {kind}"
        figures = [shown(measured.value(array, row), digits) for _, row in rows]
        if set(figures) != {ABSENT}:
            head = f"{name}, before" if since and array not in since else name
            columns.append([head, *figures])
    return list(zip(*columns, strict=True))


MOVING = (
    "swings by 20 %",
    "swings by 10 %",
    "swings by 5 %",
    "noise of 0.4 to 0.8 %",
    "dead in every 2nd recording",
    "dead in every 3rd recording",
    "floats by 90 of 4095",
    "10 frames late",
    "repeats a neighbour",
    "mean of the neighbours",
    "latched at another level",
    "clamped at 10 %",
    "keeps its peak",
    "load of another recording",
)


def moving(measured: Measured) -> Table:
    """Dead cells that move."""
    return by_array(measured, "long logs", ((case, f"{case}: recall") for case in MOVING))


def failing(measured: Measured) -> Table:
    """Wires that fail now and then."""
    rows = [
        (f"{case}: {what}", f"a wire {case}: {what}")
        for case in ("opens under load", "flickers")
        for what in ("named", "its cells called alive", "healthy cells blamed in a log")
    ]
    return by_array(measured, "long logs", rows)


DISTURBED = (
    "hum of 1 %",
    "hum of 3 %",
    "hum of 6 %",
    "one pad unused",
    "each cell creeps by 0 to 8 %",
    "a ramp to 15 %",
    "rest +6 %, gain -20 %",
    "16 levels",
    "8 levels",
    "empty and vibrating",
    "saturates at a tenth",
    "crosstalk of a pad",
    "noise x 5",
    "noise x 30",
)


def disturbed(measured: Measured) -> Table:
    """Something happens to all cells; with dead cells in brackets."""
    arrays = [f"{name}, disturbed" for name in LIFE]
    table: Table = [["", *LIFE]]
    for case in DISTURBED:
        cells = []
        for array in arrays:
            wrong = measured.value(array, f"{case}: cells blamed in a log")
            rows = [f"{case}, 8 % dead: {what}" for what in ("precision", "recall")]
            found = [shown(measured.value(array, row), 2) for row in rows]
            cells.append(ABSENT if wrong is None else f"{wrong:.1f} ({', '.join(found)})")
        table.append([case, *cells])
    return measured_rows(table)


SHORT = ("offset of 0 to 8 %", "one recording", "one frame each", "cut in a contact")


def short(measured: Measured) -> Table:
    """Offsets and short logs."""
    rows = ((case, f"{case}: cells blamed in a log") for case in SHORT)
    return by_array(measured, "disturbed", rows, 1)


def idle(measured: Measured) -> Table:
    """Noise without contact, and alarms of a monitor."""
    rows = [
        ("noise of 1 to 30 times, no contact: share tested", "noise without contact: share tested"),
        ("exit code 0", "noise without contact: exit code 0"),
        ("alarms of a Monitor on a healthy stream", "a healthy stream: alarms"),
    ]
    return by_array(measured, "disturbed", rows)


def of_other(measured: Measured, name: str) -> Table:
    """A table of other_figures.jsonl."""
    figures = [figure for figure in measured.others if figure["table"] == name]
    columns = dict.fromkeys(figure["column"] for figure in figures)
    table: Table = [["", *columns]]
    for row in dict.fromkeys(figure["row"] for figure in figures):
        cells = {
            figure["column"]: other_shown(figure) for figure in figures if figure["row"] == row
        }
        table.append([row, *(cells.get(column, ABSENT) for column in columns)])
    return table


def other_shown(figure: dict) -> str:
    if "unit" in figure:
        return f"{figure['value']:g} {figure['unit']}".rstrip()
    text = shown(figure["value"])
    if "spread" in figure:
        text += f" ± {shown(figure['spread'])}"
    if "best" in figure:
        text += f" / {shown(figure['best'])} {figure['by']}"
    return text


CORE = (  # what the page says, name in core_speed.csv
    ("training, a step of 32 windows", "training step, 32 windows"),
    ("fine-tuning, a step", "fine-tuning step, 32 windows"),
    ("prediction of 256 windows", "prediction on torch, 256 windows"),
    ("fill, 256 windows", "fill: applied to 256 windows"),
    ("new head, 20 of 220 cells, 2,600 windows", "adapt, method head"),
    ("fit of the diagnosis on 14 grasps", "diagnosis: fit on 14 grasps"),
    ("diagnosis of 2,000 frames", "diagnosis: a log of 2000 frames"),
)


def core(_: Measured) -> Table:
    """Jobs beside a matrix product."""
    jobs = {job["name"]: job for job in rows_of(EXAMPLES / "speed" / "core_speed.csv")}
    table: Table = [["job", "time", "share of the matrix product"]]
    for name, job in CORE:
        share = float(jobs[job]["share_of_product"])
        of_product = f"{100 * share:.0f} %" if share else ABSENT
        table.append([name, seconds(jobs[job]["seconds"]), of_product])
    return table


SCALED = ("fit", "diagnose", "fill build")


def scale(_: Measured) -> Table:
    """Skins of one pad and of many."""
    measured: dict[tuple[str, int], dict[str, dict[str, str]]] = {}
    for row in rows_of(EXAMPLES / "scale" / "scale.csv"):
        measured.setdefault((row["pads"], int(row["cells"])), {})[row["stage"]] = row
    head = ["cells", "fit", "diagnosis", "fill", "memory"]
    table: Table = [[*head, "precision", "recall", "wires found", "invented"]]
    for (pads, cells), stages in measured.items():
        found = stages["diagnose"]
        times = [seconds(stages[stage]["cpu"]) for stage in SCALED]
        memory = max(float(stage["peak_mb"]) for stage in stages.values())
        shares = [shown(float(found[what])) for what in ("precision", "recall")]
        wires = [f"{found['named']} of {found['wires']}", found["invented"]]
        table.append([f"{cells:,}, {pads}", *times, f"{memory:,.0f} MB", *shares, *wires])
    return table


TABLES: dict[str, Callable[[Measured], Table]] = {
    table.__name__: table
    for table in (
        hand, rewired, sensors, cold, skins, moving, failing, disturbed, short, idle, core,
        scale,
    )
} | {
    name: partial(of_other, name=name)
    for name in (
        "repaired", "fresh", "simulated", "every_sensor", "forecast", "new_objects", "iclabel",
        "tuning", "gpu",
    )
}  # fmt: skip
BLOCK = re.compile(r"<!-- table: (\w+) -->\n.*?<!-- end -->", re.DOTALL)


def drawn(table: Table) -> str:
    """Return a table in Markdown."""
    head, *rows = table
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def written(text: str, measured: Measured) -> str:
    """Return a page with its tables as they were measured.

    Raises:
        KeyError: a table that there is not.
    """

    def replaced(match: re.Match[str]) -> str:
        name = match[1]
        return f"<!-- table: {name} -->\n\n{drawn(TABLES[name](measured))}\n\n<!-- end -->"

    return BLOCK.sub(replaced, text)


def with_tables() -> list[Path]:
    """Return the pages that hold tables."""
    return [page for page in sorted(PAGES.glob("*.md")) if BLOCK.search(page.read_text())]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing, name what differs")
    measured_help = "delete the figures of rows that table.jsonl has"
    parser.add_argument("--measured", action="store_true", help=measured_help)
    options = parser.parse_args()
    measured = Measured.read()
    if options.measured:
        measured = replace(measured, figures=measured.left())
        lines = (json.dumps(figure) + "\n" for figure in measured.figures)
        (HERE / "figures.jsonl").write_text("".join(lines))
    differs = 0
    for page in with_tables():
        before = page.read_text()
        after = written(before, measured)
        if before == after:
            continue
        differs = 1
        print(f"{page.name} {'differs' if options.check else 'is written'}")
        if not options.check:
            page.write_text(after)
    return differs if options.check else 0


if __name__ == "__main__":
    sys.exit(main())
