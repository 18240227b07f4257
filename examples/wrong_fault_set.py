"""What a wrong F costs, a missed cell or a false one: python examples/wrong_fault_set.py
[RECORDINGS [MODEL]]

A tenth of the cells is faulty. The model is adapted to F with some of them forgotten, which then
read 0 or full scale, and to F with healthy cells added. From the accuracy lost per cell follows the
probability above which a doubtful cell is better dropped: cost of a false one / (cost of a false
one + cost of a missed one). Without RECORDINGS simulated grasps must do; MODEL is a folder written
by ``adaptfault train`` or by ``save_model``.
"""

import argparse

import numpy as np

import adaptfault as af
from diagnostics import FaultSet


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="?")
    parser.add_argument("model", nargs="?")
    parser.add_argument("--method", default="fill", choices=("fill", "head"))
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--wrong", type=int, default=5, help="cells that are wrong at once")
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="of the split, as the model was trained on, and the draws",
    )
    args = parser.parse_args()

    recordings = (
        af.load([args.recordings]).recordings if args.recordings else af.simulate(n_per_class=8)
    )
    layout = recordings.layout
    train, validation, test = af.split(
        af.make_windows(recordings.frames, recordings.labels, layout), seed=args.seed
    )
    if args.model:
        model = af.load_model(args.model)
    else:
        model = af.TactileTransformer(
            layout, len(recordings.class_names), padding="valid", init="glorot"
        )
        af.train(model, train, validation, epochs=3, learning_rate=5e-4, progress=False)
    adapter = af.Adapter(model, train, validation)
    present = np.flatnonzero(layout.present)
    rng = np.random.default_rng(args.seed)

    def right(faults: np.ndarray, x: np.ndarray) -> float:
        adapted = adapter.adapt(
            FaultSet(tuple(faults.tolist()), layout.n_cells), method=args.method
        )
        return float((adapted.predict(x) == test.y).mean())

    lost: dict[str, list[float]] = {"missed, at full scale": [], "missed, at 0": [], "false": []}
    for _ in range(args.draws):
        drawn = rng.permutation(present)
        n = max(args.wrong + 1, len(present) // 10)
        extra = drawn[n : n + args.wrong]
        wrong = drawn[: args.wrong]
        faults = drawn[:n]
        exact = right(faults, test.x)
        for name, value in (("missed, at full scale", 1.0), ("missed, at 0", 0.0)):
            x = test.x.copy()
            x[..., wrong] = value
            lost[name].append((exact - right(np.setdiff1d(faults, wrong), x)) / args.wrong)
        lost["false"].append((exact - right(np.union1d(faults, extra), test.x)) / args.wrong)
    print(
        f"accuracy lost per wrong cell ({args.wrong} at once, {args.draws} draws, method"
        f" {args.method}):"
    )
    for name, costs in lost.items():
        print(f"  {name:22s} {np.mean(costs):+.4f} +- {np.std(costs) / np.sqrt(len(costs)):.4f}")
    false = max(0.0, float(np.mean(lost.pop("false"))))
    for name, costs in lost.items():
        missed = max(1e-6, float(np.mean(costs)))
        cut = false / (false + missed)
        print(
            f"a cell that may be {name.removeprefix('missed, ')}: drop it from P(faulty) ="
            f" {cut:.3f} on"
        )


if __name__ == "__main__":
    main()
