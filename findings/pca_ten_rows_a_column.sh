#!/bin/sh
# Guess: PCA of a longer recording of the same float32 sensor is at least as good as of a short
#   one.
# Reality: from 10 frames a cell on, the solver that scikit-learn chooses by itself goes through
#   the covariance matrix, which squares the condition number, in the precision of the input. Where
#   all cells share a large load, what they do besides it falls below float32: with 639 frames of
#   64 cells the variances are right, with 640 frames half of them are exactly 0, and
#   whitened readings are wrong by a factor of a million. No warning. float64, or
#   svd_solver="full", is right at any length. (Expected of each whitened component: a standard
#   deviation of 1.)
# Packages: scikit-learn==1.9.1, numpy==2.4.6, scipy==1.17.1
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet scikit-learn==1.9.1 numpy==2.4.6 scipy==1.17.1
"$work/venv/bin/python" - <<'PY'
import sys
from importlib.metadata import version

import numpy as np
from sklearn.decomposition import PCA

for name in ("scikit-learn", "numpy", "scipy"):
    print(name, version(name))
CELLS = 64
NOISE = 0.3  # counts; the load is some thousand
generator = np.random.default_rng(0)


def whitened(n_frames, precision, **options):
    """Return the standard deviations of the whitened components, and how many variances are 0."""
    load = generator.gamma(1, 1000, (n_frames, 1)) * generator.uniform(0.9, 1.1, CELLS)
    readings = load + 500 + generator.normal(0, NOISE, (n_frames, CELLS))
    pca = PCA(whiten=True, **options)
    spread = pca.fit_transform(readings.astype(precision)).std(axis=0)
    return float(spread.min()), float(spread.max()), int((pca.explained_variance_ == 0).sum())


rows = {
    "639 frames, float32": whitened(639, "f4"),
    "640 frames, float32": whitened(640, "f4"),
    "640 frames, float64": whitened(640, "f8"),
    "640 frames, float32, full": whitened(640, "f4", svd_solver="full"),
}
for name, (least, most, zeros) in rows.items():
    print(f"{name}: whitened {least:.3g} to {most:.3g}, {zeros} of {CELLS} variances are 0")
_, most, zeros = rows.pop("640 frames, float32")
right = all(0.9 < least and most < 1.1 and not zeros for least, most, zeros in rows.values())
if not right or most < 1e4 or zeros < 10:
    sys.exit("changed: expected only the second row to be wrong, by more than 10,000")
PY
