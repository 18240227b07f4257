"""One decision for a whole contact: class probabilities accumulated over its windows, reset at its
release.

The windows of one contact are dependent. With n windows of independent frames so far, the
accumulated probabilities are

    log p(c) = n_eff mean_t log p_t(c) + const,    n_eff = n / (1 + (n - 1) rho)

n_eff is the effective sample size of a mean of equally correlated values (design effect, Kish
1965). With rho = 1 the result is the geometric mean of the windows, with rho = 0 their product. rho
minimises the cross entropy of the accumulated probabilities on validation recordings, so that these
are calibrated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from adaptfault.data.documents import members, rebuilt

_REST = 0.1  # quantile of a cell's readings that is its reading without contact
_BEGINS = 0.1  # load at which a contact begins, as a share of the median peak load of a recording
_RELEASED = 0.3  # share of a contact's load that is left when it ends, as for contact events
_LEAST = np.finfo(np.float32).tiny  # probability


@dataclass(frozen=True)
class ContactStatistics:
    """What a decision about a contact needs to know; estimated on validation windows.

    Attributes:
        rest: ``[D]``, reading of each cell without contact, on the 0..1 scale.
        begins: load at which a contact begins. The load is the mean excess of the healthy cells
            over ``rest``.
        dependence: rho.
    """

    rest: tuple[float, ...]
    begins: float
    dependence: float

    @classmethod
    def fit(
        cls,
        x: NDArray[np.float32],
        probabilities: NDArray[Any],
        y: NDArray[np.int64],
        recording: NDArray[np.int64],
    ) -> ContactStatistics:
        """Estimate from windows that do not overlap.

        Args:
            x: windows ``[N, T, D]``.
            probabilities: of the classes of each window ``[N, n_classes]``, by a model that was
                fitted without it.
            y: class of each window ``[N]``.
            recording: of each window ``[N]``; its windows are in the order of time.
        """
        # positions without a cell may hold anything
        x = np.nan_to_num(x, nan=0.0, posinf=0.0, neginf=0.0)
        rest = np.quantile(x.reshape(-1, x.shape[2]), _REST, axis=0).astype(np.float32)
        load = np.maximum(x - rest, 0.0).mean(axis=2).max(axis=1)
        peaks = [load[recording == number].max() for number in np.unique(recording)]
        return cls(
            tuple(rest.tolist()),
            float(_BEGINS * np.median(peaks)),
            _dependence(probabilities, y, recording),
        )

    @classmethod
    def unknown(cls, n_cells: int) -> ContactStatistics:
        """Return the cautious values for a model that was stored without: any load is a contact,
        rho is 1."""
        return cls((0.0,) * n_cells, 0.0, 1.0)

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> ContactStatistics:
        """Build from the dict of :meth:`to_dict`."""
        return rebuilt(d, cls)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return members(self)


class ContactDecision:
    """Accumulates the probabilities of windows that end within one contact.

    A contact begins where the load rises by ``begins`` over its lowest value since the last
    release, and ends where 30 % of its load is left. It does not see that one object is exchanged
    for another without a release, and a cell that is stuck at a high reading and not in F may hide
    a release.

    Args:
        statistics: of the model.
        healthy: bool ``[D]``, cells whose load counts.
        length: frames in a window; windows that overlap count as one for each ``length`` of them.
    """

    def __init__(
        self,
        statistics: ContactStatistics,
        healthy: Sequence[bool] | NDArray[np.bool_],
        length: int,
    ) -> None:
        self.statistics = statistics
        self.healthy = np.asarray(healthy, dtype=bool)
        self.length = length
        self._rest = np.asarray(statistics.rest, dtype=np.float32)
        self.reset()

    def reset(self) -> None:
        """Begin a new recording, without contact."""
        self._lowest = self._highest = 0.0
        self._contact = False
        self._forget()

    def _forget(self) -> None:
        self._sum: NDArray[np.float64] | None = None
        self._count = 0

    def update(
        self, frame: NDArray[np.float32], probabilities: NDArray[np.float32] | None
    ) -> NDArray[np.float32] | None:
        """Process one frame.

        Args:
            frame: ``[D]``, on the 0..1 scale, without NaN.
            probabilities: ``[n_classes]`` of the window that ends with it; None: no window is full
                yet.

        Returns:
            The probabilities ``[n_classes]`` of the contact so far; None without contact or window.
        """
        load = float(np.maximum(frame - self._rest, 0.0)[self.healthy].mean())
        self._follow(load)
        if not self._contact or probabilities is None:
            return None
        logs = np.log(np.maximum(probabilities.astype(np.float64), _LEAST))
        self._sum = logs if self._sum is None else self._sum + logs
        self._count += 1
        n = 1 + (self._count - 1) / self.length
        effective = n / (1 + (n - 1) * self.statistics.dependence)
        return softmax(effective * self._sum / self._count).astype(np.float32)

    def _follow(self, load: float) -> None:
        """Decide whether there is a contact; forget the last one at its release."""
        if self._contact:
            self._highest = max(self._highest, load)
            if load - self._lowest > _RELEASED * (self._highest - self._lowest):
                return
            self._contact = False
            self._lowest = load
            self._forget()
        self._lowest = min(self._lowest, load)
        if load - self._lowest > self.statistics.begins:
            self._contact = True
            self._highest = load


def _dependence(
    probabilities: NDArray[Any], y: NDArray[np.int64], recording: NDArray[np.int64]
) -> float:
    """Return the rho with the lowest cross entropy of the probabilities accumulated over each first
    n windows."""
    from scipy.optimize import minimize_scalar

    logs = np.log(np.maximum(np.asarray(probabilities, dtype=np.float64), _LEAST))
    means = np.empty_like(logs)
    n = np.empty(len(logs))
    for number in np.unique(recording):
        of_it = np.flatnonzero(recording == number)
        n[of_it] = np.arange(1, len(of_it) + 1)
        means[of_it] = logs[of_it].cumsum(axis=0) / n[of_it, None]

    def loss(rho: float) -> float:
        likely = softmax((n / (1 + (n - 1) * rho))[:, None] * means, axis=1)
        return float(-np.log(np.maximum(likely[np.arange(len(y)), y], _LEAST)).mean())

    return (
        float(minimize_scalar(loss, bounds=(0.0, 1.0), method="bounded").x) if n.max() > 1 else 1.0
    )
