"""Self-diagnosis: gathers the evidence, weighs it, finds the root causes, and says what was not tested."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.addresses import aliasings
from diagnostics.causes import Findings, root_causes
from diagnostics.dead_before import dead_before
from diagnostics.layout import SensorLayout
from diagnostics.memory import Memory, finished
from diagnostics.patched import remembering
from diagnostics.readings import Readings
from diagnostics.reference import Reference, living, tolerance_of
from diagnostics.spatial import Caution, Spatial
from diagnostics.stored import Arrays, reference_from_state, reference_state, weights_from_state, weights_state
from diagnostics.verdicts import Diagnosis
from diagnostics.weighing import Weights, faulty_at, kinds
from diagnostics.wiring import suspected

SCHEMA = "adaptfault.diagnoser/8"

_SURE = 0.999  # P(faulty) of a cell that was counted out over many frames
_SUSPICIOUS_COLD = 3.0  # log evidence from which on a cell is not asked about the others, in a cold start
_KNOWN = 9.0  # log likelihood ratio of a cell that was dead in the reference already
_APART = 0.5  # of what speaks against cells of one wire, where none of them is asked about the others
# P(faulty) from which on a cell is likely to be faulty. So far such a cell leads the others on its wire, and any other
# cell, where many touches are known; where few are, strange ones make cells likely too.
_LIKELY, _LEADING = 0.8, (0.75, 0.4)
_DOUBTED = 0.1  # P(faulty) from which on a cell that moved before is no longer called alive


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
    weights_: Weights = Weights()

    def __init__(self, layout: SensorLayout, *, false_discovery_rate: float = 0.006) -> None:
        self.layout = layout
        self.false_discovery_rate = false_discovery_rate

    def fit(self, recordings: ArrayLike | Sequence[ArrayLike]) -> SelfDiagnosis:
        """Learn from fault-free recordings, ``[T, D]`` or a list of them, what healthy looks like.

        Cells that are dead in them all the same are found first, and called so in every log in which they do not move.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame with a reading.
        """
        healthy = _recordings(recordings, self.layout).whole(self.layout.present.ravel())
        dead = dead_before(healthy, self.layout, tolerance_of(healthy, self.layout), self._diagnosed_cold)
        self.reference_ = Reference.fit(healthy, self.layout, dead)
        self.weights_ = Weights.fit(healthy, living(self.layout, dead))
        return self

    def diagnose(self, recordings: ArrayLike | Sequence[ArrayLike]) -> Diagnosis:
        """Judge every cell from a log: recordings ``[T, D]`` or a list of them, in time order.

        Without :meth:`fit`, cells are judged by the cells around them in the same log.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame.
        """
        return self._diagnosed(_recordings(recordings, self.layout))

    def state(self) -> tuple[dict[str, Any], Arrays]:
        """Return all that it knows: a JSON-safe dict, and arrays by name, as :meth:`from_state` reads them."""
        about = {
            "schema": SCHEMA,
            "layout": self.layout.to_dict(),
            "false_discovery_rate": self.false_discovery_rate,
            "weights": weights_state(self.weights_),
        }
        if self.reference_ is None:
            return {**about, "reference": None}, {}
        reference, arrays = reference_state(self.reference_)
        return {**about, "reference": reference}, arrays

    @classmethod
    def from_state(cls, about: Mapping[str, Any], arrays: Mapping[str, ArrayLike]) -> SelfDiagnosis:
        """Rebuild from :meth:`state` one that says the same of every log, to the last bit.

        Raises:
            ValueError: another schema; a field or an array is missing, or of a wrong kind or shape.
        """
        if about.get("schema") != SCHEMA:
            raise ValueError(f"expected schema {SCHEMA!r}, got {about.get('schema')!r}")
        try:
            layout = SensorLayout.from_dict(about["layout"])
            diagnoser = cls(layout, false_discovery_rate=float(about["false_discovery_rate"]))
            diagnoser.weights_ = weights_from_state(about["weights"])
            if about["reference"] is not None:
                diagnoser.reference_ = reference_from_state(about["reference"], arrays, layout)
        except KeyError as error:
            raise ValueError(f"the stored diagnosis is damaged: {error} is missing") from None
        except (TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"the stored diagnosis is damaged: {error}") from None
        return diagnoser

    def memory(self, needed: NDArray[np.bool_] | None = None) -> Memory:
        """Return an empty memory, to be fed with a log and judged; see ``patched.remembering``."""
        reference = self.reference_ or Reference.unknown(self.layout)
        caution = self.weights_.caution if reference.model else Caution(_SUSPICIOUS_COLD)
        return remembering(self.layout, reference, caution, needed)

    def judge(self, memory: Memory, *, n_recordings: int = 1) -> Generator[None, None, Diagnosis]:
        """Judge every cell from what is remembered of a log.

        A generator that pauses every few milliseconds, for those who cannot wait; it returns the diagnosis.

        Raises:
            ValueError: no frame with a reading has come yet.
        """
        memory = memory.complete()
        if not memory.heard.any():
            raise ValueError("the recordings hold no frame with a reading: nothing to diagnose")
        aliased = aliasings(memory)
        yield
        wrong = np.zeros(self.layout.n_cells, bool)
        wrong[[cell for aliasing in aliased for cell in (*aliasing.cells, *aliasing.doubtful)]] = True
        spatial = yield from memory.spatial(wrong)
        found = self._found(memory, spatial, wrong)
        yield
        found = yield from self._with_those_apart(found, memory, spatial, wrong)
        causes = yield from root_causes(found, aliased, self.layout)
        probability, inferred = found.probability.copy(), np.zeros(self.layout.n_cells, bool)
        for fault in causes:
            cells = list(fault.cells)
            probability[cells] = np.maximum(probability[cells], fault.probability or 0.0)
            inferred[cells] = True
        scale, unrest = memory.scale, memory.unrest
        working = found.alive & ~inferred
        return Diagnosis(
            layout=self.layout,
            faults=causes,
            probability=probability,
            tested=(found.alive & memory.touched) | inferred,  # noise alone proves nothing
            transport=memory.stream.faults(scale.resting + scale.near, working, self.layout.rate),
            evidence={
                "spatial": spatial.evidence + spatial.offset + spatial.gain,
                "temporal": np.where(spatial.asked, memory.temporal(), unrest.blinking + unrest.noisy),
                "touches": spatial.touches.astype(np.float64),
            },
            n_frames=memory.stream.seen,
            n_recordings=n_recordings,
        )

    def _diagnosed(self, log: Readings, needed: NDArray[np.bool_] | None = None) -> Diagnosis:
        memory = self.memory(needed)
        for frames in log.blocks():
            memory.extend(frames)
        return finished(self.judge(memory, n_recordings=len(log)))

    def _diagnosed_cold(self, log: Readings, needed: NDArray[np.bool_], rest: NDArray[np.float64]) -> Diagnosis:
        """Judge cells that are ``needed`` by those around them, as far as the log tells; they ``rest`` there."""
        cold = SelfDiagnosis(self.layout)
        cold.reference_ = Reference.unknown(self.layout, rest)
        return cold._diagnosed(log, needed)

    def _found(self, memory: Memory, spatial: Spatial, wrong: NDArray[np.bool_]) -> Findings:
        """Weigh the evidence, and cut F; cells that are ``wrong`` (bool ``[D]``) have been explained already."""
        reference, runs, unrest = memory.reference, memory.runs, memory.unrest
        present, silent = memory.present, memory.silent & ~wrong
        temporal, kind = memory.temporal(), kinds(memory)
        known = spatial.asked & ~runs.moved & (reference.dead > 0)
        worth = self.weights_.worth(spatial.evidence, temporal, kind)
        still = self.weights_.probability(worth, kind, spatial.asked & ~known)
        still[known] = reference.dead[known]
        delivers = present & ~wrong & ~silent
        intermittent, noisy = unrest.intermittent & delivers, unrest.excess & delivers
        drifting = delivers & ~intermittent & ~noisy & spatial.drifting
        counted_out = silent | intermittent | noisy | drifting
        probability = np.where(present, np.where(counted_out, _SURE, still), 0.0)
        faulty = faulty_at(np.where(counted_out, 0.0, probability), self.false_discovery_rate)
        faulty = (faulty | counted_out) & present & ~wrong
        value, rests = runs.value, spatial.asked & memory.rests()
        return Findings(
            faulty=faulty,
            # A cell that moved is not dead, unless something speaks against what it does since.
            alive=present & ~wrong & ~faulty & runs.moved & (probability < _DOUBTED),
            silent=silent,
            rests=rests,
            full=spatial.asked & ~rests & (value >= self.layout.full_scale - 2 * reference.tolerance),
            intermittent=intermittent,
            noisy=noisy,
            drifting=drifting,
            gain=np.where(drifting, spatial.factor, np.nan),
            value=np.where(intermittent, np.where(2 * unrest.high > unrest.blinks, self.layout.full_scale, 0.0), value),
            since=np.select(
                [silent, intermittent, noisy, drifting],
                [runs.missed_since, unrest.blinks_since, unrest.noisy_since, spatial.since],
                runs.start,
            ),
            probability=probability,
            # What the line hypothesis asks of a cell at rest is only whether touches speak against it.
            weight=np.where(known, _KNOWN, self.weights_.worth(spatial.surprise, temporal, kind)),
            doubt=1 - (1 - reference.unfamiliar) * np.where(probability > _LIKELY, *_LEADING),
            touches=np.where(intermittent, unrest.blinks, spatial.touches),
            known=known,
        )

    def _with_those_apart(
        self, found: Findings, memory: Memory, spatial: Spatial, wrong: NDArray[np.bool_]
    ) -> Generator[None, None, Findings]:
        """Return the same, with what speaks for broken wires if their cells do not vouch for each other.

        The chain rule of probability would ask, for each of them in turn, those before it: half of them, that is about
        the mean of asking all and asking none. But what is expected where few are asked has to be learned from many
        touches.
        """
        share = _APART * (1 - memory.reference.unfamiliar)
        if not share.any():
            return found
        temporal, kind, alike = memory.temporal(), kinds(memory), found.rests & ~found.known & ~wrong

        def weight_if(apart: NDArray[np.float64]) -> NDArray[np.float64]:
            more = self.weights_.worth(apart, temporal, kind) - found.weight
            return found.weight + share * np.maximum(more, 0.0)

        against = found.alive | ~(found.rests | found.silent) & memory.present
        groups = suspected(alike, against, weight_if(spatial.at_first), self.layout)
        if not groups:
            return found
        apart = yield from memory.apart(spatial, wrong, groups)
        weight = found.weight.copy()
        for group, of_group in zip(groups, apart, strict=True):
            weight[group] = np.maximum(weight[group], weight_if(of_group)[group])
        return replace(found, weight=weight)


def _recordings(recordings: ArrayLike | Sequence[ArrayLike], layout: SensorLayout) -> Readings:
    """Return recordings, each ``[T, D]``, T >= 1."""
    given: Any = recordings
    single = isinstance(given, np.ndarray) and (given.shape[1:] == layout.shape or given.ndim <= 2)
    checked = [_checked(r, f"recording {i}", layout) for i, r in enumerate([given] if single else given)]
    checked = [r for r in checked if len(r)]
    if not checked:
        raise ValueError("no frames: expected recordings [T, D] with T >= 1")
    return Readings(checked)


def _checked(recording: ArrayLike, name: str, layout: SensorLayout) -> NDArray[Any]:
    """Return a recording as ``[T, D]``; numbers stay as they are, and are converted where they are read."""
    given = np.asarray(recording)
    if given.dtype.kind in "fiu" and given.shape[1:] in (layout.shape, (layout.n_cells,)):
        return given.reshape(len(given), layout.n_cells)
    return layout.check_recording(recording, name)
