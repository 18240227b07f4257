"""Whole frames of a running sensor for a policy, from its bundle. Needs no LeRobot."""

from __future__ import annotations

import logging
import threading

import numpy as np
from numpy.typing import NDArray

from adaptfault.acquisition.followed import BundleAt, Follower
from adaptfault.acquisition.relay import FrameRepair
from adaptfault.acquisition.watch import Watch
from adaptfault.lerobot.limits import Limits, NotCertified
from diagnostics import Fault, FaultSet, SensorLayout

_log = logging.getLogger(__name__)

Frames = NDArray[np.float64]
Mask = NDArray[np.bool_]


class LiveTouch:
    """Restores and monitors the frames of one sensor, and follows its bundle.

    A thread of its own monitors them: no frame waits for an evaluation.

    Args:
        bundle: of the sensor.
        watch: monitor the frames that come alone, one after the other as the sensor sends them.
        limits: what must hold before a frame is given out.

    Attributes:
        layout: the array.

    Raises:
        ValueError, OSError: the bundle cannot be read.
    """

    def __init__(
        self, bundle: BundleAt, *, watch: bool = True, limits: Limits | None = None
    ) -> None:
        self._follower = Follower(bundle.sensor, bundle.path)
        self._watch = Watch(self._follower.sensor)
        self._watches = watch
        self._monitoring: threading.Thread | None = None
        self._limits = limits or Limits()
        self.layout: SensorLayout = self._watch.layout
        self._decide()

    @property
    def fault_set(self) -> FaultSet:
        """F, the cells that are filled in every frame."""
        return self._repair.fault_set

    @property
    def version(self) -> int:
        """Number of the version of the bundle."""
        version = self._watch.sensor.version
        assert version is not None  # a bundle has one
        return version.number

    def remember(self, faulty: FaultSet) -> None:
        """Fill these cells too: an earlier run found them faulty."""
        self._watch.remember(faulty)
        self._decide()

    def __call__(self, received: Frames, given: Mask) -> tuple[Frames, Mask, Mask]:
        """Return whole frames, which of their readings are valid, and which are not those that
        came, all ``[n, D]``.

        One frame is the next of the sensor. Several follow each other in no order that is known, as
        a batch of a training: they are filled, and not monitored.

        Args:
            received: ``[n, D]``, in the unit in which the sensor sends.
            given: bool ``[n, D]``, False where a reading is known to be none.

        Raises:
            NotCertified: a limit does not hold.
        """
        self._keep_up()
        frames = np.where(given, received, np.nan)
        repair = self._repair
        if len(frames) == 1 and self._watches:
            self._monitor(frames[0])
        if self.fault_set != self._judged:
            self._decide()
        if self._refusal is not None:
            raise NotCertified(f"the policy must not act: {self._refusal}")
        fill = repair if len(frames) == 1 else repair.alone
        done = [self._watch.restored(fill, frame) for frame in frames]
        whole, restored, other = (np.array(part) for part in zip(*done, strict=True))
        return whole, ~restored & self.layout.is_cell, other

    @property
    def _repair(self) -> FrameRepair:
        assert self._watch.repair is not None  # the bundle brings a restorer
        return self._watch.repair

    def _monitor(self, frame: Frames) -> None:
        """Leave a frame to the thread that monitors."""
        if self._monitoring is None:
            self._monitoring = threading.Thread(
                target=self._watch.work_on, args=[_tell], name="adaptfault-monitor", daemon=True
            )
            self._monitoring.start()
        self._watch.put(frame)

    def _keep_up(self) -> None:
        """Go on with what a maintenance run wrote, once it is loaded."""
        sensor = self._follower.poll()
        if sensor is None:
            return
        self._watch.switch(sensor)
        _log.info("%s of the bundle, %d known faulty cells", sensor.version, len(sensor.known))
        self._decide()

    def _decide(self) -> None:
        """Ask whether the policy may act with the cells that are faulty now."""
        self._judged = self.fault_set
        self._refusal = self._limits.refusal(self._watch.sensor, self._judged)


def _tell(fault: Fault) -> None:
    _log.warning("%s", fault.reason)
