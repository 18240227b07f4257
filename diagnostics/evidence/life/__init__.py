"""Proof of life: do the readings of a cell depend on those of the others as a healthy cell's do?

Predicts the mean root load of each cell in each piece of the log from the other cells (conditional
mean with a Ledoit-Wolf covariance) and compares, over a table P(observed level | predicted level)
of healthy cells,

    r_u = sum over the pieces t of unit u of
              log P(level_t | fault) - log P(level_t | predicted level_t, healthy)

with four faults: the level is independent of the others (its own frequencies in the log, leaving
the piece out); it is that of the prediction some pieces ago (late); it is the healthy one up to its
highest reading (clamped); it repeats the reading of a cell beside it, or their mean (copy). A fault
that comes and goes reads as at rest in the units of a two-state Markov chain (forward algorithm);
one that was there once and has gone is none. A contact that opens under load reads as at rest where
the predicted level exceeds one of four limits, and as a healthy cell below. A unit has two pieces,
16 frames. Either side errs in a share e of the units (contamination, Huber 1964), k units of the
same loads count as one, and of what remains a share c is independent (variance of sums of
successive units of healthy cells):

    evidence = sum over u of  w_u log ((1 - e) exp(r_u) + e) / ((1 - e) + e exp(r_u)),
    w_u = c / k_u

so that no unit counts for more than log(1/e). The table is tilted to the frequencies of the levels
in the log (iterative proportional fitting, Deming and Stephan 1940): a contact that hardly changes
contradicts nobody. The factor on the evidence of each fault keeps healthy cells of held-out
reference recordings, with dead ones beside them, below the threshold, for a log of any length.
Cells that are refuted are replaced by what the others say, the worst of all first, until nothing
changes.

Cells of a wire that fails now and then predict each other: wires are tested as such
(:mod:`diagnostics.evidence.life.wires`).

Not detected: faults that leave loads nearly as predicted (a peak that is kept), rare
ones, the mean of the cells beside one where some of these are dead, and what moves where the
reference or the log has no contact.
"""

from __future__ import annotations

from diagnostics.evidence.life.fitting import fit_life
from diagnostics.evidence.life.healthy_table import FAULTS
from diagnostics.evidence.life.levels_in_log import LifeLog
from diagnostics.evidence.life.life_model import LifeModel
from diagnostics.evidence.life.proof import Life, LifeTest
from diagnostics.evidence.life.record import PIECE, LifeRecord
from diagnostics.evidence.life.ways_to_fail import EvidenceOfLog

__all__ = [
    "FAULTS",
    "PIECE",
    "EvidenceOfLog",
    "Life",
    "LifeLog",
    "LifeModel",
    "LifeRecord",
    "LifeTest",
    "fit_life",
]
