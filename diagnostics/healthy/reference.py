"""The reference: all that fitting on fault-free recordings leaves behind, and what stands in for it without any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.constant_runs import JumpHistogram, segments
from diagnostics.events.contact_events import SEGMENT
from diagnostics.evidence.duplicate_lines import DuplicateLines, informative
from diagnostics.evidence.intermittency import HealthyRates
from diagnostics.evidence.noise_loss import NoiseLoss
from diagnostics.healthy.model import HealthyModel
from diagnostics.healthy.tiled_model import fit_healthy_model
from diagnostics.preprocessing.baseline import LowerLimit, baseline
from diagnostics.preprocessing.offset import ReferenceOffset
from diagnostics.preprocessing.scale import Scale
from diagnostics.preprocessing.transport import longest_repetition

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

_TOLERANCE = 0.005  # of full scale: how far a stuck cell's reading may wander, a converter's dither
_STEPS = 1.5  # and at least so many converter steps
_TWINS = 5  # witnesses that two healthy lines may have, where no reference tells
_TELLING = 250  # recordings that tell how many; with half as many, one more may be
_SAMPLED = 2000  # cells, about, that tell the converter's step
_PATIENCE = 32  # a frame may come again so often, and twice as often as it ever did in the reference


@dataclass(frozen=True)
class Reference:
    """What healthy looks like.

    Attributes:
        tolerance: how near to a value counts as that value, in the layout's unit.
        scale: what a reading means.
        onsets: how abruptly healthy cells come to rest.
        least: that healthy cells read.
        flicker: how long they read the same.
        offset: of all cells together that is usual.
        patience: a frame that comes again more often than this says nothing new.
        usual: how restless healthy cells are.
        twins: how many witnesses two healthy lines may have of being one.
        model: how a touch loads a cell; None: to be learned from the log at hand (cold start).
        dead: float ``[D]``, P(dead) of cells that were dead in it already, 0 for all others.
    """

    tolerance: float
    scale: Scale
    jumps_seen: JumpHistogram
    least: LowerLimit
    noise_loss: NoiseLoss
    offset: ReferenceOffset
    patience: int
    usual: HealthyRates
    duplicates: int
    model: HealthyModel | None
    dead: NDArray[np.float64]

    def check(self, layout: SensorLayout) -> None:
        """Check that the numbers are possible and that the model covers each cell of ``layout`` once.

        Raises:
            ValueError: they are not, or it does not.
        """
        rates = (self.usual.blinks, self.usual.blinks_count, self.usual.noise_counts)
        positive = (self.tolerance, self.scale.near, self.noise_loss.recording, self.patience, *rates)
        if not min(positive) > 0:
            raise ValueError(f"expected positive tolerance, near, recording, patience and rates, got {positive}")
        if self.model is not None:
            self.model.check(living(layout, self.dead))

    @property
    def inexperience(self) -> NDArray[np.float64]:
        """How little is known of healthy touches, float ``[D]``: 0 where it holds 400 of them, 1 with 100 or fewer."""
        return np.ones(len(self.dead)) if self.model is None else self.model.inexperience(len(self.dead))

    @classmethod
    def fit(
        cls, recordings: Sequence[NDArray[np.float64]], layout: SensorLayout, dead: NDArray[np.float64] | None = None
    ) -> Reference:
        """Learn from fault-free recordings, ``[T, D]`` each; from cells that are ``dead`` in them (``[D]``) nothing."""
        tolerance = tolerance_of(recordings, layout)
        dead = np.zeros(layout.n_cells) if dead is None else dead
        layout = living(layout, dead)
        present = layout.present.ravel()
        rest, least = baseline(recordings, present, tolerance, layout.full_scale)
        rest[dead > 0] = np.median(rest[present])  # where they would rest
        scale = Scale(rest, 2 * tolerance, layout.full_scale)
        jumps_seen = JumpHistogram.fit(recordings, tolerance, layout.full_scale, rest)
        patience = max(_PATIENCE, 2 * max(longest_repetition(r) for r in recordings))
        model = fit_healthy_model(recordings, layout, scale)
        return cls(
            tolerance,
            scale,
            jumps_seen,
            least,
            NoiseLoss.fit(recordings, present),
            ReferenceOffset.fit(recordings, scale, present),
            patience,
            HealthyRates.fit(recordings, scale, layout),
            _usual_duplicates(recordings, layout, scale),
            model,
            dead,
        )

    @classmethod
    def unknown(cls, layout: SensorLayout, rest: NDArray[np.float64] | None = None) -> Reference:
        """Stand in for a reference: untouched cells read ``rest`` (``[D]``; None: 0), and jumps say nothing."""
        tolerance = _TOLERANCE * layout.full_scale
        rest = np.zeros(layout.n_cells) if rest is None else rest
        scale = Scale(rest, 2 * tolerance, layout.full_scale)
        return cls(
            tolerance,
            scale,
            JumpHistogram.silent(),
            LowerLimit.unknown(layout.n_cells),
            NoiseLoss.unknown(layout.n_cells),
            ReferenceOffset(0.0, tolerance),
            2 * _PATIENCE,
            HealthyRates.unknown(scale),
            _TWINS,
            None,
            np.zeros(layout.n_cells),
        )


def living(layout: SensorLayout, dead: NDArray[np.float64]) -> SensorLayout:
    """Return a layout without the cells that are ``dead`` (P(dead) ``[D]``)."""
    return replace(layout, present=layout.present & ~layout.grid(dead > 0)) if dead.any() else layout


def tolerance_of(recordings: Sequence[NDArray[np.float64]], layout: SensorLayout) -> float:
    """Return how near to a value counts as that value: what a converter's dither needs, whatever its step."""
    cells = slice(None, None, max(1, layout.n_cells // _SAMPLED))
    sample = np.concatenate([r[:: max(1, len(r) // 20), cells].ravel() for r in recordings])
    steps = np.diff(np.unique(sample[np.isfinite(sample)]))
    steps = steps[steps > 1e-6 * layout.full_scale]  # what is finer is rounding
    step = float(steps.min()) if len(steps) else 0.0
    return max(_TOLERANCE * layout.full_scale, min(_STEPS * step, 2 * _TOLERANCE * layout.full_scale))


def _usual_duplicates(recordings: Sequence[NDArray[np.float64]], layout: SensorLayout, scale: Scale) -> int:
    """Return how many witnesses two healthy lines may have of being one: as ever, more if few recordings tell."""
    most = 0
    for recording in recordings:
        duplicates = DuplicateLines.begin(layout)
        for frames, numbers, start in segments(recording, SEGMENT, scale.near / 2):
            duplicates = duplicates.extend(frames, numbers, informative(frames, start <= numbers[0], scale), scale.near)
        most = max(most, duplicates.most)
    return most + max(0, int(np.ceil(np.log2(_TELLING / len(recordings)))))
