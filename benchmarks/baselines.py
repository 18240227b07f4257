"""Methods beside ours, by the doors that are open to all, in the folder ``benchmarks``:

    python diagnosis.py --method baselines:Constant
    python -m adaptfault.bench run FOLDER --diagnoser baselines:Constant --out constant.json
    python -m adaptfault.bench run FOLDER --repairer baselines:Trees --out trees.json

Public tools (``pip install 'adaptfault[compare]'``) have the settings they ship with.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable

import numpy as np
from compare_tools import Known, mne_lof, pyprep_ransac, spikeinterface_r2
from repair import PEERS, summary
from sklearn.impute import KNNImputer

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


class Saqc:
    """SaQC's flagConstants, with its threshold of 0: a cell is faulty if it is constant over the
    last quarter of the log."""

    def fit(self, recordings: list[np.ndarray], layout: SensorLayout) -> Saqc:
        """Learn nothing."""
        return self

    def detect(self, recordings: list[np.ndarray]) -> np.ndarray:
        """Return bool ``[D]``."""
        import pandas as pd
        from saqc import SaQC

        whole = np.concatenate(recordings)
        times = pd.date_range("2000-01-01", periods=len(whole), freq="s")
        names = [str(cell) for cell in range(whole.shape[1])]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what SaQC calls of pandas is deprecated
            quality = SaQC(pd.DataFrame(whole, index=times, columns=names))
            quality = quality.flagConstants(names, window=round(LASTING * len(whole)))
            flags = quality.flags.to_pandas()
        return np.array([flags[name].iloc[-1] > 0 for name in names])


class Tool:
    """A public tool as :mod:`compare_tools` calls it."""

    def fit(self, recordings: list[np.ndarray], layout: SensorLayout) -> Tool:
        """Keep the layout; the tools learn nothing."""
        self.known = Known(layout, np.concatenate(recordings))
        return self

    def detect(self, recordings: list[np.ndarray]) -> np.ndarray:
        """Return bool ``[D]``."""
        found = [int(cell) for cell in self.call(recordings)]
        return np.isin(np.arange(self.known.layout.n_cells), found)

    def call(self, log: list[np.ndarray]) -> Iterable[int | str]:
        """Return the cells that the tool calls bad."""
        raise NotImplementedError


class MneLof(Tool):
    """MNE, find_bad_channels_lof."""

    def call(self, log: list[np.ndarray]) -> Iterable[int | str]:
        """Return bad channels."""
        return mne_lof(self.known, 1.5, log)


class Pyprep(Tool):
    """pyprep, RANSAC."""

    def call(self, log: list[np.ndarray]) -> Iterable[int | str]:
        """Return bad channels."""
        return pyprep_ransac(self.known, 0.75, log)


class SpikeInterface(Tool):
    """SpikeInterface, neighborhood_r2."""

    def call(self, log: list[np.ndarray]) -> Iterable[int | str]:
        """Return bad channels."""
        return spikeinterface_r2(self.known, 0.9, log)


class Trees:
    """ExtraTrees, trained anew on the healthy cells."""

    def fit(self, x: np.ndarray, y: np.ndarray, faults: np.ndarray, layout: SensorLayout) -> Trees:
        """Train."""
        self.healthy = ~faults
        self.trees = PEERS["trees"]().set_params(n_jobs=1).fit(summary(x[..., self.healthy]), y)
        return self

    def predict(self, x: np.ndarray) -> np.ndarray:
        """Return classes ``[N]``."""
        return self.trees.predict(summary(x[..., self.healthy]))


class Zeros:
    """ExtraTrees trained before the fault; dead cells read 0."""

    def fit(self, x: np.ndarray, y: np.ndarray, faults: np.ndarray, layout: SensorLayout) -> Zeros:
        """Train if there are no trees yet."""
        self.faults = faults
        self.x = x
        if not hasattr(self, "trees"):
            self.trees = PEERS["trees"]().set_params(n_jobs=1).fit(summary(x), y)
        return self

    def filled(self, x: np.ndarray) -> np.ndarray:
        """Return windows whose dead cells are filled."""
        return np.where(self.faults, 0.0, x)

    def predict(self, x: np.ndarray) -> np.ndarray:
        """Return classes ``[N]``."""
        return self.trees.predict(summary(self.filled(x)))


class Mean(Zeros):
    """The same; dead cells read their mean in training."""

    def filled(self, x: np.ndarray) -> np.ndarray:
        """Return windows whose dead cells are filled."""
        return np.where(self.faults, self.x.mean(axis=(0, 1)), x)


class Knn(Zeros):
    """The same; dead cells read what they do in the nearest frames of training
    (``KNNImputer``)."""

    def filled(self, x: np.ndarray) -> np.ndarray:
        """Return windows whose dead cells are filled."""
        imputer = KNNImputer(keep_empty_features=True).fit(self.x.reshape(-1, x.shape[2]))
        missing = np.where(self.faults, np.nan, x)
        return imputer.transform(missing.reshape(-1, x.shape[2])).reshape(x.shape)
