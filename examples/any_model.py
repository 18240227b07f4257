"""Repair of any consumer of tactile data: python examples/any_model.py [RECORDINGS ...] [--small]
[--out any_model]

A 1-D CNN over time, an LSTM, a small 3-D CNN, an MLP on statistics and the paper's network;
ExtraTrees, SVC and histogram boosting from scikit-learn; a regression of total force and its
centre. For each kind of fault (10 % and 50 % of the cells at random, five rows, one pad, two lines)
the table has the test score with the faults ignored, with zeros, restored, restored + head,
fine-tuned for ``--finetune`` seconds and trained anew, and CPU seconds. Faulty cells read 0 or full
scale. The score is the accuracy, or R2; a regression also has the mean absolute error of restored
and of restored + head, divided by that of training anew. Without RECORDINGS, grasps are simulated.

Networks are trained until validation does not improve for 10 epochs; the paper's network 20 epochs,
as in ``adaptation_figures.py``, whose networks ``--bases`` takes instead. Each result is a line of
OUT.jsonl; started again, the script goes on where it was. At the end it writes OUT.csv and OUT.png.
``--small`` takes seconds.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sklearn.ensemble import ExtraTreesClassifier, HistGradientBoostingClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC
from torch import nn

from adaptfault import (
    Adapter,
    CellImputer,
    FaultTolerantClassifier,
    Recordings,
    TactileTransformer,
    Windows,
    evaluate,
    load,
    load_model,
    make_windows,
    simulate,
    split,
    train,
)
from diagnostics import FaultSet, SensorLayout

SEEDS = (20, 21, 22)
COLUMNS = (
    "fault-free",
    "nothing",
    "zeros",
    "restored",
    "head",
    "finetuned",
    "anew",
    "restored s",
    "head s",
    "anew s",
    "anew epochs",
)
COLOURS = {
    "nothing": "0.75",
    "zeros": "0.55",
    "restored": "tab:cyan",
    "head": "tab:blue",
    "finetuned": "tab:purple",
    "anew": "tab:orange",
}
ERRORS = ("restored/anew", "head/anew")  # mean absolute errors of a regression


class OverTime(nn.Module):
    """A 1-D CNN over time."""

    def __init__(self, layout: SensorLayout, length: int, n: int) -> None:
        super().__init__()
        d = layout.n_cells
        self.net = nn.Sequential(
            nn.Conv1d(d, 64, 3, padding=1), nn.ReLU(), nn.Conv1d(64, 64, 3, padding=1), nn.ReLU()
        )
        self.last = nn.Linear(64, n)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.last(self.net(x.transpose(1, 2)).amax(2))


class Lstm(nn.Module):
    """An LSTM over the frames."""

    def __init__(self, layout: SensorLayout, length: int, n: int) -> None:
        super().__init__()
        self.lstm = nn.LSTM(layout.n_cells, 64, batch_first=True)
        self.last = nn.Linear(64, n)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.last(self.lstm(x)[0].mean(1))


class Volume(nn.Module):
    """A 3-D CNN, which takes [N, C, T, H, W]."""

    def __init__(self, layout: SensorLayout, length: int, n: int) -> None:
        super().__init__()
        self.shape = layout.shape
        self.net = nn.Sequential(
            nn.Conv3d(layout.pads, 8, 3, padding=1),
            nn.ReLU(),
            nn.AdaptiveAvgPool3d((1, layout.rows, layout.cols)),
        )
        self.last = nn.Linear(8 * layout.rows * layout.cols, n)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        grid = x.reshape(len(x), -1, *self.shape).transpose(1, 2)
        return self.last(self.net(grid).flatten(1))


class Statistics(nn.Module):
    """An MLP on mean and maximum of each cell."""

    def __init__(self, layout: SensorLayout, length: int, n: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(2 * layout.n_cells, 128)
        self.last = nn.Linear(128, n)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.last(torch.relu(self.hidden(torch.cat([x.mean(1), x.amax(1)], 1))))


def transformer(layout: SensorLayout, length: int, n: int) -> nn.Module:
    return TactileTransformer(layout, n, length=length)


NETWORKS: dict[str, Callable[[SensorLayout, int, int], nn.Module]] = {
    "1-D CNN": OverTime,
    "LSTM": Lstm,
    "3-D CNN": Volume,
    "MLP": Statistics,
    "TactileTransformer": transformer,
}
CLASSIFIERS = {
    "ExtraTrees": ExtraTreesClassifier(200, random_state=0),
    "SVC": make_pipeline(StandardScaler(), SVC()),
    "boosting": HistGradientBoostingClassifier(max_iter=50, random_state=0),
}


def fault_sets(layout: SensorLayout, rng: np.random.Generator) -> dict[str, FaultSet]:
    """Return the kinds of fault; one pad only where there are several."""
    d = layout.n_cells
    present = np.flatnonzero(layout.present)
    rows = [line for line in layout.lines if line.kind == "row" and len(layout.cells_on(line))]
    wires = [
        line
        for line in layout.lines
        if line.kind in ("row", "column") and len(layout.cells_on(line))
    ]

    def lines(of: list, n: int) -> FaultSet:
        chosen = rng.choice(len(of), min(n, len(of) // 2), replace=False)
        return FaultSet(tuple(int(c) for i in chosen for c in layout.cells_on(of[i])), d)

    kinds = {
        f"{share:.0%} random": FaultSet(
            tuple(rng.permutation(present)[: round(share * len(present))].tolist()), d
        )
        for share in (0.1, 0.5)
    }
    kinds |= {"five rows": lines(rows, 5), "two lines": lines(wires, 2)}
    if layout.pads > 1:
        kinds["one pad"] = FaultSet(
            tuple(c for c in present.tolist() if c < layout.rows * layout.cols), d
        )
    return kinds


def spoilt(windows: Windows, fault_set: FaultSet, rng: np.random.Generator) -> Windows:
    """Return windows in which each cell of F reads 0 or full scale."""
    x = windows.x.copy()
    x[..., fault_set.mask] = rng.integers(0, 2, len(fault_set))
    return Windows(x, windows.y, windows.recording)


def score(model: object, windows: Windows) -> float:
    """Return the accuracy, or R2 of a regression."""
    scores = evaluate(model, windows)
    return scores.r2 if windows.y.ndim == 2 else scores.accuracy


def error(model: object, windows: Windows) -> float:
    """Return the mean absolute error of a regression, over its values."""
    return float(np.mean(evaluate(model, windows).mae))


def options(name: str, args: argparse.Namespace) -> dict[str, Any]:
    """Return how a network is trained: the paper's as in ``adaptation_figures.py``, others until
    validation stops."""
    if name == "TactileTransformer":
        return {
            "epochs": min(20, args.epochs),
            "patience": None,
            "learning_rate": 1e-4,
            "progress": False,
        }
    return {"epochs": args.epochs, "learning_rate": 1e-3, "progress": False}


def trained(
    name: str, layout: SensorLayout, parts, args: argparse.Namespace, seed: int
) -> nn.Module:
    """Return the fault-free network."""
    if name == "TactileTransformer" and args.bases is not None:
        return load_model(args.bases / f"base{seed}")
    torch.manual_seed(seed)
    model = fresh(name, layout, parts)
    train(model, *parts[:2], **options(name, args))
    return model


def fresh(name: str, layout: SensorLayout, parts) -> nn.Module:
    """Return a network with new weights."""
    training = parts[0]
    n = training.y.shape[1] if training.y.ndim == 2 else int(training.y.max()) + 1
    return NETWORKS.get(name, Statistics)(layout, training.x.shape[1], n)


def of_network(
    name: str, layout: SensorLayout, parts, kinds, args, seed: int
) -> Iterator[tuple[str, dict[str, float]]]:
    """Measure one torch model under some kinds of fault."""
    training, validation, test = parts
    rng = np.random.default_rng(seed)
    model = trained(name, layout, parts, args, seed)
    adapter = Adapter(model, training, validation, layout=layout)
    _ = adapter.imputation, adapter.compact  # computed once, no cost of a fault set
    for kind, fault_set in kinds.items():
        broken = spoilt(test, fault_set, rng)
        zeros = Windows(np.where(fault_set.mask, 0, broken.x), test.y, test.recording)
        row = {
            "fault-free": score(model, test),
            "nothing": score(model, broken),
            "zeros": score(model, zeros),
        }
        began = time.process_time()
        restored = adapter.adapt(fault_set, method="fill")
        row["restored s"] = time.process_time() - began
        row["restored"] = score(restored, broken)
        began = time.process_time()
        head = adapter.adapt(fault_set, method="head")
        row["head s"] = time.process_time() - began
        row["head"] = score(head, broken)
        if args.finetune:
            tuned = adapter.adapt(
                fault_set, method="finetune", budget=args.finetune, progress=False
            )
            row["finetuned"] = score(tuned, broken)
        if not args.no_anew:
            began = time.process_time()
            anew = fresh(name, layout, parts)
            without = [
                Windows(np.where(fault_set.mask, 0, w.x), w.y, w.recording)
                for w in (training, validation)
            ]
            row["anew epochs"] = train(anew, *without, **options(name, args)).epochs
            row["anew s"] = time.process_time() - began
            row["anew"] = score(anew, zeros)
            if test.y.ndim == 2:
                least = error(anew, zeros)
                row |= {
                    "restored/anew": error(restored, broken) / least,
                    "head/anew": error(head, broken) / least,
                }
        yield kind, row


def of_classifier(estimator, parts, kinds, seed: int) -> Iterator[tuple[str, dict[str, float]]]:
    """Measure one scikit-learn classifier; "head" is what FaultTolerantClassifier chose, "anew" the
    refit."""
    from sklearn.base import clone

    def table(windows: Windows) -> np.ndarray:
        return np.concatenate([windows.x.mean(1), windows.x.max(1)], axis=1)

    (training, _, test), rng = parts, np.random.default_rng(seed)
    x = table(training)
    tolerant = FaultTolerantClassifier(estimator).fit(x, training.y, groups=training.recording)
    for kind, fault_set in kinds.items():
        broken = table(spoilt(test, fault_set, rng))
        columns = np.tile(fault_set.mask, 2)
        whole = tolerant.set_faults(None).estimator_
        row = {
            "fault-free": whole.score(table(test), test.y),
            "nothing": whole.score(broken, test.y),
        }
        row["zeros"] = whole.score(np.where(columns, 0, broken), test.y)
        row["restored"] = whole.score(CellImputer(fault_set).fit(x).transform(broken), test.y)
        began = time.process_time()
        tolerant.set_faults(fault_set)
        row["head s"] = time.process_time() - began
        row["head"] = tolerant.score(broken, test.y)
        began = time.process_time()
        refit = clone(estimator).fit(x[:, ~columns], training.y)
        row["anew s"] = time.process_time() - began
        row["anew"] = refit.score(broken[:, ~columns], test.y)
        yield kind, row


def forces(windows: Windows, layout: SensorLayout) -> Windows:
    """Return the windows with contact; their values are total force and its centre, scaled to about
    -1 to 1."""
    mean = windows.x.mean(1)
    total = np.maximum(mean.sum(1), 1e-6)
    row = np.arange(layout.n_cells) // layout.cols % layout.rows
    col = np.arange(layout.n_cells) % layout.cols
    centre = (
        mean @ row / total / max(1, layout.rows - 1),
        mean @ col / total / max(1, layout.cols - 1),
    )
    touched = total > np.percentile(total, 20)
    y = np.stack([np.log(total / np.median(total)), 2 * centre[0] - 1, 2 * centre[1] - 1], axis=1)
    return Windows(windows.x[touched], y[touched], windows.recording[touched])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="*", help="labelled recordings; none: simulated grasps")
    parser.add_argument(
        "--small", action="store_true", help="one seed, little training, two models"
    )
    parser.add_argument("--only", nargs="+", help="names of consumers")
    parser.add_argument("--kinds", nargs="+", help="kinds of fault, as the table names them")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument("--epochs", type=int, default=200, help="at most")
    parser.add_argument(
        "--bases", type=Path, help="folder with trained networks base20, base21, ..."
    )
    parser.add_argument("--no-anew", action="store_true", help="leave out training anew")
    parser.add_argument("--finetune", type=float, default=60.0, help="seconds; 0 leaves it out")
    parser.add_argument(
        "--out", default="any_model", help="name of the results, the table and the picture"
    )
    args = parser.parse_args()
    if args.small:
        args.epochs = 2
        args.finetune = 0.0
        args.only = args.only or ["MLP", "ExtraTrees", "forces"]
    if args.recordings:
        recordings = load(args.recordings).recordings
    elif args.small:
        classes = ("nothing", "softer", "harder")
        recordings = simulate(20, SensorLayout(2, 6, 5), n_frames=40, seed=1, classes=classes)
    else:
        recordings = simulate(60, seed=0)
    measure(recordings, args)
    found: dict[tuple[str, str], list[dict[str, float]]] = {}
    for line in Path(f"{args.out}.jsonl").read_text().splitlines():
        result = json.loads(line)
        found.setdefault((result["consumer"], result["faults"]), []).append(result["row"])
    report(found, args.out)


def measure(recordings: Recordings, args: argparse.Namespace) -> None:
    """Append a line for each seed, consumer and kind of fault that OUT.jsonl lacks."""
    layout = recordings.layout
    path = Path(f"{args.out}.jsonl")
    windows = make_windows(recordings.frames, recordings.labels, layout)
    results = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {(result["seed"], result["consumer"], result["faults"]) for result in results}
    for seed in args.seeds[: 1 if args.small else None]:
        parts = split(windows, seed=seed)
        of_forces = tuple(forces(w, layout) for w in parts)
        every = fault_sets(layout, np.random.default_rng(seed))
        for name in args.only or [*NETWORKS, *CLASSIFIERS, "forces"]:
            kinds = {
                k: f
                for k, f in every.items()
                if k in (args.kinds or every) and (seed, name, k) not in done
            }
            if not kinds:
                continue
            if name in CLASSIFIERS:
                rows = of_classifier(CLASSIFIERS[name], parts, kinds, seed)
            else:
                rows = of_network(
                    name, layout, of_forces if name == "forces" else parts, kinds, args, seed
                )
            for kind, row in rows:
                with path.open("a") as file:
                    file.write(
                        json.dumps({"seed": seed, "consumer": name, "faults": kind, "row": row})
                        + "\n"
                    )
            print(f"seed {seed}: {name} done", file=sys.stderr, flush=True)


def report(found: dict[tuple[str, str], list[dict[str, float]]], out: str) -> None:
    """Print the table of means over the seeds, write it, and draw it."""
    table = {}
    for key, rows in found.items():
        known = {c: [row[c] for row in rows if c in row] for c in COLUMNS + ERRORS}
        table[key] = {c: float(np.mean(values)) for c, values in known.items() if values}
    columns = [c for c in COLUMNS + ERRORS if any(c in row for row in table.values())]
    print(f"{'consumer':20s}{'faults':12s}" + "".join(f"{c:>14s}" for c in columns))
    for (name, kind), row in table.items():
        print(
            f"{name:20s}{kind:12s}"
            + "".join(f"{row[c]:14.3f}" if c in row else f"{'-':>14s}" for c in columns)
        )
    with open(f"{out}.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["consumer", "faults", *columns])
        writer.writerows([*key, *(row.get(c, "") for c in columns)] for key, row in table.items())
    draw(table, f"{out}.png")


def draw(table: dict[tuple[str, str], dict[str, float]], path: str) -> None:
    """Draw the scores by kind of fault, one panel for each consumer."""
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(name for name, _ in table))
    shown = [column for column in COLOURS if any(column in row for row in table.values())]
    columns = min(2, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(6 * columns, 2.1 * rows + 0.6), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, name in zip(axes, names, strict=False):
        kinds = [kind for of, kind in table if of == name]
        for i, column in enumerate(shown):
            at = np.arange(len(kinds)) + 0.8 * ((i + 0.5) / len(shown) - 0.5)
            heights = [table[name, kind].get(column, np.nan) for kind in kinds]
            ax.bar(at, heights, 0.8 / len(shown), color=COLOURS[column], label=column)
        ax.axhline(
            table[name, kinds[0]]["fault-free"],
            color="0.3",
            linestyle="--",
            linewidth=1,
            label="fault-free",
        )
        regression = "head/anew" in table[name, kinds[0]]
        # an R2 below 0 shows no bar
        ax.set(title=name, ylabel="R2" if regression else "accuracy", ylim=(0, 1))
        ax.set_xticks(range(len(kinds)), kinds)
        ax.spines[["top", "right"]].set_visible(False)
    for ax in axes[len(names) :]:
        ax.set_axis_off()
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
