"""The check of recordings that are open or in memory: what a command and a training script do."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray

from adaptfault.data.recordings import Opened, Recordings
from adaptfault.data.recordings.facts.rates import Clock
from adaptfault.data.recordings.opened import PART
from adaptfault.data.summary import summary_of
from adaptfault.inspection.begins import Begins
from adaptfault.inspection.code import Need
from adaptfault.inspection.data_set import DataSetCheck
from adaptfault.inspection.naming import Naming
from adaptfault.inspection.result import Inspection
from adaptfault.inspection.stands_still import StandsStill
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.sensor.shared import measured


def check_log(
    log: Opened | Recordings,
    inspection: Inspection,
    *,
    left_out: int = 0,
    compared: bool = False,
    grouped: bool = False,
    source: str = "",
) -> DataSetCheck:
    """Return the health of a data set, from an inspection of it.

    Args:
        log: the data set.
        inspection: of its recordings, with their classes.
        left_out: recordings and files that could not be read.
        compared: whether the inspection had healthy recordings to compare with.
        grouped: whether anything else than classes divides the recordings.
        source: what the data set is called.
    """

    def recordings() -> Iterator[NDArray[Any]]:
        for frames in log:
            yield from measured(RecordingBlocks([frames]), log.layout)

    clock = log.clock if isinstance(log, Opened) else Clock()
    summary = summary_of(log)
    given: set[Need] = set()
    if compared:
        given.add("reference")
    if clock.jitter is not None:
        given.add("times")
    in_memory = int(summary.lengths.sum()) * log.layout.n_cells <= PART
    if (log.labels is not None or grouped) and in_memory:
        given.add("classes")
    begins = Begins.of(recordings(), log.layout)
    begun, tared = begins.in_contact(log.names, log.layout)
    naming = Naming.of(log)
    still = StandsStill.of(([frames] for frames in log), log.layout)
    return DataSetCheck(
        naming.of_inspection(inspection),
        summary,
        clock,
        left_out,
        begun,
        tared,
        frozenset(given),
        source,
        naming,
        stood_still=still.told(naming.recordings),
    )
