"""Self-diagnosis: gathers the evidence, weighs it, finds the root causes, and says what was not tested."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.decision import version_8
from diagnostics.decision.address_aliasing import find_aliasing
from diagnostics.decision.calibration import Calibrator, faulty_at, kinds
from diagnostics.decision.line_cover import candidate_groups
from diagnostics.decision.result import Diagnosis
from diagnostics.decision.root_causes import CellFindings, root_causes
from diagnostics.decision.serialization import Arrays, from_state, to_state
from diagnostics.evidence.spatial import Exclusion, Spatial
from diagnostics.evidence.stream_state import StreamState
from diagnostics.healthy.reference import Reference, living, tolerance_of
from diagnostics.healthy.reference_faults import find_reference_faults
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.readings import RecordingBlocks

SCHEMA = "adaptfault.diagnoser/9"

_SURE = 0.999  # P(faulty) of a cell that was counted out over many frames
_SUSPICIOUS_COLD = 3.0  # log evidence from which on a cell is not asked about the others, in a cold start
_KNOWN = 9.0  # log likelihood ratio of a cell that was dead in the reference already
_APART = 0.5  # of what speaks against cells of one wire, where none of them is asked about the others
# P(faulty) from which on a cell is likely to be faulty. So far such a cell leads the others on its wire, and any other
# cell, where many touches are known; where few are, strange ones make cells likely too.
_LIKELY, _LEADING = 0.8, (0.75, 0.4)
_DOUBTED = 0.1  # P(faulty) from which on a cell that moved before is no longer called alive


@dataclass(frozen=True)
class Fitted:
    """What is stored of a fitted diagnosis."""

    layout: SensorLayout
    false_discovery_rate: float
    calibrator: Calibrator
    reference: Reference | None


class SelfDiagnosis:
    """Finds faulty cells and the wires behind them, from what a robot recorded in passing.

    Args:
        layout: the array.
        false_discovery_rate: expected share of healthy cells in F: it is cut where it comes near to this.

    Attributes:
        reference_: what healthy looks like, after :meth:`fit`.
        weights_: what evidence is worth, after :meth:`fit`.
    """

    reference_: Reference | None = None
    calibrator_: Calibrator = Calibrator()

    def __init__(self, layout: SensorLayout, *, false_discovery_rate: float = 0.006) -> None:
        self.layout = layout
        self.false_discovery_rate = false_discovery_rate

    def fit(self, recordings: ArrayLike | Sequence[ArrayLike]) -> SelfDiagnosis:
        """Learn from fault-free recordings, ``[T, D]`` or a list of them, what healthy looks like.

        Cells that are dead in them all the same are found first, and called so in every log in which they do not move.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame with a reading.
        """
        healthy = _recordings(recordings, self.layout).valid(self.layout.full_scale).whole(self.layout.present.ravel())
        dead = find_reference_faults(healthy, self.layout, tolerance_of(healthy, self.layout), self._diagnosed_cold)
        self.reference_ = Reference.fit(healthy, self.layout, dead)
        self.calibrator_ = Calibrator.fit(healthy, living(self.layout, dead))
        return self

    def diagnose(self, recordings: ArrayLike | Sequence[ArrayLike]) -> Diagnosis:
        """Judge every cell from a log: recordings ``[T, D]`` or a list of them, in time order.

        Without :meth:`fit`, cells are judged by the cells around them in the same log.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame.
        """
        return self._diagnosed(_recordings(recordings, self.layout))

    def state(self) -> tuple[dict[str, Any], Arrays]:
        """Return everything that was fitted: a JSON-safe dict and arrays by name, as :meth:`from_state` reads them."""
        fitted, arrays = to_state(Fitted(self.layout, self.false_discovery_rate, self.calibrator_, self.reference_))
        return {"schema": SCHEMA, **fitted}, arrays

    @classmethod
    def from_state(cls, about: Mapping[str, Any], arrays: Mapping[str, ArrayLike]) -> SelfDiagnosis:
        """Rebuild a diagnosis from :meth:`state`; its answers are the same to the last bit.

        Raises:
            ValueError: another schema; a field or an array is missing, or of a wrong kind or shape.
        """
        schema = about.get("schema")
        if schema not in (SCHEMA, version_8.SCHEMA):
            raise ValueError(f"expected schema {SCHEMA!r}, got {schema!r}")
        try:
            if schema == version_8.SCHEMA:
                about, arrays = version_8.converted(about, arrays)
            fitted = from_state(Fitted, about, arrays)
            diagnoser = cls(fitted.layout, false_discovery_rate=fitted.false_discovery_rate)
            diagnoser.calibrator_, diagnoser.reference_ = fitted.calibrator, fitted.reference
            if fitted.reference is not None:
                fitted.reference.check(fitted.layout)
        except KeyError as error:
            raise ValueError(f"the stored diagnosis is damaged: {error} is missing") from None
        except (TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"the stored diagnosis is damaged: {error}") from None
        return diagnoser

    def stream(self, needed: NDArray[np.bool_] | None = None) -> StreamState:
        """Return the state before any frame. Only tiles with a cell that is ``needed`` (bool ``[D]``) are scored."""
        reference = self.reference_ or Reference.unknown(self.layout)
        exclusion = self.calibrator_.exclusion if reference.model else Exclusion(_SUSPICIOUS_COLD)
        return StreamState(self.layout, reference, exclusion, needed)

    def evaluate(self, stream: StreamState, *, n_recordings: int = 1) -> Diagnosis:
        """Return the diagnosis of the log behind ``stream``.

        Raises:
            ValueError: no frame with a reading was received yet.
        """
        steps = self.steps(stream, n_recordings=n_recordings)
        while True:
            try:
                next(steps)
            except StopIteration as end:
                diagnosis: Diagnosis = end.value
                return diagnosis

    def steps(self, stream: StreamState, *, n_recordings: int = 1) -> Generator[None, None, Diagnosis]:
        """Do the same as :meth:`evaluate` in steps of a few milliseconds, for a control loop; return the diagnosis."""
        stream = stream.complete()
        if not stream.received.any():
            raise ValueError("the recordings hold no frame with a reading: nothing to diagnose")
        aliased = find_aliasing(stream)
        yield
        explained = np.zeros(self.layout.n_cells, bool)
        explained[[cell for aliasing in aliased for cell in (*aliasing.cells, *aliasing.doubtful)]] = True
        test = stream.spatial(explained)
        while not test.step():
            yield
        spatial = test.result
        yield
        found = self._found(stream, spatial, explained)
        weight = found.weight.copy()
        weight_if = self._weight_of_groups(found, stream)
        for group in self._groups(found, stream, weight_if(spatial.initial), explained):
            yield
            of_group = weight_if(stream.group_excluded(spatial, explained, group))
            weight[group] = np.maximum(weight[group], of_group[group])
        found = replace(found, weight=weight)
        yield
        causes = root_causes(found, aliased, self.layout)
        probability, inferred = found.probability.copy(), np.zeros(self.layout.n_cells, bool)
        for fault in causes:
            cells = list(fault.cells)
            probability[cells] = np.maximum(probability[cells], fault.probability or 0.0)
            inferred[cells] = True
        scale, intermittency = stream.scale, stream.intermittency
        working = found.alive & ~inferred
        return Diagnosis(
            layout=self.layout,
            faults=causes,
            probability=probability,
            tested=(found.alive & stream.touched) | inferred,  # noise alone proves nothing
            transport=stream.transport.faults(scale.baseline + scale.near, working, self.layout.rate),
            evidence={
                "spatial": spatial.evidence + spatial.offset + spatial.gain,
                "temporal": np.where(spatial.scored, stream.temporal(), intermittency.blinking + intermittency.noisy),
                "events": spatial.events.astype(np.float64),
            },
            n_frames=stream.transport.seen,
            n_recordings=n_recordings,
        )

    def _diagnosed(self, log: RecordingBlocks, needed: NDArray[np.bool_] | None = None) -> Diagnosis:
        stream = self.stream(needed)
        for frames in log.blocks():
            stream.extend(frames)
        return self.evaluate(stream, n_recordings=len(log))

    def _diagnosed_cold(self, log: RecordingBlocks, needed: NDArray[np.bool_], rest: NDArray[np.float64]) -> Diagnosis:
        """Diagnose the ``needed`` cells without a reference, but with known baselines ``rest``."""
        cold = SelfDiagnosis(self.layout)
        cold.reference_ = Reference.unknown(self.layout, rest)
        return cold._diagnosed(log, needed)

    def _found(self, stream: StreamState, spatial: Spatial, wrong: NDArray[np.bool_]) -> CellFindings:
        """Weigh the evidence, and cut F; cells that are ``wrong`` (bool ``[D]``) have been explained already."""
        reference, runs, intermittency = stream.reference, stream.runs, stream.intermittency
        present, silent = stream.present, stream.silent & ~wrong
        temporal, kind = stream.temporal(), kinds(stream)
        known = spatial.scored & ~runs.moved & (reference.dead > 0)
        log_ratio = self.calibrator_.calibrate(spatial.evidence, temporal, kind)
        still = self.calibrator_.probability(log_ratio, kind, spatial.scored & ~known)
        still[known] = reference.dead[known]
        delivers = present & ~wrong & ~silent
        intermittent, noisy = intermittency.intermittent & delivers, intermittency.excess & delivers
        drifting = delivers & ~intermittent & ~noisy & spatial.drifting
        counted_out = silent | intermittent | noisy | drifting
        probability = np.where(present, np.where(counted_out, _SURE, still), 0.0)
        faulty = faulty_at(np.where(counted_out, 0.0, probability), self.false_discovery_rate)
        faulty = (faulty | counted_out) & present & ~wrong
        value, rests = runs.value, spatial.scored & stream.rests()
        return CellFindings(
            faulty=faulty,
            # A cell that moved is not dead, unless something speaks against what it does since.
            alive=present & ~wrong & ~faulty & runs.moved & (probability < _DOUBTED),
            silent=silent,
            rests=rests,
            full=spatial.scored & ~rests & (value >= self.layout.full_scale - 2 * reference.tolerance),
            intermittent=intermittent,
            noisy=noisy,
            drifting=drifting,
            gain=np.where(drifting, spatial.factor, np.nan),
            value=np.where(
                intermittent,
                np.where(2 * intermittency.high > intermittency.blinks, self.layout.full_scale, 0.0),
                value,
            ),
            since=np.select(
                [silent, intermittent, noisy, drifting],
                [runs.missed_since, intermittency.blinks_since, intermittency.noisy_since, spatial.since],
                runs.start,
            ),
            probability=probability,
            # What the line hypothesis asks of a cell at rest is only whether touches speak against it.
            weight=np.where(known, _KNOWN, self.calibrator_.calibrate(spatial.surprisal, temporal, kind)),
            doubt=1 - (1 - reference.inexperience) * np.where(probability > _LIKELY, *_LEADING),
            events=np.where(intermittent, intermittency.blinks, spatial.events),
            known=known,
        )

    def _weight_of_groups(
        self, found: CellFindings, stream: StreamState
    ) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
        """Return the function from a summed surprisal with a group excluded to the weights ``[D]`` for the line cover.

        By the chain rule of probability each cell of a group is conditioned on those before it: on half of them, about
        the mean of conditioning on all and on none. With few reference events the predictions from few predictors
        are poor, so the share is smaller.
        """
        temporal, kind = stream.temporal(), kinds(stream)
        share = _APART * (1 - stream.reference.inexperience)

        def weight_if(surprisal: NDArray[np.float64]) -> NDArray[np.float64]:
            more = self.calibrator_.calibrate(surprisal, temporal, kind) - found.weight
            return found.weight + share * np.maximum(more, 0.0)

        return weight_if

    def _groups(
        self, found: CellFindings, stream: StreamState, weight: NDArray[np.float64], explained: NDArray[np.bool_]
    ) -> list[NDArray[np.intp]]:
        """Return the groups of cells at rest that one broken line would explain."""
        if (stream.reference.inexperience == 1).all():
            return []
        matching = found.rests & ~found.known & ~explained
        contradicting = found.alive | ~(found.rests | found.silent) & stream.present
        return candidate_groups(matching, contradicting, weight, self.layout)


def _recordings(recordings: ArrayLike | Sequence[ArrayLike], layout: SensorLayout) -> RecordingBlocks:
    """Return recordings, each ``[T, D]``, T >= 1."""
    given: Any = recordings
    single = isinstance(given, np.ndarray) and (given.shape[1:] == layout.shape or given.ndim <= 2)
    checked = [_checked(r, f"recording {i}", layout) for i, r in enumerate([given] if single else given)]
    checked = [r for r in checked if len(r)]
    if not checked:
        raise ValueError("no frames: expected recordings [T, D] with T >= 1")
    return RecordingBlocks(checked)


def _checked(recording: ArrayLike, name: str, layout: SensorLayout) -> NDArray[Any]:
    """Return a recording as ``[T, D]``; numbers stay as they are, and are converted where they are read."""
    given = np.asarray(recording)
    if given.dtype.kind in "fiu" and given.shape[1:] in (layout.shape, (layout.n_cells,)):
        return given.reshape(len(given), layout.n_cells)
    return layout.check_recording(recording, name)
