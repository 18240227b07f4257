#!/bin/sh
# Guess: a missing reading (NaN) in an HDF5 data set with the lossy scale-offset filter is at worst
#   lost, and how it is lost depends on nothing else.
# Reality: it depends on where in its chunk it stands, and on the width of the numbers.
#   float32, anywhere but first in its chunk: it comes back as the least reading of the chunk,
#     which looks like a cell at rest.
#   float32, first in its chunk: writing succeeds, and the chunk can never be read again: its other
#     readings are lost, too. The error comes on reading, perhaps months later.
#   float64, first in its chunk: the chunk is stored whole and exact, and nothing is lost.
# Packages: h5py==3.16.0, numpy==2.4.6
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet h5py==3.16.0 numpy==2.4.6
cd "$work"
"$work/venv/bin/python" - <<'PY'
import sys

import h5py
import numpy as np

print("h5py", h5py.__version__, "HDF5", h5py.version.hdf5_version)
readings = 1 + np.random.default_rng(0).random((16, 4))


def read_again(precision, frame, cell):
    """Return what a missing reading and the others' largest error come back as, or the error."""
    stored = readings.astype(precision)
    stored[frame, cell] = np.nan
    with h5py.File("log.h5", "w") as file:
        file.create_dataset("touch", data=stored, chunks=stored.shape, scaleoffset=3)
    try:
        with h5py.File("log.h5") as file:
            read = file["touch"][:]
    except OSError as error:
        return f"not readable: {error}", None
    return float(read[frame, cell]), float(np.nanmax(np.abs(read - stored)))


rows = {}
for precision in ("float32", "float64"):
    for place, where in (("first", (0, 0)), ("later", (8, 2))):
        rows[precision, place] = read_again(precision, *where)
        print(precision, f"missing reading {place} in the chunk:", rows[precision, place])
least = readings.min()
later = [rows[precision, "later"] for precision in ("float32", "float64")]
looks_like_rest = all(abs(missing - least) < 0.002 and error < 0.001 for missing, error in later)
lost = rows["float32", "first"][1] is None
kept = np.isnan(rows["float64", "first"][0]) and rows["float64", "first"][1] == 0
if not (looks_like_rest and lost and kept):
    sys.exit("changed: expected lost, least of the chunk, kept, least of the chunk")
PY
