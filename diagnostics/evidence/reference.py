"""The reference: everything fitted on fault-free recordings, and default values for a cold
start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.intermittency import HealthyRates
from diagnostics.evidence.usual_duplicates import UsualDuplicates
from diagnostics.model.judge import Model
from diagnostics.preprocessing.baseline import baseline
from diagnostics.preprocessing.noise import UsualNoise
from diagnostics.preprocessing.offset import ReferenceOffset, levelled, levels
from diagnostics.preprocessing.readings import SEGMENT, RecordingBlocks
from diagnostics.preprocessing.scale import Scale
from diagnostics.preprocessing.tolerance import TOLERANCE, converter_step, tolerance_of
from diagnostics.preprocessing.transport import Patience
from diagnostics.sensor.gain import UsualSizes

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout


@dataclass(frozen=True)
class Reference:
    """Everything fitted on fault-free recordings.

    Attributes:
        tolerance: readings within +- this of a value count as that value, in the layout's unit.
        scale: baseline and full scale.
        offset: common offset of all cells.
        patience: repetitions of a frame after which it carries no information.
        usual: rates of blinks and excess noise of healthy cells.
        duplicates: coincidences that two healthy lines may have, and how often each pair agrees.
        model: of the array; None: unknown, or no cell moves.
        dead: float ``[D]``, P(dead) of the reference faults, 0 for all other cells.
        loaded_patience: the same of a frame with load; 0: as ``patience``.
        noise: what all cells have; None: unknown.
        sizes: how far cells move (:mod:`diagnostics.sensor.gain`); None: unknown.
        floors: float ``[2, pads]``, share of the highest reading of its row or column that hardly
            any cell reads less of (:mod:`diagnostics.sensor.crosstalk`); None: unknown.
    """

    tolerance: float
    scale: Scale
    offset: ReferenceOffset
    patience: int
    usual: HealthyRates
    duplicates: UsualDuplicates
    model: Model | None
    dead: NDArray[np.float64]
    loaded_patience: int = 0
    noise: UsualNoise | None = None
    sizes: UsualSizes | None = None
    floors: NDArray[np.float64] | None = None

    def repeats(self, layout: SensorLayout) -> Patience:
        """Return how often healthy frames repeat."""
        present = living(layout, self.dead).is_cell
        loaded_from = np.where(present, self.scale.baseline + self.scale.near, np.inf)
        return Patience(self.patience, self.loaded_patience or self.patience, loaded_from)

    def check(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: one is not positive.
        """
        rates = (self.usual.blinks, self.usual.blinks_count, self.usual.noise_counts)
        positive = (
            self.tolerance,
            self.scale.near,
            self.patience,
            *rates,
        )
        if not min(positive) > 0:
            raise ValueError(
                f"expected positive tolerance, near, patience and rates, got {positive}"
            )

    @classmethod
    def fit(
        cls,
        recordings: Sequence[NDArray[np.float64]],
        layout: SensorLayout,
        dead: NDArray[np.float64] | None = None,
    ) -> Reference:
        """Fit all but the model to fault-free recordings, ``[T, D]`` each, without the cells that
        are ``dead`` (P(dead) ``[D]``)."""
        tolerance = tolerance_of(recordings, layout)
        dead = np.zeros(layout.n_cells) if dead is None else dead
        layout = living(layout, dead)
        present = layout.is_cell
        level = levels(recordings, present, layout.full_scale)
        recordings = levelled(recordings, level)
        highest = baseline(recordings, present, tolerance, layout.full_scale)
        # The baseline of a dead cell is unknown.
        rest = np.where(dead > 0, np.median(highest[present]), highest)
        scale = Scale(rest, 2 * tolerance, layout.full_scale)
        patience = Patience.fit(recordings, np.where(present, rest + scale.near, np.inf), SEGMENT)
        return cls(
            tolerance,
            scale,
            ReferenceOffset.fit(recordings, scale, present, float(np.ptp(level))),
            patience.idle,
            HealthyRates.fit(recordings, scale, layout),
            UsualDuplicates.fit(recordings, layout, scale),
            None,
            dead,
            # At another level every cell seems loaded.
            patience.idle if level.any() else patience.loaded,
            noise=UsualNoise.fit(recordings, present, converter_step(recordings, layout)),
        )

    @classmethod
    def unknown(cls, layout: SensorLayout, rest: NDArray[np.float64] | None = None) -> Reference:
        """Return the defaults of a cold start: baselines ``rest`` (``[D]``; None: 0)."""
        tolerance = TOLERANCE * layout.full_scale
        rest = np.zeros(layout.n_cells) if rest is None else rest
        scale = Scale(rest, 2 * tolerance, layout.full_scale)
        return cls(
            tolerance,
            scale,
            ReferenceOffset(0.0, tolerance),
            2 * SEGMENT,
            HealthyRates.unknown(),
            UsualDuplicates.unknown(layout),
            None,
            np.zeros(layout.n_cells),
        )


def living(layout: SensorLayout, dead: NDArray[np.float64]) -> SensorLayout:
    """Return a layout without the cells that are ``dead`` (P(dead) ``[D]``)."""
    return (
        replace(layout, present=layout.present & ~layout.grid(dead > 0)) if dead.any() else layout
    )


def highest_reading(recordings: Sequence[NDArray[np.float64]], layout: SensorLayout) -> float:
    """Return the highest reading of a present cell that moves; full scale, if none moves above
    0."""
    low, high = RecordingBlocks.of(recordings).extremes()
    moved = layout.is_cell & (high > low) & (high > 0)
    return float(high[moved].max()) if moved.any() else layout.full_scale
