"""Total force and its centre from a tactile array, repaired after cells die:
python examples/force.py"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

import adaptfault as af
from diagnostics import Fault, FaultKind, FaultSet, SensorLayout, inject

VALUES = ("force", "row", "column")
TOUCHED = 1.0  # N; below that the centre is taken as the middle of a pad


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--grasps", type=int, default=60, help="of each class (default 60)")
    parser.add_argument("--epochs", type=int, default=10, help="of the training (default 10)")
    parser.add_argument("--dead", type=int, default=15, help="dead cells (default 15)")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    layout = SensorLayout(2, 6, 5)
    grasps = af.simulate(
        args.grasps, layout, n_frames=60, seed=args.seed, classes=("softer", "harder")
    )
    targets = [force_and_centre(frames, layout) for frames in grasps.frames]
    training, validation, test = af.split(af.make_windows(grasps.frames, targets, layout))

    model = af.TactileTransformer(layout, len(VALUES), seed=args.seed)
    units = af.ValueUnits.of(training)
    af.train(
        model,
        units.standardised(training),
        units.standardised(validation),
        epochs=args.epochs,
        learning_rate=1e-3,
        progress=False,
    )
    units.fold(model)

    dead = np.random.default_rng(args.seed).permutation(layout.n_cells)[: args.dead]
    cells = tuple(sorted(dead.tolist()))
    half = len(cells) // 2
    faults = [Fault(FaultKind.OPEN, cells[:half]), Fault(FaultKind.SHORT, cells[half:])]
    broken = af.make_windows([inject(r, faults, layout) for r in grasps.frames], targets, layout)
    broken = broken.select(np.isin(broken.recording, test.recording))

    adapter = af.Adapter(model, training, validation)
    repaired = adapter.adapt(FaultSet(cells, layout.n_cells))
    say = {"before the faults": (adapter.healthy, test), "with the faults": (model, broken)}
    say["after the repair"] = (repaired, broken)
    print(f"{len(grasps)} grasps, {layout}; {len(cells)} cells dead")
    for when, (what, windows) in say.items():
        print(f"{when + ':':18} {af.evaluate(what, windows).named(VALUES)}")


def force_and_centre(frames: NDArray[np.float32], layout: SensorLayout) -> NDArray[np.float64]:
    """Return the force of each frame in N and its centre in rows and columns, ``[T, 3]``."""
    pads = frames.reshape(-1, *layout.shape).astype(np.float64)
    total = pads.sum(axis=(1, 2, 3))
    rows, columns = (np.arange(n) for n in layout.shape[1:])
    loaded = np.maximum(total, TOUCHED)
    row = pads.sum(axis=(1, 3)) @ rows / loaded
    column = pads.sum(axis=(1, 2)) @ columns / loaded
    touched = total > TOUCHED
    return np.stack(
        [
            total,
            np.where(touched, row, rows.mean()),
            np.where(touched, column, columns.mean()),
        ],
        axis=1,
    )


if __name__ == "__main__":
    main()
