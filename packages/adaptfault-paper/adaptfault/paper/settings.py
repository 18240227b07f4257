"""Tasks and settings of a reproduction: the quick run and the full one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

PAPER_CELLS = 220
# the last three are the paper's future work
FUTURE = (
    "open",
    "short",
    "noisy",
    "drift",
    "intermittent",
)
WIRING = ("lines", "blocks")  # faults of real arrays; the paper has scattered cells only

CORRECTIONS = ("correct to 0", "correct to half", "correct to the mean", "correct to 0, wait 5")


@dataclass(frozen=True)
class Task:
    """One cell of work: a strategy on a kind of fault.

    Attributes:
        figure: number of the figure in the paper; 7 is the paper's future work.
        seed: of split, weights, training and faults.
        faults: "none", "open", "short", "mixed" (each with equal chance), a kind of :data:`FUTURE`
            or :data:`WIRING`.
        k: number of faulty cells (of lines or blocks, for :data:`WIRING`).
        strategy: the repair.
    """

    figure: int
    seed: int
    faults: str
    k: int
    strategy: str


@dataclass(frozen=True)
class Settings:
    """Extent of the measurements.

    Attributes:
        seeds: each has its own split, weights, training and faults.
        grasps: simulated, of each class.
        epochs, learning_rate, network: of the fault-free base.
        patience: of every training; None trains all epochs.
        counts: k of Figures 2 and 6.
        adapted: |F| of Figure 5, as on the paper's 220 cells.
        scratch: those of them for which a network is trained anew as well, the paper's protocol.
        samples: extra windows of fault-aware training.
        warm: fault-aware training goes on from the base, for ``aware_epochs``.
        aware_epochs: of fault-aware training.
        aware_kinds: of :data:`WIRING`; train fault-aware on these too, with the most samples.
        future: faulty cells in the comparison of strategies.
        controls: seeds, at most, of the control: fault-aware training's steps without its faults.
        judged: validation windows, at most, that networks and repairs are judged on.
        wiring: faulty lines or blocks there and in Figure 4.
        windows: tested of each recording, at most: windows of one grasp are strongly correlated.
        single: number of windows for the sensitivity to single faults.
    """

    seeds: tuple[int, ...] = (0, 1, 2)
    grasps: int = 200
    epochs: int = 50
    learning_rate: float = 1e-4
    network: dict[str, Any] = field(default_factory=lambda: {"inputs": "readings"})
    patience: int | None = 10
    counts: tuple[int, ...] = (1, 2, 5, 10, 20, 50)
    adapted: tuple[int, ...] = (0, 5, 10, 20, 50, 100, 150, 200)
    scratch: tuple[int, ...] = (5, 10, 20, 50, 100, 150, 200)
    samples: tuple[int, ...] = (10_000, 100_000, 200_000)
    warm: bool = False
    aware_epochs: int = 50
    aware_kinds: tuple[str, ...] = WIRING
    future: int = 10
    controls: int = 3
    judged: int = 10_000
    wiring: int = 2
    windows: int = 10
    single: int = 500

    @classmethod
    def full(cls) -> Settings:
        """As the paper: up to 50 epochs, 10k to 200k samples, a network trained anew for each F.
        For a GPU."""
        return cls()

    @classmethod
    def quick(cls, *, simulated: bool) -> Settings:
        """All but the networks trained anew, smaller: about 14 minutes on two free cores on
        simulated grasps.

        Most of the time is training: three base networks, three fault-aware networks, one control.
        """
        small: dict[str, Any] = {
            "patience": None,
            "counts": (2, 5, 10, 20),
            "adapted": (0, 5, 20, 50, 100, 200),
            "scratch": (),
            "samples": (10_000,),
            "warm": True,
            "aware_epochs": 1,
            "aware_kinds": (),
            "controls": 1,
            "judged": 800,
            "windows": 2,
            "single": 50,
        }
        # unpadded convolutions take a third of the time; Keras's initial weights train in three
        # epochs
        if simulated:
            return cls(
                epochs=3,
                learning_rate=2e-4,
                network={"padding": "valid", "init": "glorot", "inputs": "readings"},
                **small,
            )
        return cls(epochs=20, **small)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return asdict(self)

    def sizes(self, counts: tuple[int, ...], present: int) -> tuple[int, ...]:
        """Return |F| for an array of another size: up to 50 as on the paper's, beyond that the same
        share of it."""
        scaled = (k if k <= 50 else round(k * present / PAPER_CELLS) for k in counts)
        return tuple(sorted({k for k in scaled if k < present}))

    def tasks(self, present: int, figures: tuple[int, ...]) -> Iterator[Task]:
        """Yield the tasks of these figures on an array of ``present`` cells, those with most
        training last.

        Figure 6 also shows curves of Figure 2, and so needs its tasks.
        """
        figures = (*figures, 2) if 6 in figures else figures
        for part in (
            self._stuck,
            self._adapted,
            self._future,
            self._fault_aware,
            self._trained_anew,
        ):
            for seed in self.seeds:
                for task in part(seed, present):
                    if task.figure in figures:
                        yield task

    def _stuck(self, seed: int, present: int) -> Iterator[Task]:
        counts = self.sizes(self.counts, present)
        yield Task(2, seed, "none", 0, "nothing")
        for kind in ("open", "short"):
            for k in counts:
                yield Task(2, seed, kind, k, "nothing")
        for strategy in CORRECTIONS:
            yield Task(6, seed, "none", 0, strategy)
            for k in counts:
                yield Task(6, seed, "short", k, strategy)

    def _adapted(self, seed: int, present: int) -> Iterator[Task]:
        for k in self.sizes(self.adapted, present):
            yield Task(5, seed, "mixed", k, "adapted")

    def _future(self, seed: int, present: int) -> Iterator[Task]:
        for kind, k in self._kinds():
            for strategy in (
                "nothing",
                "correct to 0",
                "correct to the mean",
                "adapted",
                "combined",
            ):
                yield Task(7, seed, kind, k, strategy)

    def _kinds(self) -> list[tuple[str, int]]:
        return [
            *((kind, self.future) for kind in FUTURE),
            *((kind, self.wiring) for kind in WIRING),
        ]

    def _fault_aware(self, seed: int, present: int) -> Iterator[Task]:
        wiring = [(kind, self.wiring) for kind in WIRING]
        most = max(self.samples)
        networks = [aware(n) for n in (0, *self.samples)]
        networks += [aware(n, "none") for n in self.samples if seed in self.seeds[: self.controls]]
        networks += [aware(most, kind) for kind in self.aware_kinds]
        for strategy in networks:
            for kind, k in (("none", 0), ("mixed", 5), ("mixed", 10), ("short", 5), *wiring):
                yield Task(4, seed, kind, k, strategy)
        for kind, k in self._kinds():
            yield Task(7, seed, kind, k, aware(most))

    def _trained_anew(self, seed: int, present: int) -> Iterator[Task]:
        for k in self.sizes(self.scratch, present):
            yield Task(5, seed, "mixed", k, "trained anew")


def aware(n: int, kind: str = "cells") -> str:
    """Return the name of the strategy: training with n more windows, which have such faults
    ("none": the control)."""
    if kind == "none":
        return f"fault-free {n}"
    return f"fault-aware {n}" if kind == "cells" else f"fault-aware {n} {kind}"


def is_aware(strategy: str) -> tuple[int, str] | None:
    """Return n and kind of :func:`aware`'s name; None for another strategy."""
    match strategy.split():
        case ["fault-free", n]:
            return int(n), "none"
        case ["fault-aware", n, *kind]:
            return int(n), kind[0] if kind else "cells"
    return None
