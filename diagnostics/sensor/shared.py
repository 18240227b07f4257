"""What the array as a whole does in a log, found before any cell is judged.

Frames that measured nothing are left out, and cells that all show one signal are told as that and
take no part. The diagnosis of the cells then works on what is left, knowing of crosstalk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.decision.result import Diagnosis
from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import RARE
from diagnostics.preprocessing.transport import TransportFault
from diagnostics.sensor.crosstalk import Crosstalk
from diagnostics.sensor.odd_frames import OddFrame, evenly, find_odd_frames, without_odd_frames
from diagnostics.sensor.one_signal import OneSignal, find_one_signal
from diagnostics.sensor.repeated_frames import find_repeated_frames

if TYPE_CHECKING:
    from diagnostics.preprocessing.readings import RecordingBlocks

_LISTED = 5
_FEWEST_PERIODS = 3
_REGULAR = 0.2  # of a period, by which half of the periods may differ


@dataclass(frozen=True)
class Shared:
    """What the array as a whole does in a log.

    Attributes:
        recordings: ``[T, D]`` each, without odd frames; NaN where cells show one signal.
        layout: the array.
        faults: how it is told.
        one_signal: the groups of cells that show one signal.
        crosstalk: of lines; None: as in the reference.
    """

    recordings: list[NDArray[Any]]
    layout: SensorLayout
    faults: tuple[TransportFault, ...] = ()
    one_signal: tuple[OneSignal, ...] = ()
    crosstalk: Crosstalk | None = None

    @classmethod
    def of(cls, log: RecordingBlocks, layout: SensorLayout) -> Shared:
        """Return what the array does in a log, ``[T, D]`` each, in the layout's unit."""
        recordings = log.given
        valid = log.valid(layout.full_scale, layout.is_cell)
        groups = find_one_signal(evenly(valid.given), layout)
        cells = [cell for group in groups for cell in group.cells]
        if cells:
            recordings = [_missing(frames, cells) for frames in recordings]
        odd = find_odd_frames(recordings, layout)
        recordings = without_odd_frames(recordings, odd, layout)
        begins = np.cumsum([0, *map(len, recordings)])
        faults = _told(odd, begins, layout)
        repeated = find_repeated_frames(recordings, layout)
        if repeated is not None:
            n_repeated = round(repeated.share * int(begins[-1]))
            text = repeated.reason(layout.rate)
            faults.append(TransportFault("repeated_frames", 0, n_repeated, text))
        faults += [TransportFault("one_signal", 0, int(begins[-1]), one.reason) for one in groups]
        return cls(recordings, layout, tuple(faults), groups)

    def beside(self, crosstalk: Crosstalk | None) -> Shared:
        """Return it with the crosstalk of its lines."""
        if crosstalk is None:
            return self
        n_frames = sum(map(len, self.recordings))
        told = TransportFault("crosstalk", 0, n_frames, crosstalk.reason)
        return replace(self, crosstalk=crosstalk, faults=(*self.faults, told))

    @property
    def mask(self) -> NDArray[np.bool_]:
        """The cells that show one signal, bool ``[D]``."""
        mask = np.zeros(self.layout.n_cells, bool)
        mask[[cell for group in self.one_signal for cell in group.cells]] = True
        return mask

    @property
    def explains_all(self) -> bool:
        """Whether no cell is left to judge."""
        return bool(self.mask[self.layout.is_cell].all())

    def diagnosis(self) -> Diagnosis:
        """Return the diagnosis of a log in which no cell is left to judge."""
        n_cells = self.layout.n_cells
        nothing = Diagnosis(
            layout=self.layout,
            faults=(),
            probability=np.zeros(n_cells),
            tested=np.zeros(n_cells, bool),
            n_frames=sum(map(len, self.recordings)),
            n_recordings=len(self.recordings),
        )
        return self.told(nothing)

    def told(self, diagnosis: Diagnosis) -> Diagnosis:
        """Return the diagnosis of the other cells with what the array as a whole does."""
        if not self.faults:
            return diagnosis
        mask = self.mask
        probability = np.where(mask, 1 - RARE, diagnosis.probability)
        others = [_without(fault, mask) for fault in diagnosis.faults]
        possible = [_without(wire, mask) for wire in diagnosis.possible]
        groups = [
            Fault(FaultKind.ALIAS, one.cells, probability=1 - RARE, reason=one.reason)
            for one in self.one_signal
        ]
        return replace(
            diagnosis,
            faults=(*groups, *(fault for fault in others if fault is not None)),
            possible=tuple(wire for wire in possible if wire is not None),
            probability=probability,
            tested=diagnosis.tested | mask,
            transport=tuple(dict.fromkeys((*self.faults, *diagnosis.transport))),
        )


def _missing(frames: NDArray[Any], cells: list[int]) -> NDArray[np.float64]:
    """Return frames ``[T, D]`` in which some cells have no reading."""
    without = np.array(frames, dtype=np.float64)
    without[:, cells] = np.nan
    return without


def measured(log: RecordingBlocks, layout: SensorLayout) -> list[NDArray[Any]]:
    """Return recordings ``[T, D]`` without their odd frames; those without any are not copied."""
    return without_odd_frames(log.given, find_odd_frames(log.given, layout), layout)


def _without(fault: Fault, mask: NDArray[np.bool_]) -> Fault | None:
    """Return a fault if some of its cells are not in the mask, bool ``[D]``."""
    return None if mask[list(fault.cells)].all() else fault


def _told(
    odd: Sequence[OddFrame], begins: NDArray[np.intp], layout: SensorLayout
) -> list[TransportFault]:
    """Return how odd frames are told; ``begins``: number of the first frame of each recording in
    the log."""
    faults = []
    corrupt = [one for one in odd if one.kind == "corrupt"]
    if corrupt:
        text = f"{_counted(corrupt)} corrupt: {_places(corrupt, layout)}; left out, check the link"
        onset = int(begins[corrupt[0].recording]) + corrupt[0].frame
        faults.append(TransportFault("corrupt_frame", onset, len(corrupt), f"{text} to the sensor"))
    spikes = [one for one in odd if one.kind == "spike"]
    if spikes:
        size = float(np.median([one.size for one in spikes]))
        text = f"all cells{_pads(spikes[0], layout)} jump together for one frame"
        text += f"{_period(spikes, layout.rate)}, by {abs(size):.3g} {layout.unit}"
        text += f" ({_counted(spikes, verb=False)}: {_places(spikes, layout)}); left out, check"
        onset = int(begins[spikes[0].recording]) + spikes[0].frame
        faults.append(
            TransportFault("common_spike", onset, len(spikes), f"{text} the supply and the ground")
        )
    return faults


def _counted(odd: Sequence[OddFrame], *, verb: bool = True) -> str:
    if len(odd) == 1:
        return "1 frame is" if verb else "1 frame"
    return f"{len(odd)} frames are" if verb else f"{len(odd)} frames"


def _places(odd: Sequence[OddFrame], layout: SensorLayout) -> str:
    """Return where the first odd frames are."""
    places = [
        f"frame {one.frame} of recording {one.recording}{_pads(one, layout)}"
        for one in odd[:_LISTED]
    ]
    more = f" and {len(odd) - _LISTED} more" if len(odd) > _LISTED else ""
    return f"{', '.join(places)}{more}"


def _pads(one: OddFrame, layout: SensorLayout) -> str:
    if len(one.pads) == layout.pads:
        return ""
    return f" of pad{'s' * (len(one.pads) > 1)} {', '.join(map(str, one.pads))}"


def _period(odd: Sequence[OddFrame], rate: float) -> str:
    """Return after which time odd frames come again; empty where they are not regular."""
    periods = [
        second.frame - first.frame
        for first, second in pairwise(odd)
        if first.recording == second.recording
    ]
    if len(periods) < _FEWEST_PERIODS:
        return ""
    period = float(np.median(periods))
    differ = np.abs(np.array(periods) - period)
    if np.median(differ) > _REGULAR * period:
        return ""
    return f", every {period / rate:.2g} s"
