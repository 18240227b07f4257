"""Fault-tolerant scikit-learn estimators on tactile windows: python examples/sklearn_pipeline.py"""

import numpy as np
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from adaptfault import CellImputer, FaultTolerantClassifier, make_windows, simulate, split
from diagnostics import FaultSet, SensorLayout

layout = SensorLayout(2, 6, 5)
grasps = simulate(30, layout, n_frames=60, seed=1, classes=("nothing", "softer", "harder"))
parts = split(make_windows(grasps.frames, grasps.labels, layout), validation=0)
# mean and maximum of each cell
(x, y, groups), (new, truth, _) = (
    (np.concatenate([w.x.mean(1), w.x.max(1)], axis=1), w.y, w.recording)
    for w in (parts[0], parts[2])
)
faults = FaultSet((3, 8, 13, 18, 23, 33, 38), layout.n_cells)
broken = new.copy()
broken[:, np.tile(faults.mask, 2)] = 1.0  # shorted cells read full scale

pipeline = make_pipeline(CellImputer(faults), StandardScaler(), SVC()).fit(x, y)
print(f"SVC behind CellImputer: {pipeline.score(broken, truth):.3f}")
for estimator in (
    ExtraTreesClassifier(100, random_state=0),
    make_pipeline(StandardScaler(), SVC()),
):
    tolerant = FaultTolerantClassifier(estimator).fit(x, y, groups=groups)
    healthy = tolerant.score(new, truth)
    harmed = tolerant.estimator_.score(broken, truth)
    repaired = tolerant.set_faults(faults).score(broken, truth)
    name = type(estimator).__name__
    print(
        f"{name}: fault-free {healthy:.3f}, broken {harmed:.3f}, repaired {repaired:.3f}"
        f" ({tolerant.choice_})"
    )
