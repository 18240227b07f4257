"""How well and how fast a repair is, beside what else could be done: adaptation_figures.py
[RECORDINGS]

For each seed (of the split, the weights, the faults) a fault-free network is trained once. Then
each fault set goes to each method, and the accuracy on test recordings and the seconds it took are
kept in ``--out``, a line of JSON each. Killed and started again, it goes on where it was. At the
end a table (mean over the seeds, and spread) and a picture, accuracy against seconds. The head is
also scored on whole grasps, by the product of the probabilities of their windows.
``--only METHOD ...`` picks methods. Without RECORDINGS a few simulated grasps must do, unless
``--grasps`` asks for more of them.

All that learns anew may use training and validation windows; the scratch network is chosen by the
latter.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np
from sklearn.ensemble import ExtraTreesClassifier, HistGradientBoostingClassifier
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

import adaptfault as af
from adaptfault.adaptation.reduced_model import ReducedModel, phi, reduce_windows
from adaptfault.imputation.statistics import CellStatistics
from adaptfault.models.network import logits_of
from diagnostics import FaultSet, SensorLayout

Parts = tuple[af.Windows, af.Windows, af.Windows]
KNOWN_FRAMES = 5_000  # that k-NN imputation looks through


def cases(layout: SensorLayout, seed: int, simulated: bool) -> dict[str, FaultSet]:
    """Scattered cells, lines and a pad; on the paper's array the sizes of its Figure 5."""
    rng = np.random.default_rng(100 + seed)
    present = np.flatnonzero(layout.present)
    index = np.arange(layout.n_cells).reshape(layout.shape)
    sizes = {f"random {share:.0%}": round(share * len(present)) for share in (0.1, 0.5, 0.8)}
    if simulated:
        sizes = {f"{k} cells": k for k in (5, 10, 20, 50, 100, 150, 200) if k < len(present)}
    sets = {name: rng.choice(present, k, replace=False) for name, k in sizes.items()}
    middle = (layout.rows - 5) // 2 + np.arange(5)
    sets["five rows, all pads"] = index[:, middle].ravel()
    if layout.pads > 1:
        sets["one pad"] = index[seed % layout.pads].ravel()
    return {
        name: FaultSet(tuple(int(c) for c in cells if layout.present.flat[c]), layout.n_cells)
        for name, cells in sets.items()
    }


class Repairs:
    """Every method, on one fault-free network: ``method(F) -> (predict, seconds to repair)``.

    ``predict`` gives classes ``[N]`` or probabilities ``[N, n_classes]``.
    """

    def __init__(
        self, model: af.TactileTransformer, parts: Parts, seed: int, scratch_epochs: int
    ) -> None:
        self.model = model
        self.layout = model.layout
        self.seed = seed
        self.scratch_epochs = scratch_epochs
        self.train, self.validation, self.test = parts
        self.adapter = af.Adapter(model, self.train, self.validation)
        self.statistics: CellStatistics = self.adapter.statistics
        self.known = np.concatenate([self.train.x, self.validation.x])
        self.y = np.concatenate([self.train.y, self.validation.y])
        self.methods: dict[str, Callable[[FaultSet], tuple[Callable, float]]] = {
            "full scale": lambda f: (lambda x: self.model.predict(set_to(x, f, 1.0)), 0.0),
            "zeros": lambda f: (lambda x: self.model.predict(set_to(x, f, 0.0)), 0.0),
            "mean fill": lambda f: (
                lambda x: self.model.predict(set_to(x, f, self.statistics.mean[list(f)])),
                0.0,
            ),
            "linear fill": self._linear,
            "fill": lambda f: self._adapted(f, "fill"),
            "head": lambda f: self._adapted(f, "head"),
            "auto": lambda f: self._adapted(f, "auto"),
            "finetune": lambda f: self._adapted(f, "finetune"),
            "scratch": self._scratch,
            "k-NN imputation + SVC": lambda f: self._imputed(f, self._nearest_frames(f)),
            "conditional mean + SVC": lambda f: self._imputed(f, self._conditional_mean(f)),
            "ExtraTrees retrained": lambda f: self._retrained(
                f, ExtraTreesClassifier(300, random_state=self.seed)
            ),
            "boosting retrained": lambda f: self._retrained(
                f, HistGradientBoostingClassifier(max_iter=50, random_state=self.seed)
            ),
        }

    def _adapted(self, faults: FaultSet, method: str) -> tuple[Callable, float]:
        began = time.perf_counter()
        adaptation = self.adapter.adapt(faults, method=method, seed=self.seed, progress=False)
        return adaptation.predict_proba, time.perf_counter() - began

    def _linear(self, faults: FaultSet) -> tuple[Callable, float]:
        began = time.perf_counter()
        reduced = ReducedModel(self.model, faults, self.statistics.linear(faults)).eval()
        return (
            lambda x: logits_of(reduced, phi(x, faults)).argmax(1).numpy(),
            time.perf_counter() - began,
        )

    def _scratch(self, faults: FaultSet) -> tuple[Callable, float]:
        """The paper's protocol with a fixed number of epochs."""
        began = time.perf_counter()
        fresh = type(self.model).from_config({**self.model.config, "seed": self.seed + 1})
        reduced = ReducedModel(fresh, faults, self.statistics.linear(faults))
        af.train(
            reduced,
            reduce_windows(self.train, faults),
            reduce_windows(self.validation, faults),
            epochs=self.scratch_epochs,
            patience=None,
            learning_rate=rate(self.model),
            seed=self.seed,
            progress=False,
        )
        return (
            lambda x: logits_of(reduced, phi(x, faults)).argmax(1).numpy(),
            time.perf_counter() - began,
        )

    def _retrained(self, faults: FaultSet, classifier) -> tuple[Callable, float]:
        began = time.perf_counter()
        classifier.fit(summary(phi(self.known, faults)), self.y)
        return lambda x: classifier.predict(summary(phi(x, faults))), time.perf_counter() - began

    def _imputed(self, faults: FaultSet, impute: Callable) -> tuple[Callable, float]:
        began = time.perf_counter()
        classifier = make_pipeline(StandardScaler(), SVC(C=10)).fit(summary(self.known), self.y)
        return lambda x: classifier.predict(summary(impute(x))), time.perf_counter() - began

    def _nearest_frames(self, faults: FaultSet) -> Callable:
        frames = self.known.reshape(-1, self.known.shape[2])
        frames = frames[np.linspace(0, len(frames) - 1, min(KNOWN_FRAMES, len(frames))).astype(int)]
        near = KNeighborsRegressor(5).fit(phi(frames, faults), frames[:, list(faults)])
        return lambda x: set_to(
            x, faults, near.predict(phi(x, faults).reshape(-1, len(faults.healthy)))
        )

    def _conditional_mean(self, faults: FaultSet) -> Callable:
        weight, bias = self.statistics.conditional_mean(faults)
        return lambda x: set_to(x, faults, np.clip(phi(x, faults) @ weight.T + bias, 0, 1))


def set_to(x: np.ndarray, faults: FaultSet, value) -> np.ndarray:
    x = x.copy()
    x[..., list(faults)] = np.reshape(value, (*x.shape[:2], -1)) if np.ndim(value) > 1 else value
    return x


def summary(x: np.ndarray) -> np.ndarray:
    return np.concatenate([x.mean(axis=1), x.max(axis=1)], axis=1)


def whole_grasps(probabilities: np.ndarray, windows: af.Windows) -> float:
    """Return the share of recordings whose class has the highest product of the probabilities of
    its windows."""
    _, first, of = np.unique(windows.recording, return_index=True, return_inverse=True)
    total = np.zeros((len(first), probabilities.shape[1]))
    np.add.at(total, of, np.log(np.maximum(probabilities, 1e-30)))
    return float((total.argmax(axis=1) == windows.y[first]).mean())


def rate(model: af.TactileTransformer) -> float:
    return 2e-4 if model.init == "glorot" else 1e-4


def base(folder: Path, parts: Parts, layout: SensorLayout, seed: int, args: argparse.Namespace):
    """Return the fault-free network, trained unless it was before."""
    if (folder / "manifest.json").exists():
        return af.load_model(folder)
    quick = {"padding": "valid", "init": "glorot"} if args.recordings is None else {}
    model = af.TactileTransformer(layout, int(parts[0].y.max()) + 1, seed=seed, **quick)
    af.train(
        model,
        *parts[:2],
        epochs=args.epochs,
        patience=None,
        learning_rate=rate(model),
        seed=seed,
        repairable=args.repairable,
        progress=False,
    )
    af.save_model(folder, model)
    return model


def measure(args: argparse.Namespace) -> list[dict]:
    if args.recordings is None:
        recordings = af.simulate(n_per_class=args.grasps)
    else:
        recordings = af.load([args.recordings]).recordings
    windows = af.make_windows(recordings.frames, recordings.labels, recordings.layout)
    args.out.mkdir(parents=True, exist_ok=True)
    results = args.out / "results.jsonl"
    rows = (
        [json.loads(line) for line in results.read_text().splitlines()] if results.exists() else []
    )
    done = {(row["seed"], row["faults"], row["method"]) for row in rows}
    for seed in args.seeds:
        parts = af.split(windows, seed=seed)
        repairs = Repairs(
            base(args.out / f"base{seed}", parts, recordings.layout, seed, args),
            parts,
            seed,
            args.scratch_epochs,
        )
        sets = cases(recordings.layout, seed, args.recordings is None)
        if args.cases is not None:
            sets = dict(list(sets.items())[: args.cases])
        for name, faults in {"none": FaultSet((), recordings.layout.n_cells), **sets}.items():
            for method in ("fill", "head") if name == "none" else args.only or repairs.methods:
                if (seed, name, method) in done:
                    continue
                predict, seconds = repairs.methods[method](faults)
                row = {"seed": seed, "faults": name, "k": len(faults), "method": method}
                answers = predict(repairs.test.x)
                if answers.ndim == 2:
                    answers, row["grasps"] = (
                        answers.argmax(axis=1),
                        whole_grasps(answers, repairs.test),
                    )
                accuracy = float((answers == repairs.test.y).mean())
                rows.append({**row, "accuracy": accuracy, "seconds": seconds})
                with results.open("a") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
                print(
                    f"seed {seed}, {name} ({len(faults)}), {method}: {accuracy:.3f} in"
                    f" {seconds:.2f} s",
                    flush=True,
                )
    return rows


def table(rows: list[dict]) -> dict[tuple[str, str], tuple[float, float, float, int]]:
    """Print, and return mean, spread, seconds and seeds for each method and fault set."""
    groups = defaultdict(list)
    for row in rows:
        groups[row["method"], row["faults"]].append((row["accuracy"], row["seconds"]))
    summed = {}
    for key, results in groups.items():
        accuracy, seconds = np.transpose(results)
        summed[key] = (
            float(accuracy.mean()),
            float(accuracy.std()),
            float(np.median(seconds)),
            len(results),
        )
    names = list(dict.fromkeys(row["faults"] for row in rows if row["faults"] != "none"))
    print()
    for method in ("fill", "head"):
        if free := summed.get((method, "none")):
            print(f"fault-free, {method}: {free[0]:.3f} +- {free[1]:.3f} over {free[3]} seeds")
    for name in dict.fromkeys(row["faults"] for row in rows):
        whole = [
            row["grasps"]
            for row in rows
            if row["faults"] == name and row["method"] == "head" and "grasps" in row
        ]
        if whole:
            print(f"whole grasps, head, {name}: {np.mean(whole):.3f} +- {np.std(whole):.3f}")
    print(f"{'':24s}" + "".join(f"{name:>22s}" for name in names) + "     seconds")
    for method in dict.fromkeys(method for method, name in summed if name != "none"):
        cells = [summed.get((method, name)) for name in names]
        text = "".join(
            f"{c[0]:12.3f} +- {c[1]:.3f} ({c[3]})" if c else f"{'-':>22s}" for c in cells
        )
        print(f"{method:24s}{text}{np.median([c[2] for c in cells if c]):12.2f}")
    return summed


def picture(summed: dict, path: Path) -> None:
    """Draw accuracy against seconds, one panel a fault set."""
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(name for _, name in summed if name != "none"))
    figure = Figure(figsize=(3.4 * len(names), 4.2), layout="constrained")
    for ax, name in zip(
        np.atleast_1d(figure.subplots(1, len(names), sharey=True)), names, strict=True
    ):
        for i, method in enumerate(dict.fromkeys(m for m, _ in summed)):
            if (method, name) in summed:
                mean, spread, seconds, _ = summed[method, name]
                ours = method in ("fill", "head", "auto", "finetune")
                ax.errorbar(
                    max(seconds, 1e-3),
                    mean,
                    spread,
                    fmt="*" if ours else "o",
                    ms=12 if ours else 6,
                    color=f"C{i % 10}",
                    label=method,
                    mfc="none" if i >= 10 else None,
                )
        if ("fill", "none") in summed:
            ax.axhline(summed["fill", "none"][0], color="0.7", lw=1)
        ax.set(xscale="log", title=name, xlabel="seconds to repair")
    figure.axes[0].set_ylabel("test accuracy (grey: fault-free)")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=7, frameon=False)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="?", help="labelled recordings of a healthy array")
    parser.add_argument(
        "--out", type=Path, default=Path("adaptation_figures"), help="where results go"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--grasps", type=int, default=None, help="simulated grasps of each class")
    parser.add_argument("--epochs", type=int, default=None, help="of the fault-free network")
    parser.add_argument("--scratch-epochs", type=int, default=None, help="of training anew")
    parser.add_argument(
        "--repairable", action="store_true", help="train a base that is made to be repaired"
    )
    parser.add_argument("--only", nargs="+", help="methods")
    parser.add_argument("--cases", type=int, help="only the first fault sets")
    args = parser.parse_args()
    if quick := args.recordings is None and args.grasps is None:
        args.cases = args.cases or 1
        args.grasps = 8
    args.epochs = args.epochs or (2 if quick else 20)
    args.scratch_epochs = args.scratch_epochs or args.epochs
    args.only = args.only or (
        ["full scale", "fill", "head", "scratch", "ExtraTrees retrained"] if quick else None
    )
    picture(table(measure(args)), args.out / "accuracy_seconds.png")
    print(f"picture: {args.out / 'accuracy_seconds.png'}")


if __name__ == "__main__":
    main()
