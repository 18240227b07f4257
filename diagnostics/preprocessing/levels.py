"""Levels and priors that several modules share: of full scale, of cells, of log likelihood ratios,
of prevalences."""

from __future__ import annotations

# Of full scale.
LIGHT = 0.05  # a lighter load may be drift of the baseline
SLIGHT = 0.02  # readings that differ by less agree

# Of cells, frames or recordings.
LOW = 0.05  # quantile of all readings of a cell: its baseline
# quantile over cells or frames: more are unloaded than this, and fewer are open
LEAST_LOADED = 0.25
MAJORITY = 0.5  # what most do is usual
RARE = 0.001  # what is ignored
FEWEST = 8  # recordings, or cells, from which differences between them can be estimated
MARGIN = 1.5  # times a limit that healthy cells, or noise, reach: clearly above it

# Log likelihood ratios fault : healthy.
TESTED = 0.5  # from which on a cell was tested
SUSPICIOUS = 3.0  # from which on a cell is no predictor, and supports a broken wire
CERTAIN_RATIO = 12.0  # of what only a fault explains

# Priors.
EXPECTED = 0.02  # share of cells that are faulty from the start
EXPECTED_LATE = 0.005  # share of cells that fail in the log, and of broken wires
EXPECTED_CELLS = 35.0  # pseudo-count of either share of cells
DOUBTED = 0.1  # P(faulty) from which on a cell that moved does not count as alive
P_MIN = 1e-4  # lower limit of what chance explains, in one event or one test: models err
# share of broken cells that stick at any value; the others stick to either rail equally often
ANYWHERE = 0.2
