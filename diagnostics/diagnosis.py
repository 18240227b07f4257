"""Self-diagnosis: evidence, calibration, faulty set, root causes and coverage of a log."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.decision.address_aliasing import find_aliasing
from diagnostics.decision.by_recording import of_any_movement, with_recordings
from diagnostics.decision.certificate import Certificate, certify
from diagnostics.decision.concluded import concluded
from diagnostics.decision.judged import Judged
from diagnostics.decision.result import Diagnosis
from diagnostics.decision.serialization import (
    Arrays,
    from_state,
    read_state,
    to_state,
    write_state,
)
from diagnostics.evidence.cold_start import ColdStream, judged_cold
from diagnostics.evidence.read_out import Scan, scanned
from diagnostics.evidence.reference import Reference, highest_reading, living
from diagnostics.evidence.reference_faults import find_reference_faults, never_moved
from diagnostics.evidence.stream_state import StreamState
from diagnostics.layout import SensorLayout
from diagnostics.model import Model, fit_model
from diagnostics.model.findings import judged_by_model
from diagnostics.preprocessing.checked import axis_planes, checked_recordings
from diagnostics.preprocessing.copies import find_copies
from diagnostics.preprocessing.levels import LOW
from diagnostics.preprocessing.load import LoadDirection
from diagnostics.preprocessing.quantiles import known_quantile
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.preprocessing.tolerance import tolerance_of
from diagnostics.sensor.crosstalk import Crosstalk, find_crosstalk, lowest_floors
from diagnostics.sensor.gain import UsualSizes, without_gain
from diagnostics.sensor.odd_frames import evenly
from diagnostics.sensor.rewiring import Rewiring, find_rewiring
from diagnostics.sensor.shared import Shared, measured
from diagnostics.sensor.swapped_in_part import SwappedInPart, find_swapped_in_part
from diagnostics.threads import one_thread
from diagnostics.when import (
    OWN_REFERENCE,
    Held,
    Spans,
    filled,
    find_held,
    known_classes,
    own_reference,
    reads_enough,
    shows_contacts,
)
from diagnostics.when.reference_findings import (
    ReferenceFinding,
    ReferenceWarning,
    reference_findings,
)

SCHEMA = "adaptfault.diagnoser/5"


@dataclass(frozen=True)
class Fitted:
    """The state of a fitted diagnosis that is stored."""

    layout: SensorLayout
    false_discovery_rate: float
    reference: Reference | None
    load: LoadDirection | None = None
    certificate: Certificate | None = None


def _no_progress(share: float) -> None:
    """Nobody looks at the progress."""


class SelfDiagnosis:
    """Finds faulty cells and wires of a tactile array from recordings of normal operation.

    Args:
        layout: the array.
        false_discovery_rate: expected share of healthy cells in F.

    Attributes:
        reference_: the healthy reference, after :meth:`fit`; None: cold start.
        load_: how readings become loads; None: load raises the reading.
        copies_: int ``[n]``, of which recording each one of the reference is a copy; its own number
            where it is none. None: not fitted.
        reference_findings_: what the reference itself shows: cells that hold a value in some of its
            recordings although those beside them move. Nothing is learned from these readings.
    """

    reference_: Reference | None = None
    copies_: NDArray[np.intp] | None = None
    _certificate: Certificate | None = None
    _held_out: tuple[Sequence[NDArray[Any]], NDArray[np.float64]] | None = None
    reference_findings_: tuple[ReferenceFinding, ...] = ()
    _of_log = False  # the reference is a part of the log, which nobody stated to be healthy
    _classes: frozenset[Any] | None = None  # that this part knows; None: unknown, or all

    def __init__(
        self,
        layout: SensorLayout,
        *,
        false_discovery_rate: float = 0.006,
    ) -> None:
        self.layout = layout
        self.load_ = LoadDirection.declared(layout)
        self._planes, self._order = axis_planes(layout)
        self._place = np.argsort(self._order)  # of each cell among the planes
        self.false_discovery_rate = false_discovery_rate

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Return the arguments of the constructor, for ``sklearn.base.clone`` and pipelines."""
        return {
            "layout": self.layout,
            "false_discovery_rate": self.false_discovery_rate,
        }

    def set_params(self, **params: Any) -> SelfDiagnosis:
        """Set arguments of the constructor and discard the fit.

        Raises:
            ValueError: an unknown argument.
        """
        known = self.get_params()
        if unknown := sorted(set(params) - set(known)):
            raise ValueError(
                f"SelfDiagnosis has no parameter {unknown[0]!r}: use {' or '.join(known)}"
            )
        SelfDiagnosis.__init__(self, **(known | params))
        self.reference_ = None
        self.copies_ = None
        self._certificate = None
        self._held_out = None
        return self

    @property
    def _model(self) -> Model | None:
        return None if self.reference_ is None else self.reference_.model

    def __sklearn_is_fitted__(self) -> bool:
        return self.reference_ is not None

    def __sklearn_tags__(self) -> Any:
        from sklearn.base import BaseEstimator

        return BaseEstimator().__sklearn_tags__()

    def fit(
        self,
        recordings: ArrayLike | Sequence[ArrayLike],
        y: object = None,
        *,
        strict: bool = False,
        progress: Callable[[float], None] = lambda share: None,
    ) -> SelfDiagnosis:
        """Fit to fault-free recordings, ``[T, D]`` or a list of them.

        Cells that are dead in them are found first and excluded; they are reported in every log in
        which they do not move. Recordings that are copies of others are left out
        (:mod:`diagnostics.preprocessing.copies`): they would tell how a log repeats, not how
        another one differs.

        Args:
            recordings: as :meth:`SensorLayout.recordings` takes them.
            y: ignored, for pipelines of scikit-learn.
            strict: refuse a reference that shows faults in some of its recordings; else they are
                left out, told by ``reference_findings_`` and by a warning.
            progress: receives the share of the work that is done, 0 to 1, again and again.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame with a reading; with
                ``strict``, a reference with faults.
        """
        log = checked_recordings(recordings, self.layout)
        with one_thread():
            given = measured(log, self.layout)
            self.copies_ = find_copies(given, self.layout.is_cell)
            independent = np.unique(self.copies_)
            chosen = RecordingBlocks([given[i] for i in independent])
            self._fit(chosen, progress, strict=strict)
        self.reference_findings_ = tuple(
            finding.among(independent.tolist()) for finding in self.reference_findings_
        )
        for finding in self.reference_findings_:
            warnings.warn(finding.reason, ReferenceWarning, stacklevel=2)
        return self

    def _fit(
        self,
        recordings: RecordingBlocks,
        progress: Callable[[float], None],
        suspected: NDArray[np.float64] | None = None,
        *,
        strict: bool = False,
    ) -> SelfDiagnosis:
        """Fit; ``suspected``: P(dead) ``[D]`` of cells that are dead if they never move; None:
        found here."""
        progress(0.0)
        present = self.layout.is_cell
        healthy = recordings.valid(self.layout.full_scale, present).whole(present)
        layout = self._planes
        if self.layout.axes > 1:
            healthy = RecordingBlocks([given[:, self._order] for given in healthy.given])
        self.load_ = LoadDirection.fit(healthy, layout)
        if self.load_ is not None:
            healthy = RecordingBlocks([self.load_.loads(r) for r in healthy])
            layout = replace(layout, rest="low")
        # Fractions of full scale refer to the range that was seen: a stated one may be too high.
        layout = replace(
            layout, full_scale=min(layout.full_scale, highest_reading(healthy, layout))
        )
        tolerance = tolerance_of(healthy, layout)
        held = find_held(Spans.of(healthy), layout, tolerance)
        self.reference_findings_ = reference_findings(held.of(self._place), self.layout)
        if self.reference_findings_:
            if strict:
                raise ValueError("; ".join(one.reason for one in self.reference_findings_))
            healthy = filled(healthy, held, layout)
        if suspected is None:
            dead = find_reference_faults(healthy, layout, tolerance, self._diagnosed_cold)
        else:
            dead = np.where(never_moved(healthy, tolerance), suspected[self._order], 0.0)
        self.reference_ = Reference.fit(healthy, layout, dead)
        near = self.reference_.scale.near
        usual = UsualSizes.of(list(healthy), near, living(layout, dead).is_cell)
        floors = lowest_floors(healthy, self.reference_.scale.baseline, living(layout, dead))
        model = fit_model(list(healthy), layout, dead > 0, progress=progress)
        self.reference_ = replace(self.reference_, sizes=usual, floors=floors, model=model)
        self._certificate = None
        self._held_out = (recordings.given, dead[self._place])
        progress(1.0)
        return self

    @property
    def certificate_(self) -> Certificate | None:
        """How often a healthy log is blamed at most, measured on healthy recordings that are held
        out (:mod:`diagnostics.decision.certificate`).

        It is computed when it is first asked for, which takes about a third of the time of the fit;
        :meth:`save` keeps it from then on. None: not fitted, to fewer than 20 recordings, or read
        from a file that has none.
        """
        if self._held_out is not None:
            recordings, dead = self._held_out
            self._held_out = None
            with one_thread():
                self._certificate = certify(recordings, dead > 0, self._blamed(dead))
        return self._certificate

    def _blamed(
        self, dead: NDArray[np.float64]
    ) -> Callable[
        [Sequence[NDArray[Any]], Sequence[Sequence[NDArray[Any]]]], list[NDArray[np.bool_]]
    ]:
        """Return what fits to recordings and returns F of each log, bool ``[D]``.

        ``dead``: P(dead) ``[D]`` of cells that never move.
        """

        def blamed(
            rest: Sequence[NDArray[Any]], logs: Sequence[Sequence[NDArray[Any]]]
        ) -> list[NDArray[np.bool_]]:
            part = SelfDiagnosis(**self.get_params())
            part._fit(RecordingBlocks(list(rest)), _no_progress, dead)
            return [part._diagnosed(RecordingBlocks(list(log))).fault_set.mask for log in logs]

        return blamed

    def diagnose(
        self,
        recordings: ArrayLike | Sequence[ArrayLike],
        *,
        classes: ArrayLike | None = None,
        scan: Scan | None = None,
    ) -> Diagnosis:
        """Diagnose a log: recordings ``[T, D]`` or a list of them, in time order.

        ``classes`` is the class of each recording, ``[n]``: a fault may show in one class only.
        ``scan``: of the read-out that tests itself (:mod:`diagnostics.evidence.read_out`).

        Without :meth:`fit` (cold start), a log of 16 recordings or more is its own reference
        (:meth:`for_log`), which takes the time of a fit. In a shorter one, cells are compared with
        cells that have similar surroundings.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame.
        """
        shared = self.shared(recordings)
        if shared.explains_all:
            return scanned(shared.diagnosis(), scan)
        log = RecordingBlocks(shared.recordings)
        with one_thread():
            own = self.for_log(log.given, classes=classes)
            known = shared.crosstalk if own is self else None  # else it is learned
            return scanned(shared.told(own._diagnosed_when(log, classes, known)), scan)

    def shared(self, recordings: ArrayLike | Sequence[ArrayLike]) -> Shared:
        """Return what the array as a whole does in a log, as :meth:`diagnose` takes it.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame.
        """
        shared = Shared.of(checked_recordings(recordings, self.layout), self.layout)
        return shared if shared.explains_all else shared.beside(self.crosstalk(shared.recordings))

    def crosstalk(self, recordings: ArrayLike | Sequence[ArrayLike]) -> Crosstalk | None:
        """Return the crosstalk of the lines of a log that the reference does not have; None without
        it, and where there are no rows and columns, or cells rest in the middle.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame.
        """
        loads = self._loads(checked_recordings(recordings, self.layout))
        if loads is None or not self.layout.is_matrix:
            return None
        reference = self.reference_
        if reference is None or reference.floors is None:
            rest = known_quantile(evenly(loads), LOW, axis=0)
            return find_crosstalk(loads, rest, np.zeros((2, self.layout.pads)), self.layout)
        layout = replace(self.layout, full_scale=reference.scale.full_scale)
        return find_crosstalk(loads, reference.scale.baseline, reference.floors, layout)

    def _loads(self, log: RecordingBlocks) -> RecordingBlocks | None:
        """Return the loads of a log; None where a cell rests in the middle, or has several axes."""
        valid = log.valid(self.layout.full_scale, self.layout.is_cell)
        if self.layout.axes > 1:
            return None
        if self.load_ is None:
            return valid
        if self.load_.direction == "middle":
            return None
        return RecordingBlocks([self.load_.loads(recording) for recording in valid])

    def for_log(
        self,
        recordings: ArrayLike | Sequence[ArrayLike],
        *,
        classes: ArrayLike | None = None,
        progress: Callable[[float], None] = lambda share: None,
    ) -> SelfDiagnosis:
        """Return what :meth:`diagnose` judges a log with: this diagnosis, or in a cold start one
        fitted to the log.

        That one is fitted to recordings of the log in which no cell is suspect, half of it, the
        first ones of each class (:mod:`diagnostics.when`). Cells that never move in them, and are
        faulty by the cold start on the whole log, are excluded and reported. A cell that moves but
        fails early in them may be learned as it is, and not be found.

        A log of fewer than 16 recordings, or in which most cells never move, is no reference: it is
        judged by this diagnosis.

        Args:
            recordings: a log, as for :meth:`diagnose`.
            classes: the class of each recording, ``[n]``; None: unknown.
            progress: as for :meth:`fit`.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame.
        """
        log = checked_recordings(recordings, self.layout)
        if self.reference_ is not None or len(log) < OWN_REFERENCE:
            return self
        held = self._held(self.spans(log), tolerance_of(log, self.layout), classes)
        chosen = own_reference(log, held, classes)
        first = RecordingBlocks([log.given[i] for i in chosen])
        if not shows_contacts(first, log, self.layout):
            return self
        own = SelfDiagnosis(**self.get_params())
        own._of_log = True
        if classes is not None:
            own._classes = known_classes(chosen, classes)
        with one_thread():
            cold = self._diagnosed(log)
            return own._fit(first, progress, np.where(cold.fault_set.mask, cold.probability, 0.0))

    def judge(
        self, recordings: ArrayLike | Sequence[ArrayLike], *, classes: ArrayLike | None = None
    ) -> tuple[ReferenceFinding, ...]:
        """Return what recordings show as a reference, without a fit: ``reference_findings_``.

        Args:
            recordings: as for :meth:`fit`.
            classes: the class of each recording, ``[n]``; None: unknown.

        Raises:
            ValueError: recordings that do not fit the layout.
        """
        log = checked_recordings(recordings, self.layout)
        held = self._held(self.spans(log), tolerance_of(log, self.layout), classes)
        return reference_findings(held, self.layout)

    def rewiring(self, recordings: ArrayLike | Sequence[ArrayLike]) -> Rewiring | None:
        """Return the rows, columns or pads that answer in each other's place, None where the data
        show none.

        ``Rewiring.undo`` puts the readings back; diagnose and predict with those. Without
        :meth:`fit`, with several axes and where cells rest in the middle always None.

        Args:
            recordings: a log, as for :meth:`diagnose`.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame.
        """
        log = self._for_wiring(recordings)
        if log is None or self.reference_ is None:
            return None
        with one_thread():
            return find_rewiring(log, self.reference_, self.layout)

    def swapped_in_part(self, recordings: ArrayLike | Sequence[ArrayLike]) -> SwappedInPart | None:
        """Return the rows, columns or pads that answer in each other's place in some of the
        recordings, None where the data show none.

        ``SwappedInPart.undo`` puts these recordings back. Limits and errors as for
        :meth:`rewiring`.
        """
        log = self._for_wiring(recordings)
        if log is None or self.reference_ is None:
            return None
        with one_thread():
            return find_swapped_in_part(log, self.reference_, self.layout)

    def _for_wiring(self, recordings: ArrayLike | Sequence[ArrayLike]) -> RecordingBlocks | None:
        """Return a log as loads; None where its wiring cannot be compared with a reference."""
        log = checked_recordings(recordings, self.layout)
        return None if self.reference_ is None else self._loads(log)

    def state(self) -> tuple[dict[str, Any], Arrays]:
        """Return the fitted state: a JSON-safe dict and arrays by name, as :meth:`from_state` reads
        them.
        """
        fitted, arrays = to_state(
            Fitted(
                self.layout,
                self.false_discovery_rate,
                self.reference_,
                self.load_,
                self._certificate,
            )
        )
        return {"schema": SCHEMA, **fitted}, arrays

    @classmethod
    def from_state(cls, about: Mapping[str, Any], arrays: Mapping[str, ArrayLike]) -> SelfDiagnosis:
        """Rebuild a diagnosis from :meth:`state`; its results are bit-identical.

        Raises:
            ValueError: another schema; a field or an array is missing, or of a wrong kind or shape.
        """
        schema = about.get("schema")
        if schema != SCHEMA:
            raise ValueError(f"expected schema {SCHEMA!r}, got {schema!r}")
        try:
            fitted = from_state(Fitted, about, arrays)
            diagnoser = cls(fitted.layout, false_discovery_rate=fitted.false_discovery_rate)
            diagnoser.reference_ = fitted.reference
            diagnoser.load_ = fitted.load
            diagnoser._certificate = fitted.certificate
            if fitted.load is not None:
                fitted.load.check(fitted.layout)
            if fitted.reference is not None:
                fitted.reference.check()
        except KeyError as error:
            raise ValueError(f"the stored diagnosis is damaged: {error} is missing") from None
        except (TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"the stored diagnosis is damaged: {error}") from None
        return diagnoser

    def save(self, path: str | Path) -> None:
        """Write the fitted diagnosis into one file, so that nothing is fitted twice; no pickle.

        A power cut leaves the earlier file or the new one.

        Raises:
            OSError: the file cannot be written.
        """
        write_state(path, *self.state())

    @classmethod
    def load(cls, path: str | Path) -> SelfDiagnosis:
        """Read what :meth:`save` wrote; its results are bit-identical.

        Raises:
            OSError: the file is missing, or cannot be read.
            ValueError: it is damaged, or of another kind.
        """
        return cls.from_state(*read_state(path))

    def stream(self, needed: NDArray[np.bool_] | None = None) -> StreamState:
        """Return the state before any frame. In a cold start, only tiles with a ``needed`` cell
        (bool ``[D]``; None: all) are scored."""
        reference = self.reference_ or Reference.unknown(self._planes)
        order = self._order if self.layout.axes > 1 else None
        if self._model is None:
            return ColdStream(self._planes, reference, needed, self.load_, order)
        return StreamState(self._planes, reference, self._model.recorder(), self.load_, order)

    def evaluate(self, stream: StreamState, *, n_recordings: int = 1) -> Diagnosis:
        """Return the diagnosis of the log behind ``stream``.

        Args:
            stream: the state of the log.
            n_recordings: of which it consists.

        Raises:
            ValueError: no frame with a reading was received yet.
        """
        with one_thread():
            return self._evaluated(stream, n_recordings)

    def evaluate_recordings(
        self, stream: StreamState, spans: Spans, lengths: Sequence[int], tolerance: float
    ) -> Diagnosis:
        """Return the diagnosis of the log behind ``stream`` with the recordings in which faults
        show.

        Args:
            stream: the state of the log.
            spans: of its recordings (:meth:`spans`).
            lengths: frames of each.
            tolerance: half range of a constant reading (:meth:`tolerance`).

        Raises:
            ValueError: as :meth:`evaluate`.
        """
        held = self._held(spans, tolerance, None)
        whole = self.evaluate(stream, n_recordings=len(lengths))
        return with_recordings(whole, held, lengths, tolerance, None)

    def _evaluated(self, stream: StreamState, n_recordings: int) -> Diagnosis:
        """Return the diagnosis; arguments as in :meth:`evaluate`."""
        stream = stream.complete()
        if not stream.received.any():
            raise ValueError("the recordings hold no frame with a reading: nothing to diagnose")
        judged = self._of_cells(stream)
        shown = judged.shown
        if self._of_log or self.reference_ is None:
            shown = shown & reads_enough(stream.ranges, self._planes)
        if stream.crosstalk is not None:
            shown = shown & stream.crosstalk.own
        # whether loads, as the stream holds them, may fall: a load direction, or a reference, tells
        known = stream.load is not None or self.reference_ is not None
        falls = False if known or self.layout.rest != "learn" else None
        judged = replace(judged, shown=shown)
        return concluded(stream, judged, n_recordings, self.layout, self._order, falls=falls)

    def _of_cells(self, stream: StreamState) -> Judged:
        """Return what is known of each cell of a log, before root causes."""
        rate = self.false_discovery_rate
        full_scale = self.layout.full_scale
        if self._model is not None:
            return judged_by_model(self._model, stream, self._planes, rate, full_scale)
        assert isinstance(stream, ColdStream)
        aliases = find_aliasing(stream, partial(stream.cold.log_likelihood, stream))
        return judged_cold(stream, aliases, rate, full_scale)

    def _judged(self, log: RecordingBlocks, crosstalk: Crosstalk | None) -> Diagnosis:
        """Return the diagnosis of a log, without a gain of the whole array where fewer cells are
        faulty then."""
        found = self._diagnosed(log, crosstalk=crosstalk)
        usual = self.without_gain(log.given) if found.faults and crosstalk is None else None
        if usual is None:
            return found
        without = self._diagnosed(usual)
        return without if len(without.fault_set) < len(found.fault_set) else found

    def without_gain(self, recordings: ArrayLike | Sequence[ArrayLike]) -> RecordingBlocks | None:
        """Return a log without the gain that the whole array has in it; None where it has none, or
        none is known (:mod:`diagnostics.sensor.gain`).

        Args:
            recordings: a log, as for :meth:`diagnose`.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame.
        """
        log = checked_recordings(recordings, self.layout)
        reference = self.reference_
        loads = self._loads(log)
        if loads is None or reference is None or reference.sizes is None:
            return None
        scale = reference.scale
        present = living(self._planes, reference.dead).is_cell
        gain = reference.sizes.gain(list(loads), scale.near, present)
        if gain == 1.0:
            return None
        usual = without_gain(loads, gain, scale.baseline)
        if self.load_ is not None:
            below = np.zeros(self.layout.n_cells, bool)
            usual = [self.load_.readings(frames, below) for frames in usual]
        return RecordingBlocks(usual)

    def _diagnosed(
        self,
        log: RecordingBlocks,
        needed: NDArray[np.bool_] | None = None,
        crosstalk: Crosstalk | None = None,
    ) -> Diagnosis:
        stream = self.stream(needed)
        stream.crosstalk = crosstalk
        for i in range(len(log)):
            stream.begin_recording()
            for frames in log[i : i + 1].blocks():
                stream.extend(frames)
        return self.evaluate(stream, n_recordings=len(log))

    def _diagnosed_when(
        self, log: RecordingBlocks, classes: ArrayLike | None, crosstalk: Crosstalk | None
    ) -> Diagnosis:
        """Return the diagnosis of a log with the recordings in which faults show."""
        tolerance = self.tolerance(log)
        held = self._held(self.spans(log), tolerance, classes)

        def knows(some: tuple[int, ...]) -> bool:
            if self._classes is None or classes is None:
                return True
            return self._classes.issuperset(np.asarray(classes)[list(some)].tolist())

        def of_part(some: tuple[int, ...]) -> Diagnosis:
            part = RecordingBlocks([log.given[i] for i in some])
            found = self._judged(part, crosstalk)
            # a part of a log does not tell that all of it is disturbed
            moves = knows(some) and not whole.contradicting
            return found if moves else of_any_movement(found, held.suspect[list(some)])

        whole = self._judged(log, crosstalk)
        if not knows(tuple(range(len(log)))):
            whole = of_any_movement(whole, held.suspect)
        lengths = [len(given) for given in log.given]
        # without a reference, a part of a log tells less than the whole
        part = None if self.reference_ is None else of_part
        return with_recordings(whole, held, lengths, tolerance, part)

    def spans(self, log: RecordingBlocks) -> Spans:
        """Return the range of the loads of each cell in each recording, each axis of a pad as a pad
        of its own."""
        return Spans.of(RecordingBlocks(self._in_planes(log)))

    def tolerance(self, log: RecordingBlocks) -> float:
        """Return the half range of a constant reading."""
        if self.reference_ is None:
            return tolerance_of(log, self.layout)
        return self.reference_.tolerance

    def _held(self, spans: Spans, tolerance: float, classes: ArrayLike | None) -> Held:
        """Return where cells hold a value although those beside them move."""
        held = find_held(spans, self._planes, tolerance, classes)
        if self.load_ is not None:
            below = np.zeros(len(held.value), bool)
            held = replace(held, value=self.load_.readings(held.value, below))
        return held.of(self._place)

    def _in_planes(self, log: RecordingBlocks) -> list[NDArray[np.float64]]:
        """Return the loads of a log, each axis of a pad as a pad of its own."""
        valid = log.valid(self.layout.full_scale, self.layout.is_cell)
        given = [np.asarray(frames, dtype=np.float64)[:, self._order] for frames in valid.given]
        if self.load_ is None:
            return given
        return [self.load_.loads(frames) for frames in given]

    @staticmethod
    def _diagnosed_cold(
        log: RecordingBlocks,
        needed: NDArray[np.bool_],
        rest: NDArray[np.float64],
        layout: SensorLayout,
    ) -> Diagnosis:
        """Diagnose the ``needed`` cells without a reference, but with known baselines ``rest``."""
        cold = SelfDiagnosis(layout)
        cold.reference_ = Reference.unknown(layout, rest)
        return cold._diagnosed(log, needed)
