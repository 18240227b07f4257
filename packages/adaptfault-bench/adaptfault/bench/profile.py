"""How one robot's sensor reads, as a profile that a simulator's readings go through.

A policy that is trained in simulation then meets the dead cells of this robot before it meets the
robot. With x the load of each cell in the simulator, 0 untouched::

    seen     = max(x_i, row share * largest x of the row, column share * largest x of the column)
    reading  = gain_i (rest_i + seen) + offset_i + noise_i N(0, 1)
    fault    : as :func:`diagnostics.inject`, for each fault
    reading  = rounded to whole steps of the converter, within 0 to full scale

Faults, rest, noise and step are those of a log; the shares are those of
:mod:`diagnostics.sensor.crosstalk`; gain and offset are those of pads that were replaced
(:mod:`diagnostics.sensor.recalibration`), 1 and 0 elsewhere.

Not in it: what the reference of the diagnosis has too, as gains of cells that never changed,
hysteresis, creep, and the skin's own spread of a load. A simulator has to model these.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.data.atomic import atomic_write
from adaptfault.data.documents import check_schema
from diagnostics import Diagnosis, Fault, FaultKind, FaultSet, SelfDiagnosis, SensorLayout, inject
from diagnostics.preprocessing.tolerance import converter_step

__all__ = ["SensorProfile"]

SCHEMA = "adaptfault.profile/1"
_OF_CELLS = ("rest", "gain", "offset", "noise")

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SensorProfile:
    """How one sensor reads.

    Attributes:
        layout: the array.
        faults: the faults of today, each from the first frame on.
        rest: float ``[D]``, what each cell reads untouched, in the unit of the layout.
        gain: float ``[D]``, of each cell against the healthy reference.
        offset: float ``[D]``, in the unit of the layout.
        noise: float ``[D]``, standard deviation of a reading untouched, in the unit of the layout.
        crosstalk: float ``[2, pads]``, share of the highest load of its row, and of its column,
            that a cell reads at least.
        step: of the converter, in the unit of the layout; 0: none.

    Raises:
        ValueError: numbers of another size, that are not finite, or that no sensor has.
    """

    layout: SensorLayout
    faults: tuple[Fault, ...]
    rest: Floats
    gain: Floats
    offset: Floats
    noise: Floats
    crosstalk: Floats
    step: float = 0.0

    def __post_init__(self) -> None:
        sizes: dict[str, tuple[int, ...]] = dict.fromkeys(_OF_CELLS, (self.layout.n_cells,))
        sizes["crosstalk"] = (2, self.layout.pads)
        for name, size in sizes.items():
            values = np.asarray(getattr(self, name), np.float64)
            if values.shape != size or not np.isfinite(values).all():
                raise ValueError(
                    f"{name} is {list(values.shape)}: expected finite numbers {list(size)}, of"
                    f" {self.layout}"
                )
            object.__setattr__(self, name, values)
        bad = [f.cells[-1] for f in self.faults if f.cells[-1] >= self.layout.n_cells]
        if bad:
            raise ValueError(
                f"a fault names cell {bad[0]}, and the array has {self.layout.n_cells}: give the"
                " profile of this array"
            )
        if (self.noise < 0).any() or not (self.gain > 0).all() or self.step < 0:
            raise ValueError("expected gains above 0, and noise and step of 0 or more")
        if not ((self.crosstalk >= 0) & (self.crosstalk < 1)).all():
            raise ValueError("crosstalk has a share outside 0 to 1")

    @classmethod
    def healthy(cls, layout: SensorLayout) -> SensorProfile:
        """Return that of a perfect sensor: readings go through unchanged."""
        zeros = np.zeros(layout.n_cells)
        ones = np.ones(layout.n_cells)
        return cls(layout, (), zeros, ones, zeros, zeros, np.zeros((2, layout.pads)))

    @classmethod
    def measured(
        cls,
        recordings: Sequence[ArrayLike],
        diagnosis: Diagnosis,
        diagnoser: SelfDiagnosis,
        *,
        gain: ArrayLike | None = None,
        offset: ArrayLike | None = None,
    ) -> SensorProfile:
        """Return that of a log and its diagnosis.

        Args:
            recordings: ``[T, D]`` each, in the unit of the layout.
            diagnosis: of them, whose faults are taken.
            diagnoser: that made it; its reference states what cells read untouched.
            gain, offset: of replaced pads, as ``inspection.recalibration`` or the active version
                of a bundle states them; None: none was replaced.

        Raises:
            ValueError: recordings that do not fit the layout.
        """
        layout = diagnosis.layout
        frames = [layout.check_recording(one, f"recording {i}") for i, one in enumerate(recordings)]
        if not frames:
            raise ValueError("a profile needs recordings: [T, D] each, in the unit of the layout")
        plain = cls.healthy(layout)
        reference = diagnoser.reference_
        rest = _lowest(frames) if reference is None else reference.scale.baseline
        rest = np.where(np.isfinite(rest), rest, 0.0)
        near = 0.02 * layout.full_scale if reference is None else reference.scale.near
        found = diagnoser.crosstalk(frames)
        return replace(
            plain,
            faults=tuple(_lasting(fault, rest) for fault in diagnosis.faults),
            rest=rest,
            gain=plain.gain if gain is None else np.asarray(gain, np.float64),
            offset=plain.offset if offset is None else np.asarray(offset, np.float64),
            noise=_noise(frames, rest + near, diagnosis.fault_set),
            crosstalk=plain.crosstalk if found is None else found.shares,
            step=converter_step(frames, layout),
        )

    @property
    def fault_set(self) -> FaultSet:
        """F, the cells of all faults."""
        return FaultSet.of([c for fault in self.faults for c in fault.cells], self.layout.n_cells)

    def apply(self, loads: ArrayLike, *, seed: int | None = None) -> Floats:
        """Return what this sensor reads of the frames of a simulator.

        Args:
            loads: ``[n, D]`` or ``[n, pads, rows, cols]``, in the unit of the layout, 0 untouched,
                frame after frame in time.
            seed: of noise, and of the faults that draw; None draws anew each time.

        Returns:
            float64 ``[n, D]``, within 0 to full scale.

        Raises:
            ValueError: frames that do not fit the layout.
        """
        given = self.layout.check_recording(loads, "loads")
        rng = np.random.default_rng(seed)
        seen = self._with_crosstalk(given)
        read = self.gain * (self.rest + seen) + self.offset
        read = read + self.noise * rng.standard_normal(read.shape)
        read = np.clip(read, 0.0, self.layout.full_scale)
        read = inject(read, self.faults, self.layout, seed=int(rng.integers(1 << 30)))
        if self.step:
            read = np.rint(read / self.step) * self.step
        return np.clip(read, 0.0, self.layout.full_scale)

    def _with_crosstalk(self, loads: Floats) -> Floats:
        if not self.crosstalk.any():
            return loads
        grids = self.layout.grid(loads)
        rows, columns = self.crosstalk[:, :, None, None]
        of_row = rows * np.fmax.reduce(grids, axis=3, keepdims=True)
        of_column = columns * np.fmax.reduce(grids, axis=2, keepdims=True)
        seen: Floats = np.maximum(grids, np.fmax(of_row, of_column)).reshape(loads.shape)
        return seen

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads; its schema is
        ``adaptfault.profile/1``."""
        numbers = {name: getattr(self, name).tolist() for name in (*_OF_CELLS, "crosstalk")}
        faults = [fault.to_dict() for fault in self.faults]
        layout = self.layout.to_dict()
        return {"schema": SCHEMA, "layout": layout, "faults": faults, **numbers, "step": self.step}

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> SensorProfile:
        """Rebuild from :meth:`to_dict`.

        Raises:
            ValueError: another schema, or a field that is missing or damaged.
        """
        check_schema(d, SCHEMA)
        try:
            faults = tuple(Fault.from_dict(one) for one in d["faults"])
            layout = SensorLayout.from_dict(d["layout"])
            numbers = {name: np.asarray(d[name], float) for name in (*_OF_CELLS, "crosstalk")}
            return cls(layout, faults, step=float(d["step"]), **numbers)
        except KeyError as error:
            raise ValueError(f"the profile is damaged: {error} is missing") from None
        except TypeError as error:
            raise ValueError(f"the profile is damaged: {error}") from None

    def write(self, path: str | PathLike[str]) -> None:
        """Write it as JSON."""
        atomic_write(Path(path), json.dumps(self.to_dict(), indent=1).encode())

    @classmethod
    def read(cls, path: str | PathLike[str]) -> SensorProfile:
        """Read what :meth:`write` wrote.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is no profile.
        """
        try:
            return cls.from_dict(json.loads(Path(path).read_bytes()))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path}: {error}; write it with SensorProfile.write") from None


def _lasting(fault: Fault, rest: Floats) -> Fault:
    """Return a fault as it is from now on; one that states no value holds what its cells rest
    at."""
    value = fault.value
    if fault.kind is FaultKind.STUCK and value is None:
        value = float(np.median(rest[list(fault.cells)]))
    return replace(fault, onset=None, recordings=None, value=value)


def _lowest(frames: Iterable[Floats]) -> Floats:
    """Return the low quantile of each cell over a log, ``[D]``."""
    found: Floats = np.nanquantile(np.concatenate(list(frames)), 0.1, axis=0)
    return found


def _noise(frames: Sequence[Floats], untouched: Floats, faulty: FaultSet) -> Floats:
    """Return the standard deviation of each cell untouched, ``[D]``: of the differences of
    successive frames below ``untouched``; of a faulty one, and one always touched, the median of
    the others."""
    squares = np.zeros(len(untouched))
    count = np.zeros(len(untouched))
    for one in frames:
        at_rest = one <= untouched
        still = at_rest[1:] & at_rest[:-1]
        change = np.where(still, np.diff(one, axis=0), 0.0)
        squares += (change**2).sum(axis=0)
        count += still.sum(axis=0)
    known = (count > 0) & ~faulty.mask
    deviation = np.sqrt(squares / np.maximum(2 * count, 1))
    usual = float(np.median(deviation[known])) if known.any() else 0.0
    return np.where(known, deviation, usual)
