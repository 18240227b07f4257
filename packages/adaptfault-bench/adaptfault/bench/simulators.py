"""Touch sensors of simulators, as frames of an array and back.

MuJoCo's tactile sensor gives three numbers a taxel, channel after channel: depth in metres, 0 and
more, then the sliding speed along two tangents, in metres a second. A taxel is a vertex of the mesh
that the sensor names, in its order; ``<mesh builtin="plate" params="ROWS COLS"/>`` counts row after
row. It does not compile on a body without a geom that collides, and reads exactly 0 from objects
that are meshes. Measured with MuJoCo 4.0.1 (``tests/bench/test_profile.py``).

Genesis is by document only: nothing here was run with it. Its tactile sensors take a gain for each
probe, noise and resolution, and let probes die at random; which ones die cannot be stated, so that
F goes into what its ``read`` returns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.bench.logs import truth_of
from adaptfault.bench.profile import SensorProfile
from diagnostics import SensorLayout

__all__ = ["MujocoTactile", "genesis_options", "simulated_log"]

_CHANNELS = 3  # depth, and two tangents

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MujocoTactile:
    """Readings of tactile sensors of MuJoCo that are the pads of one array.

    Attributes:
        layout: the array.
        depth: at which a cell reads full scale, in metres. A cell reads in proportion below it.
        order: taxel of each cell, ``[D]``, counted through all sensors; None: in the order of the
            vertices.

    Raises:
        ValueError: a depth that is not positive, or an order that does not name each taxel once.
    """

    layout: SensorLayout
    depth: float
    order: Sequence[int] | None = None

    def __post_init__(self) -> None:
        if not 0 < self.depth < np.inf:
            raise ValueError(f"depth is {self.depth}: expected metres at full scale, above 0")
        if self.order is not None and sorted(self.order) != list(range(self.layout.n_cells)):
            raise ValueError(
                f"order names {len(set(self.order))} of {self.layout.n_cells} taxels: expected each"
                " once, counted from 0"
            )

    def loads(self, readings: ArrayLike) -> Floats:
        """Return the loads ``[n, D]`` of what the sensors give, for :meth:`SensorProfile.apply`.

        Args:
            readings: ``[n, 3 D]``, ``data.sensordata`` of these sensors in each step; of several
                sensors one behind the other.

        Raises:
            ValueError: another number of readings, or a negative depth.
        """
        depths = self._channels(readings)[:, :, 0].reshape(-1, self.layout.n_cells)
        if (depths < 0).any():
            raise ValueError(
                "a depth is negative: expected those of a tactile sensor, channel after channel"
            )
        return self._of_cells(depths) * (self.layout.full_scale / self.depth)

    def through(
        self, profile: SensorProfile, readings: ArrayLike, *, seed: int | None = None
    ) -> Floats:
        """Return ``readings [n, 3 D]`` as the sensor of a profile gives them, in the same form:
        depths go through the profile, and a cell of F slides nowhere.

        Raises:
            ValueError: readings of another number, or a profile of another array.
        """
        if profile.layout.shape != self.layout.shape:
            raise ValueError(
                f"the profile is of {profile.layout}, and the sensors of {self.layout}: give the"
                " profile of this array"
            )
        channels = self._channels(readings).copy()
        read = profile.apply(self.loads(readings), seed=seed)
        depths = self._of_taxels(read * (self.depth / self.layout.full_scale))
        channels[:, :, 0] = depths.reshape(channels[:, :, 0].shape)
        dead = self._of_taxels(profile.fault_set.mask[None])[0].reshape(channels.shape[1], -1)
        channels[:, :, 1:] = np.where(dead[None, :, None], 0.0, channels[:, :, 1:])
        return channels.reshape(len(channels), -1)

    def _channels(self, readings: ArrayLike) -> Floats:
        """Return readings as ``[n, pads, 3, taxels]``."""
        given = np.asarray(readings, np.float64)
        wanted = _CHANNELS * self.layout.n_cells
        if given.ndim != 2 or given.shape[1] != wanted:
            raise ValueError(
                f"readings are {list(given.shape)}: expected [n, {wanted}], depth and two tangents"
                f" of {self.layout.n_cells} taxels"
            )
        return given.reshape(len(given), self.layout.pads, _CHANNELS, -1)

    def _of_cells(self, values: NDArray[Any]) -> NDArray[Any]:
        return values if self.order is None else values[:, np.asarray(self.order)]

    def _of_taxels(self, values: NDArray[Any]) -> NDArray[Any]:
        return values if self.order is None else values[:, np.argsort(self.order)]


def simulated_log(
    profile: SensorProfile, loads: Sequence[ArrayLike], *, seed: int = 0
) -> tuple[list[Floats], dict[str, Any]]:
    """Return the recordings that the sensor of a profile makes of simulated ones, and the truth
    about them, which the simulator knows: what :meth:`adaptfault.bench.score.Score.add` takes.

    A fault counts where it makes a reading differ from that of the same sensor without it, with the
    same noise.

    Args:
        profile: with its faults.
        loads: ``[T, D]`` of each recording, in the unit of the layout, 0 untouched.
        seed: of noise and faults.

    Raises:
        ValueError: no recording, or one that does not fit the layout.
    """
    if not loads:
        raise ValueError("a log needs recordings of a simulator: [T, D] each")
    seeds = np.random.SeedSequence(seed).generate_state(len(loads)).tolist()
    whole = replace(profile, faults=())
    healthy = [whole.apply(one, seed=k) for one, k in zip(loads, seeds, strict=True)]
    read = [profile.apply(one, seed=k) for one, k in zip(loads, seeds, strict=True)]
    faults = profile.faults
    truth = truth_of(
        "simulated", np.concatenate(healthy), np.concatenate(read), faults, profile.layout
    )
    return read, truth


def genesis_options(profile: SensorProfile, *, normal_exponent: float = 1.0) -> dict[str, Any]:
    """Return options of a tactile sensor of Genesis, as ``gs.sensors.KinematicTaxel``, that read as
    a profile does; by document only, never run.

    They hold gain, noise and step. Offset, rest, crosstalk of lines and F have no option there: put
    what ``read`` returns through :meth:`SensorProfile.apply` instead, with a profile whose gain is
    1 and whose noise and step are 0.

    Args:
        profile: in newtons, with one probe a cell in the order of the cells.
        normal_exponent: of the sensor. Genesis multiplies the depth, and the force is the depth to
            this power.
    """
    return {
        "probe_gain": (profile.gain ** (1 / normal_exponent)).tolist(),
        "noise": float(np.median(profile.noise)),
        "resolution": profile.step,
        "dead_taxel_probability": 0.0,
    }
