"""Simple detectors beside ours: python benchmarks/diagnosis.py --method baselines:Constant

Each has ``fit`` and ``detect``, as any detector of ``--method`` does.
"""

from __future__ import annotations

import numpy as np

from diagnostics import SensorLayout

LASTING = 0.25  # share of the log that an anomaly at its end covers


class Constant:
    """A cell is faulty if it reads one and the same in the whole log: peak to peak is 0, or there
    is no reading."""

    def fit(self, recordings: list[np.ndarray], layout: SensorLayout) -> Constant:
        """Learn nothing."""
        return self

    def detect(self, recordings: list[np.ndarray]) -> np.ndarray:
        """Return bool ``[D]``; missing readings are left out."""
        whole = np.concatenate(recordings)
        moved = np.fmax.reduce(whole) > np.fmin.reduce(whole)
        return ~moved


class Capa:
    """CAPA of skchange, for each cell by itself: a cell is faulty if an anomalous segment lasts to
    the end of the log and covers a quarter of it.

    Readings are standardised with median and standard deviation of the reference; a missing reading
    counts as the median. The settings of CAPA are its defaults, except that a segment may be as
    long as the log.

    Raises:
        ImportError: skchange is missing.
    """

    def __init__(self) -> None:
        try:
            from skchange.detectors import CAPA
        except ImportError:
            raise ImportError(
                "baselines:Capa needs skchange 0.18 or newer, which is missing: pip install"
                " 'skchange>=0.18'"
            ) from None
        self.capa = CAPA

    def fit(self, recordings: list[np.ndarray], layout: SensorLayout) -> Capa:
        """Learn median and standard deviation of each cell."""
        whole = np.concatenate(recordings)
        seen = np.isfinite(whole).any(axis=0)
        self.level = np.where(seen, np.nanmedian(np.where(seen, whole, 0.0), axis=0), 0.0)
        spread = np.nanstd(np.where(seen, whole, 0.0), axis=0)
        least = layout.full_scale / 4095
        self.spread = np.maximum(spread, least)
        self.reference = self.standard(whole)
        return self

    def standard(self, whole: np.ndarray) -> np.ndarray:
        """Return readings in standard deviations above the median, ``[T, D]``."""
        return np.nan_to_num((whole - self.level) / self.spread)

    def detect(self, recordings: list[np.ndarray]) -> np.ndarray:
        """Return bool ``[D]``."""
        x = self.standard(np.concatenate(recordings))
        length = len(x)
        faulty = np.zeros(x.shape[1], dtype=bool)
        for cell in range(x.shape[1]):
            detector = self.capa(max_segment_length=length)
            detector.fit(self.reference[:, [cell]])
            segments = detector.predict_segment_anomalies(x[:, [cell]])
            faulty[cell] = any(
                end == length and end - start >= LASTING * length for start, end in segments
            )
        return faulty
