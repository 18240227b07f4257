"""A scan in which the read-out tests itself: which crossings and lines are broken, untouched.

The read-out measures each crossing several times: with its row let go (level 0), with the row at a
low share d of the drive, and with the full drive (level 1). With m the means of what it reads, and
e their standard errors::

    residue   z = m_0                        what comes without the drive
    response  r = (m_1 - m_d) / (1 - d)      (m_d - b) / d where the full drive saturates
    ratio       = (m_d - b) / (d r)          1: it answers in proportion
                  b: 0 or z, what is nearer: a row that is driven has no residue by floating
    evidence    = log P(r < 5 e | open) - log P(r < 5 e | healthy),  at most 12, of silent ones
                  healthy: log r is normal around the median u of those that answer, r > 5 e, with
                  the deviation s of them, or of their wider tail: Phi((log 5 e - log u) / s)

A silent crossing is open from an evidence of 9.2 on, or where its line is. A healthy crossing
conducts a little also where nobody touches it; a scan that sees less than half of them conduct
tells of shorts only. Where some healthy ones do not, a scan of the healthy array leaves them out
(:meth:`ReadOut.since`). A crossing that saturates at the low level, and not without the drive, is
shorted: at the low level the full scale of a cell reads half of the converter's range at most. One
that saturates at all levels is on a column that is held at the supply; what has no response of its
own but a residue is on one, too. A line on ground answers faintly: less than 3 % of the usual
response in the median of its crossings. The line cover (:mod:`diagnostics.decision.line_cover`)
names lines. Shorted crossings join others in parallel, and through the part of a line that is cut
off: these tell nothing.

Not detected: what leaves a crossing conducting, as a worn, late or clamped cell, or two lines that
are joined; a line of which all crossings are shorted or open only under load. A line that is cut
and one that lies on ground look alike. Where lines that are not selected float, current through
other crossings hides open ones: unless the scan states that lines are held, a crossing that answers
no more than others may bring it (:mod:`diagnostics.evidence.crossings`) is neither ALIVE nor open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, logit

from diagnostics.decision.line_cover import Cause, solve
from diagnostics.decision.result import Diagnosis
from diagnostics.evidence.crossings import (
    CERTAINLY,
    REPEATS,
    STANDS,
    TOP,
    Answer,
    Healthy,
    Level,
    in_parallel,
    on_faint_lines,
    through_others,
)
from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import CERTAIN_RATIO, EXPECTED, MAJORITY

_OPEN = 9.2  # evidence of an open crossing: one healthy one in 10,000 is as silent
_CLEARLY = 4.0  # times the least answer
_RESIDUE = 0.02  # of the usual response: a residue of a line, not of the converter
_LOADED = 10.0  # times the usual response: as under load
_MAY_FLOAT = (
    "{} crossings answer no more than open ones may where lines float that are not selected: they"
    " stay untested; if the lines are held, state --lines-held, or Scan(..., holds_lines=True)"
)

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Scan:
    """What the read-out measured in a scan, frame by frame.

    Attributes:
        levels: float ``[n]``, share of the drive in each frame, 0 to 1; 0: lines are let go.
        readings: float ``[n, D]``, shares of the converter's range, 0 to 1; NaN: missing.
        holds_lines: whether the read-out holds the lines that it neither drives nor reads, at
            ground or as its virtual ground does; None: it is not stated.

    Raises:
        ValueError: shapes or numbers that no scan has.
    """

    levels: Floats
    readings: Floats
    holds_lines: bool | None = None

    def __post_init__(self) -> None:
        levels = np.asarray(self.levels, np.float64)
        readings = np.asarray(self.readings, np.float64)
        if levels.ndim != 1 or readings.ndim != 2 or len(levels) != len(readings):
            raise ValueError(
                "a scan has levels [n] and readings [n, D]; got"
                f" {list(levels.shape)} and {list(readings.shape)}"
            )
        if not ((levels >= 0) & (levels <= 1)).all():
            raise ValueError(
                f"a scan drives lines at 0 to 1 of the full drive; got levels {levels.min():g} to"
                f" {levels.max():g}"
            )
        object.__setattr__(self, "levels", levels)
        object.__setattr__(self, "readings", readings)

    @classmethod
    def of(cls, frames: Sequence[tuple[float, ArrayLike]]) -> Scan:
        """Return the scan of frames, (level, readings ``[D]``) each.

        Raises:
            ValueError: no frame, or frames of different lengths.
        """
        if not frames:
            raise ValueError("a scan of no frames: expected (level, readings [D]) each")
        readings = [np.asarray(one, np.float64).ravel() for _, one in frames]
        if len({len(one) for one in readings}) > 1:
            raise ValueError(
                f"the frames of a scan have {sorted({len(r) for r in readings})} cells"
            )
        return cls(np.array([level for level, _ in frames]), np.stack(readings))


@dataclass(frozen=True, eq=False)
class ReadOut:
    """What a scan says of each crossing, ``[D]``.

    Attributes:
        layout: the array.
        response, residue: float, shares of the converter's range; NaN: not measured.
        least: float, the response from which on a crossing answers.
        ratio: float, 1 where the crossing answers both drives in proportion; NaN: not measured.
        evidence: float, log likelihood ratio faulty : healthy; 0: none.
        open, short, held, alive: bool; ``open``: silent ones, certain or not, ``held``: on a line
            at the supply.
        under_load: number of crossings that conduct as under a load.
        incomplete: what the scan lacks, one sentence; "": nothing.
    """

    layout: SensorLayout
    response: Floats
    residue: Floats
    least: Floats
    ratio: Floats
    evidence: Floats
    open: Mask
    short: Mask
    held: Mask
    alive: Mask
    under_load: int = 0
    incomplete: str = ""

    @cached_property
    def broken(self) -> Mask:
        """The crossings of all faults, bool ``[D]``."""
        found = np.zeros(self.layout.n_cells, bool)
        found[[cell for fault in self.faults for cell in fault.cells]] = True
        return found

    @cached_property
    def faults(self) -> tuple[Fault, ...]:
        """One fault a cause: a line, or a crossing."""
        silent = self.open | self.held
        certain = silent & (self.evidence >= _OPEN)
        others = self.short | ((self.response > self.least) & ~silent)
        causes = list(solve(certain, silent, others, self.evidence, self.layout))
        shorted = [Cause(None, (c,), (c,), 1.0) for c in np.flatnonzero(self.short).tolist()]
        return tuple(self._fault(cause) for cause in [*causes, *shorted] if cause.proven)

    def _fault(self, cause: Cause) -> Fault:
        cells = list(cause.cells)
        held = bool(2 * self.held[cells].sum() >= len(cells))
        kind = FaultKind.SHORT if held or self.short[cells].all() else FaultKind.OPEN
        probability = float(expit(np.median(self.evidence[cells]) + logit(EXPECTED)))
        return Fault(
            kind,
            cells,
            line=cause.line,
            probability=cause.probability * probability,
            reason=_reason(kind, cause, held, self.layout),
            evidence=len(cause.seen),
        )

    def since(self, healthy: ReadOut) -> ReadOut:
        """Return what is new since a scan of the healthy array: a crossing that answered clearly
        then and is silent now is open; one that did not answer then is not tested.

        Raises:
            ValueError: a scan of another array.
        """
        if healthy.layout.shape != self.layout.shape:
            raise ValueError(f"a scan of {self.layout}, but a healthy one of {healthy.layout}")
        known = healthy.alive
        clear = known & (np.nan_to_num(healthy.response) > _CLEARLY * self.least)
        evidence = np.where(clear & self.open, CERTAIN_RATIO, self.evidence)
        return replace(
            self,
            evidence=np.where(known, evidence, 0.0),
            open=self.open & clear,
            short=self.short & known,
            held=self.held & known,
            alive=self.alive & known,
        )

    @property
    def summary(self) -> str:
        """How many cells the scan tested, and what is wrong with it, in one line."""
        present = self.layout.is_cell
        tested = int((self.alive | self.broken)[present].sum())
        said = [f"{tested} of {int(present.sum())} cells tested"]
        if self.under_load:
            said.append(f"{self.under_load} crossings conduct as under a load: scan untouched")
        return "; ".join([*said, *([self.incomplete] if self.incomplete else [])])

    def __str__(self) -> str:
        return "\n".join([*(fault.reason for fault in self.faults), self.summary])


def judge_scan(scan: Scan, layout: SensorLayout) -> ReadOut:
    """Return what a scan says of each crossing of an array.

    A scan that was interrupted, with fewer than 4 readings at one of three levels, tells nothing;
    ``incomplete`` says what is missing.

    Raises:
        ValueError: a scan of another array.
        TypeError: something else than a scan.
    """
    if not isinstance(scan, Scan):
        raise TypeError(f"expected Scan(levels [n], readings [n, D]), got {type(scan).__name__}")
    cells = layout.n_cells
    if scan.readings.shape[1] != cells:
        raise ValueError(
            f"a scan of {scan.readings.shape[1]} cells, but the array has {cells} ({layout}):"
            " give the scan of this array"
        )
    low, missing = _low_level(scan)
    if missing:
        nothing = np.zeros(cells, bool)
        unknown = np.full(cells, np.nan)
        return ReadOut(
            layout,
            *(unknown,) * 4,
            np.zeros(cells),
            *(nothing,) * 4,
            incomplete=missing,
        )
    noise = _noise(scan)
    at = {level: Level.of(scan.readings[scan.levels == level], noise) for level in (0.0, low, 1.0)}
    return _judged(at[0.0], at[low], at[1.0], low, layout, scan.holds_lines)


def with_scan(diagnosis: Diagnosis, found: ReadOut) -> Diagnosis:
    """Return a diagnosis with what a scan of the same array says.

    Cells that the log did not test are ALIVE where they answer the scan. What the log says of a
    fault stays: a crossing may conduct and not feel.

    Raises:
        ValueError: a scan of another array.
    """
    if found.layout.shape != diagnosis.layout.shape:
        raise ValueError(f"a scan of {found.layout}, but a diagnosis of {diagnosis.layout}")
    faults = list(found.faults)
    told = {cell for fault in faults for cell in fault.cells}
    faults += [fault for fault in diagnosis.faults if not told.issuperset(fault.cells)]
    blamed = np.zeros(found.layout.n_cells, bool)
    probability = diagnosis.probability.copy()
    for fault in faults:
        cells = list(fault.cells)
        blamed[cells] = True
        probability[cells] = np.maximum(probability[cells], fault.probability or 0.0)
    alive = found.alive & ~blamed
    newly = alive & ~diagnosis.tested
    healthy = expit(found.evidence + logit(EXPECTED))
    probability = np.where(newly, np.minimum(probability, healthy), probability)
    evidence = {
        **diagnosis.evidence,
        "ratio": np.nan_to_num(found.ratio),
        "residue": np.nan_to_num(found.residue),
    }
    return replace(
        diagnosis,
        faults=tuple(sorted(faults, key=lambda fault: (-len(fault.cells), fault.cells))),
        probability=probability,
        tested=diagnosis.tested | alive | blamed,
        possible=tuple(one for one in diagnosis.possible if not alive[list(one.cells)].any()),
        evidence=evidence,
    )


def scanned(diagnosis: Diagnosis, scan: Scan | None) -> Diagnosis:
    """Return a diagnosis with what a scan says; None: there was none.

    Raises:
        ValueError: a scan of another array.
    """
    if scan is None:
        return diagnosis
    return with_scan(diagnosis, judge_scan(scan, diagnosis.layout))


def _low_level(scan: Scan) -> tuple[float, str]:
    """Return the low level of a scan, and what it lacks; "": nothing."""
    levels, count = np.unique(scan.levels, return_counts=True)
    count_at = dict(zip(levels.tolist(), count.tolist(), strict=True))
    between = [level for level in levels.tolist() if 0 < level < 1]
    low = max(between, key=lambda level: count_at[level], default=0.0)
    frames = {"0": count_at.get(0.0, 0), "low": count_at.get(low, 0) if between else 0}
    frames["1"] = count_at.get(1.0, 0)
    few = [f"{n} at level {name}" for name, n in frames.items() if n < REPEATS]
    if not few:
        return low, ""
    what = f"the scan is incomplete: {', '.join(few)}, expected {REPEATS} or more each"
    return low, f"{what}; it tells nothing, scan again"


def _noise(scan: Scan) -> float:
    """Return the standard deviation of a reading: of most crossings around their means, and no less
    than a step of the converter gives."""
    levels = np.unique(scan.levels)
    apart = [np.diff(scan.readings[scan.levels == level], axis=0) for level in levels]
    changes = np.abs(np.concatenate(apart))
    inside = np.concatenate([(scan.readings[scan.levels == level] < TOP)[1:] for level in levels])
    known = changes[np.isfinite(changes) & inside]
    steps = known[known > 0]
    if not len(steps):
        return 1e-6
    deviation = float(np.sqrt(np.mean(np.minimum(known, np.quantile(known, 0.99)) ** 2) / 2))
    return float(max(deviation, float(steps.min()) / np.sqrt(12)))


def _judged(
    zero: Level, low: Level, full: Level, share: float, layout: SensorLayout, held: bool | None
) -> ReadOut:
    """Return what three levels say.

    Args:
        zero, low, full: the levels.
        share: of the drive at the low one.
        layout: the array.
        held: whether lines that are not selected are held; None: not stated.
    """
    measured = np.isfinite(zero.mean) & np.isfinite(low.mean) & np.isfinite(full.mean)
    measured &= layout.is_cell
    everywhere = measured & (zero.mean >= TOP)
    short = measured & (low.mean >= TOP) & ~everywhere
    tells = measured & ~short & ~everywhere & ~in_parallel(short, layout)
    answer = Answer.of(zero, low, full, share)
    least = STANDS * answer.error
    answers = tells & (answer.response > least)
    silent = tells & (np.abs(answer.response) <= least)
    through = through_others(answer.response, least, tells, short, layout, held=held is True)
    direct = answers & (answer.response - least > CERTAINLY * through) & (held is not False)
    usual = 0.0
    faint = np.zeros_like(tells)
    evidence = np.where(direct, -CERTAIN_RATIO, 0.0)
    if answers.sum() >= MAJORITY * measured.sum() > 0:
        healthy = Healthy.of(answer.response[answers])
        usual = healthy.usual
        evidence[silent] = healthy.of_silence(least[silent])
        faint = on_faint_lines(answer.response, healthy, tells, layout)
    silent &= evidence > 0
    no_answer = silent | faint
    at_supply = no_answer & (zero.mean > STANDS * zero.error + _RESIDUE * usual)
    conducts = answers & answer.in_proportion & ~faint & (usual > 0)
    alive = conducts & direct
    doubted = 0 if held else int((conducts & ~alive).sum())
    certain = short | everywhere | faint
    return ReadOut(
        layout,
        np.where(measured, answer.response, np.nan),
        np.where(measured, zero.mean, np.nan),
        least,
        np.where(answers, answer.ratio, np.nan),
        np.where(certain, CERTAIN_RATIO, evidence),
        open=no_answer & ~at_supply,
        short=short,
        held=everywhere | at_supply,
        alive=alive,
        under_load=int((conducts & (answer.response > _LOADED * usual)).sum()),
        incomplete=_MAY_FLOAT.format(doubted) if doubted else "",
    )


def _reason(kind: FaultKind, cause: Cause, held: bool, layout: SensorLayout) -> str:
    """Return one sentence for the technician."""
    if cause.line is None:
        place = layout.place(cause.cells[0])
        if kind is FaultKind.OPEN:
            return f"{place} does not answer the scan: open; check the cell and its contacts"
        if held:
            return f"{place} does not answer the scan, at a residue: check its lines for a short"
        return f"{place} saturates the scan with nobody touching: shorted; check the crossing"
    where = f"{cause.line}, {len(cause.cells)} cells"
    if kind is FaultKind.OPEN:
        where += " beyond the break" if not cause.whole else ""
        return f"{where}: no answer to the scan: the line is cut, or on ground; check its wire"
    return f"{where}: a residue and no answer to the scan: on the supply; check for a short"
