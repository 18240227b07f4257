"""When a cell failed: the recordings in which it holds one value while the cells beside it move.

Each cell has a symbol a recording: it moved, it held a value at its rest, or elsewhere; with or
without the dither that others have. A healthy cell holds a value often or rarely, depending on how
far the cells beside it move in the same recording. This table is learned from the recordings
themselves, without what is suspect in them, and each cell may deviate from it
(Dirichlet-multinomial, its pseudo-count by maximum likelihood). A dead cell holds a value whatever
the others do. Which recordings are a cell's healthy ones is the likeliest path of a two-state
chain, in time order or class by class, or a set of single recordings. The evidence is

    share * (log P(symbols | dead in S) - log P(symbols | healthy)) + log prior of S

with the share of the recordings that count as independent of each other. That a class does not
touch a cell explains that it rests in all recordings of this class. A line is a cell one level up:
it holds a value where all its cells do, and the cells beside it are those next to it.

Not detected: cells that hold a value in all recordings, or where hardly any other cell moves, and
faults within a recording.
"""

from diagnostics.when.filling import filled
from diagnostics.when.held import Held, find_held
from diagnostics.when.own_reference import (
    OWN_REFERENCE,
    known_classes,
    own_reference,
    reads_enough,
    shows_contacts,
)
from diagnostics.when.spans import Spans

__all__ = [
    "OWN_REFERENCE",
    "Held",
    "Spans",
    "filled",
    "find_held",
    "known_classes",
    "own_reference",
    "reads_enough",
    "shows_contacts",
]
