"""How often healthy lines read the same: in all, and each pair of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.constant_runs import segments
from diagnostics.evidence.duplicate_lines import DuplicateLines, agreement, informative

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout
    from diagnostics.preprocessing.scale import Scale

_COLD = 5  # coincidences that two healthy lines may have, in a cold start
_MANY = 250  # recordings after which the largest count seen is the limit; one more for each halving


@dataclass(frozen=True)
class UsualDuplicates:
    """Agreement of healthy lines.

    Attributes:
        most: coincidences that two healthy lines may have.
        shares: float ``[pads, pairs]``, P(a pair agrees where it can), rows before columns.
    """

    most: int
    shares: NDArray[np.float64]

    @classmethod
    def fit(
        cls, recordings: Sequence[NDArray[np.float64]], layout: SensorLayout, scale: Scale
    ) -> UsualDuplicates:
        """Fit to healthy recordings ``[T, D]``: the largest count seen in one of them, plus
        log2(250 / recordings), and how often each pair agreed in all."""
        most = 0
        agreed = DuplicateLines.begin(layout).agreed
        for recording in recordings:
            duplicates = DuplicateLines.begin(layout)
            for frames, numbers, runs in segments(recording, scale):
                moving = informative(frames, runs.start <= numbers[0], scale)
                duplicates = duplicates.extend(frames, numbers, moving, scale.near)
            most = max(most, duplicates.most)
            agreed = agreed + duplicates.agreed
        most += max(0, int(np.ceil(np.log2(_MANY / len(recordings)))))
        return cls(most, agreement(agreed))

    @classmethod
    def unknown(cls, layout: SensorLayout) -> UsualDuplicates:
        """Return the defaults of a cold start."""
        return cls(_COLD, agreement(DuplicateLines.begin(layout).agreed))
