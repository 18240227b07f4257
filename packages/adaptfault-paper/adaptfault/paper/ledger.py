"""Results of a run: a line of JSON for each task, so that an interrupted run repeats no
measurement."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.json_lines import Lines
from adaptfault.data.windows import Windows
from adaptfault.evaluation.scores import Scores, accuracy_interval
from adaptfault.paper.settings import Task


@dataclass(frozen=True)
class Result:
    """Result of one task.

    Attributes:
        task: the task.
        accuracy, precision, recall, f1: on the test windows, macro averages (Section III-B).
        recordings: (number, windows, windows classified correctly) of each test recording.
        seconds: wall clock, including training if the network was new.
    """

    task: Task
    accuracy: float
    precision: float
    recall: float
    f1: float
    recordings: tuple[tuple[int, int, int], ...]
    seconds: float

    @classmethod
    def of(cls, task: Task, test: Windows, predicted: NDArray[np.int64], seconds: float) -> Result:
        """Score the predictions for the test windows."""
        scores = Scores.of(test.y, predicted)
        right = predicted == test.y
        counts = []
        for number in np.unique(test.recording).tolist():
            of = test.recording == number
            counts.append((number, int(of.sum()), int(right[of].sum())))
        return cls(
            task,
            scores.accuracy,
            scores.precision,
            scores.recall,
            scores.f1,
            tuple(counts),
            seconds,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        return asdict(self)

    @classmethod
    def from_dict(cls, d: dict[str, Any]) -> Result:
        """Build a result from :meth:`to_dict`'s dict."""
        counts = tuple(tuple(c) for c in d["recordings"])
        return cls(**{**d, "task": Task(**d["task"]), "recordings": counts})


@dataclass(frozen=True)
class Mean:
    """Results of one condition over the seeds.

    Attributes:
        accuracy, precision, recall, f1: means over the seeds.
        low, high: 95 % interval of the accuracy, clustered by recording.
        spread: standard deviation of the accuracy between seeds.
        seeds: number of seeds.
    """

    accuracy: float
    low: float
    high: float
    precision: float
    recall: float
    f1: float
    spread: float
    seeds: int

    def __str__(self) -> str:
        return f"{self.accuracy:.3f} ({self.low:.3f} to {self.high:.3f})"


def mean(results: Iterable[Result]) -> Mean:
    """Average results; a recording tested by several seeds is one cluster.

    Raises:
        ValueError: there are none.
    """
    results = list(results)
    if not results:
        raise ValueError("no results to average")
    number, n, right = np.array([c for result in results for c in result.recordings]).T
    wrong_then_right = np.stack([n - right, right], axis=1).ravel()
    low, high = accuracy_interval(
        np.repeat(np.tile([False, True], len(n)), wrong_then_right), np.repeat(number, n)
    )
    averages = {
        name: float(np.mean([getattr(r, name) for r in results]))
        for name in ("accuracy", "precision", "recall", "f1")
    }
    spread = float(np.std([r.accuracy for r in results], ddof=1)) if len(results) > 1 else 0.0
    return Mean(low=low, high=high, spread=spread, seeds=len(results), **averages)


class Ledger:
    """The results on disk.

    Args:
        path: the file; an incomplete last line is dropped.
    """

    def __init__(self, path: Path) -> None:
        self._lines = Lines(path)
        results = [Result.from_dict(document) for document in self._lines.read()]
        self.results: dict[Task, Result] = {result.task: result for result in results}

    def add(self, result: Result) -> None:
        """Add a result."""
        self.results[result.task] = result
        self._lines.add(result.to_dict())

    def arrange(self, tasks: Iterable[Task]) -> None:
        """Sort the results by the order of these tasks."""
        place = {task: i for i, task in enumerate(tasks)}
        known = sorted(self.results.items(), key=lambda pair: place.get(pair[0], len(place)))
        self.results = dict(known)

    def of(self, figure: int, **fields: Any) -> list[Result]:
        """Return the results of a figure whose tasks have these fields."""
        wanted = {"figure": figure, **fields}
        return [
            r
            for r in self.results.values()
            if all(getattr(r.task, k) == v for k, v in wanted.items())
        ]

    def mean(self, figure: int, faults: str, k: int, strategy: str) -> Mean | None:
        """Return a condition's mean over the seeds; None where nothing was measured."""
        results = self.of(figure, faults=faults, k=k, strategy=strategy)
        return mean(results) if results else None
