"""How the evidence of single pieces adds up over a log.

Either side errs in a share e of the units (contamination, Huber 1964): with r the sum of the log
ratios of a unit, it counts for

    log ((1 - e) exp(r) + e) / ((1 - e) + e exp(r))

and so for no more than log(1/e). e is what healthy cells of the reference show, cross-fitted, and
more in a unit in which many cells are odd: then the whole array does what the reference never saw.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from diagnostics.model.observed import Observed
from diagnostics.model.record import Array, Cells, Mask

USUAL = 0.01  # share of the units in which a healthy cell is odd, before the reference tells
_SURE = 30.0  # cells that this share is worth
CERTAIN = 6.0  # evidence that what is healthy does not reach
_SAFETY = 1.5
_RARELY = 0.001
_OFTEN = 0.3
_MOST = 40.0  # log ratio whose exponential is taken
_FAILS = 0.05  # of the units, P(a fault that comes and goes comes)
_RECOVERS = 0.15
_FREEDOM = 3.0  # evidence that a fault that comes and goes gains by its freedom


@dataclass(frozen=True)
class Units:
    """The units of a log.

    Attributes:
        begins: int ``[units]``, first piece of each.
        of_piece: int ``[n]``, unit of each piece.
        odd: ``[units, D]``, P(a healthy cell is odd).
        opens: bool ``[units]``, whether a recording begins with it.
        goes: evidence that a fault has gone, with which it is none.
    """

    begins: Cells
    of_piece: Cells
    odd: Array
    opens: Mask
    goes: float = np.inf

    @classmethod
    def of(cls, observed: Observed, odd: Array) -> Units:
        """Return the units of a log; ``odd``: ``[D]``, share in which each healthy cell is odd."""
        record = observed.log.record
        known = observed.known
        strange = (observed.odd & known).sum(axis=1)
        share = (strange + _SURE * USUAL) / (known.sum() + _SURE)
        here = np.clip(share[:, None] / USUAL * odd, _RARELY, _OFTEN)
        return cls(record.units, record.of_unit, here, record.first[record.units])

    def of_units(self, ratio: Array) -> Array:
        """Return the evidence of each unit ``[units, D]`` of log ratios ``[n, D]``."""
        return bounded(np.add.reduceat(ratio, self.begins, axis=0), self.odd)


def bounded(ratio: Array, odd: Array) -> Array:
    """Return log ratios where either side errs in a share ``odd`` of the cases."""
    like = np.exp(np.clip(ratio, -_MOST, _MOST))
    found: Array = np.log(((1 - odd) * like + odd) / (1 - odd + odd * like))
    return found


def within_limit(evidence: Array, highest: Array, longer: float) -> Array:
    """Return evidence so that what a healthy cell, or line, reaches stays below certainty, in a log
    that is so many times as long as those in which it did."""
    most = _SAFETY * max(1.0, longer) * highest
    found: Array = evidence * np.where(evidence > 0, CERTAIN / np.maximum(CERTAIN, most), 1)
    return found


def throughout(ratio: Array, units: Units) -> Array:
    """Return the evidence ``[D]`` of a fault in all pieces."""
    of_units = units.of_units(ratio)
    return _unless_gone(of_units.sum(axis=0), of_units, units.goes)


def since_middle(ratio: Array, units: Units) -> Array:
    """Return the evidence ``[D]`` of a fault in the later half of a log."""
    found: Array = units.of_units(ratio)[len(units.begins) // 2 :].sum(axis=0)
    return found


def _since_each(ratio: Array, units: Units) -> Array:
    """Return the evidence ``[n, D]`` of a fault from each piece on."""
    sums = _from_here(ratio)
    ends = np.append(units.begins[1:], len(ratio))
    behind = np.concatenate([sums, np.zeros((1, ratio.shape[1]))])[ends]
    rest_of_unit = sums - behind[units.of_piece]
    whole = units.of_units(ratio)
    later = _from_here(whole) - whole
    found: Array = bounded(rest_of_unit, units.odd[units.of_piece]) + later[units.of_piece]
    return found


def _from_here(values: Array) -> Array:
    found: Array = np.flip(np.cumsum(np.flip(values, 0), 0), 0)
    return found


def for_good(ratio: Array, units: Units) -> Array:
    """Return the evidence ``[D]`` of a fault from some piece on: half of them begin with the first
    one, the others anywhere."""
    since = _since_each(ratio, units)
    at_once: Array = since[0]
    if len(since) == 1:
        return at_once
    most = since.max(axis=0)
    later = np.log(np.exp(since[1:] - most).mean(axis=0) + np.finfo(float).tiny) + most
    found: Array = np.logaddexp(at_once, later) - np.log(2)
    return _unless_gone(found, units.of_units(ratio), units.goes)


def _unless_gone(evidence: Array, of_units: Array, goes: float) -> Array:
    """Return the evidence ``[D]`` of a fault that lasts: no more than what the log says since the
    likeliest end of it, where that denies it."""
    from_here = _from_here(of_units)
    begins = from_here.argmax(axis=0)
    sums = np.cumsum(of_units, axis=0)
    shown = np.arange(len(sums))[:, None] >= begins
    since = sums[-1] - np.where(shown, sums, -np.inf).max(axis=0)
    found: Array = np.where(since < -goes, np.minimum(evidence, since), evidence)
    return found


def since(ratio: Array, units: Units) -> Cells:
    """Return the likeliest first piece of a fault that lasts, int ``[D]``."""
    each = _since_each(ratio, units)
    each[0] += np.log(max(1, len(each) - 1))
    found: Cells = each.argmax(axis=0)
    return found


def now_and_then(ratio: Array, units: Units) -> Array:
    """Return the evidence ``[D]`` of a fault that comes and goes. One that was there once and has
    gone is none."""
    # a healthy cell that is odd now and then is what this fault looks like
    doubted = replace(units, odd=np.maximum(units.odd, USUAL))
    of_units = doubted.of_units(ratio)
    total: Array = coming_and_going(of_units, units.opens).sum(axis=0)
    once = of_units.cumsum(axis=0).max(axis=0) - np.log(len(of_units))
    told_once = once > total - _FREEDOM
    return np.where(told_once, _unless_gone(total, of_units, units.goes), total)


def coming_and_going(
    ratio: Array, opens: Mask, fails: float = _FAILS, recovers: float = _RECOVERS
) -> Array:
    """Return the evidence of each step ``[n, D]`` of a fault that comes and goes: a two-state
    Markov chain (forward algorithm, Rabiner 1989).

    Args:
        ratio: log ratio faulty : healthy of each step, ``[n, D]``.
        opens: bool ``[n]``, steps with which the chain begins anew.
        fails, recovers: probability a step.
    """
    likelihood = np.exp(ratio)
    usual = fails / (fails + recovers)
    gone = np.full(ratio.shape[1], usual)
    found: Array = np.zeros(ratio.shape, np.float32)
    for i, step in enumerate(likelihood):
        gone = gone * (1 - recovers) + (1 - gone) * fails
        if opens[i]:
            gone = np.full_like(gone, usual)
        z = 1 - gone + gone * step
        found[i] = np.log(z)
        gone = gone * step / z
    return found
