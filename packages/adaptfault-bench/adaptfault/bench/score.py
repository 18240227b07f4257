"""Scores submissions against the truth, and makes the page of results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from adaptfault.bench.folder import Bench, Json, read_json
from adaptfault.bench.run import SUBMISSION

MEND = "run the same command to finish it, or remove it"
BROKEN = ("dead", "dead later", "moving", "wires")
UNBROKEN = ("healthy", "disturbed")


@dataclass
class Share:
    """``part`` of ``of`` cases."""

    part: int = 0
    of: int = 0

    def add(self, part: int, of: int) -> None:
        """Count further cases."""
        self.part += part
        self.of += of

    @property
    def value(self) -> float:
        """The share; NaN of no case."""
        return self.part / self.of if self.of else float("nan")

    def __str__(self) -> str:
        return f"{self.value:.3f}" if self.of else "-"


@dataclass
class Score:
    """What a diagnoser reached on logs.

    Attributes:
        precision: of the cells in F, those that are dead, in logs with dead cells.
        recall: of the testable dead cells, those in F.
        blamed: healthy cells in F, of logs in which no cell is dead; a number a log.
        wires: logs in which exactly the broken wires are named, of those with wires that can be
            named.
        honest: of the dead cells that the log does not test, those that are not called alive.
        undecided: healthy cells that are called untested.
    """

    precision: Share = field(default_factory=Share)
    recall: Share = field(default_factory=Share)
    blamed: Share = field(default_factory=Share)
    wires: Share = field(default_factory=Share)
    honest: Share = field(default_factory=Share)
    undecided: Share = field(default_factory=Share)

    def add(self, answer: Json, truth: Json, n_cells: int) -> None:
        """Count one log."""
        faulty = set(answer.get("faulty", []))
        untested = set(answer.get("untested") or []) - faulty
        dead = set(truth["dead"])
        hidden = dead - set(truth["testable"])
        if dead:
            self.precision.add(len(faulty & dead), len(faulty))
            self.recall.add(len(faulty - hidden & dead), len(dead - hidden))
            self.honest.add(len(hidden & (faulty | untested)), len(hidden))
        else:
            self.blamed.add(len(faulty), 1)
        self.undecided.add(len(untested - dead), n_cells - len(dead))
        if truth["wires"] and truth["nameable"] and answer.get("wires") is not None:
            self.wires.add(sorted(answer["wires"]) == sorted(truth["wires"]), 1)


def submission(path: Path, bench: Bench) -> Json:
    """Return a finished submission to a bench.

    Raises:
        ValueError: it is cut off, not finished, of another bench, or an answer is none.
    """
    found = read_json(path, SUBMISSION, MEND)
    if found.get("bench") != bench.identity:
        raise ValueError(
            f"{path}: is of bench {str(found.get('bench'))[:12]}..., {bench.folder} is"
            f" {bench.identity[:12]}...; another seed or another version made it; run the method"
            " on this one"
        )
    what = str(found.get("what"))
    tasks = bench.manifest.get(what, {})
    results = found.get("results")
    answers = results if isinstance(results, dict) else {}
    if missing := [name for name in tasks if name not in answers]:
        raise ValueError(f"{path}: {len(missing)} of {len(tasks)} {what} are missing; {MEND}")
    need = "faulty" if what == "logs" else "predicted"
    for name in tasks:
        answer = answers[name]
        if not isinstance(answer, dict) or not (need in answer or "error" in answer):
            raise ValueError(f"{path}: {name} has no {need!r}; {MEND}")
    return found


def scores(found: Json, bench: Bench, truth: Json) -> dict[str, Score]:
    """Return the score of a diagnoser on all logs ("all"), and by kind of log."""
    reached = {"all": Score()}
    for name, told in truth["logs"].items():
        for kind in ("all", told["kind"]):
            of = reached.setdefault(kind, Score())
            of.add(found["results"][name], told, bench.manifest["logs"][name]["cells"])
    return reached


def accuracies(found: Json, truth: Json) -> dict[str, Share]:
    """Return the accuracy of a repairer over the sensors, by fault set."""
    reached: dict[str, Share] = {}
    for name, told in truth["repairs"].items():
        predicted = found["results"][name].get("predicted", [-1] * len(told["y"]))
        if len(predicted) != len(told["y"]):
            raise ValueError(f"{found['method']}: {name} has {len(predicted)} classes; {MEND}")
        right = np.equal(predicted, told["y"])
        reached.setdefault(told["case"], Share()).add(int(right.sum()), len(right))
    return reached


def seconds(found: Json) -> str:
    """Return the CPU seconds of fits and answers together."""
    answers = sum(result.get("seconds", 0.0) for result in found["results"].values())
    fits = sum(found["fit_seconds"].values()) if found["what"] == "logs" else 0.0
    return f"{answers + fits:.1f}"


def failed(found: Json) -> int:
    """Return on how many logs the method failed."""
    return sum("error" in result for result in found["results"].values())


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines) + "\n"


def page(bench: Bench, truth_path: Path, paths: Sequence[Path]) -> str:
    """Return the results of submissions in Markdown, in the order given.

    Raises:
        ValueError: the truth or a submission is not of this bench.
    """
    truth = bench.truth(truth_path)
    given = [submission(path, bench) for path in paths]
    logs = {found["method"]: found for found in given if found["what"] == "logs"}
    repairs = {found["method"]: found for found in given if found["what"] == "repairs"}
    text = f"Bench `{bench.identity[:12]}`: {len(truth['logs'])} logs, {len(truth['repairs'])}"
    text += " repairs.\n"
    if logs:
        reached = {name: scores(found, bench, truth) for name, found in logs.items()}
        head = ["diagnoser", "precision", "recall of the testable", "healthy blamed a log"]
        head += ["wires exact", "honest UNTESTED", "healthy UNTESTED", "failed", "CPU seconds"]
        rows = []
        for name, of in reached.items():
            all_ = of["all"]
            row = [f"`{name}`", all_.precision, all_.recall, all_.blamed, all_.wires, all_.honest]
            rows.append([*row, all_.undecided, failed(logs[name]), seconds(logs[name])])
        text += "\n" + table(head, rows)
        head = ["precision / recall, or blamed a log", *BROKEN, *UNBROKEN]
        rows = []
        for name, of in reached.items():
            row = [f"{of[kind].precision} / {of[kind].recall}" for kind in BROKEN]
            rows.append([f"`{name}`", *row, *(str(of[kind].blamed) for kind in UNBROKEN)])
        text += "\n" + table(head, rows)
    if repairs:
        correct = {name: accuracies(found, truth) for name, found in repairs.items()}
        cases = list(next(iter(correct.values())))
        rows = [
            [f"`{name}`", *of.values(), failed(repairs[name]), seconds(repairs[name])]
            for name, of in correct.items()
        ]
        text += "\n" + table(["repairer, accuracy", *cases, "failed", "CPU seconds"], rows)
    return text
