"""A worker process for one robot at a time: a crash or a timeout affects that robot only.

loky, where there is pebble: that one imports the main script anew in each process, so that a script
without a guard of ``__main__`` has no workers, takes no functions that are made on the spot, and
replaces no process that grows.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, TimeoutError
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from adaptfault.fleet.listing import Robot
from adaptfault.fleet.outcome import Outcome

if TYPE_CHECKING:
    from loky import ProcessPoolExecutor

_DIED = "the process that maintained it died; memory may be short, or a native library crashed"
_START = 600  # s for a process to start and import from a cold disk
_IDLE = 300  # s after which an idle process ends
_LOOK = 0.2  # s between two checks that the parent process lives
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Task:
    """The work on one robot.

    Attributes:
        work: returns the outcome of a robot.
        ready: imports what ``work`` needs; not counted towards the limit.
        limit: seconds for one robot; None: no limit.
    """

    work: Callable[[Robot], Outcome]
    ready: Callable[[], object]
    limit: float | None = None


class Guard:
    """Owns one loky process and replaces it after a crash or a timeout."""

    def __init__(self) -> None:
        self._executor: ProcessPoolExecutor | None = None

    def do(self, task: Task, robot: Robot) -> Outcome:
        """Return the robot's outcome; an error if its process died, raised, or had to be killed at
        the limit."""
        began = time.perf_counter()
        try:
            self._call(_START, task.ready)
            outcome: Outcome = self._call(task.limit, task.work, robot)
        except _Lost as lost:
            return Outcome.error(robot, str(lost), time.perf_counter() - began)
        return outcome

    def close(self) -> None:
        """Kill the process; a waiting caller gets an error."""
        executor = self._executor
        self._executor = None
        if executor is not None:
            executor.shutdown(kill_workers=True)

    def _call(self, seconds: float | None, call: Callable[..., Any], *args: object) -> Any:
        if self._executor is None:
            self._executor = _process()
        try:
            future = self._executor.submit(call, *args)
            error = future.exception(seconds)
        except TimeoutError:
            self.close()
            raise _Lost(
                f"not finished after {seconds:g} s, so its process was killed; check its recordings"
            ) from None
        except BrokenExecutor as broken:  # it died between two robots
            error = broken
        if isinstance(error, BrokenExecutor):
            self.close()
            raise _Lost(_DIED)
        if error is not None:
            raise _Lost(f"{type(error).__name__}: {error}")
        return future.result()


class _Lost(Exception):
    """The reason why there is no outcome."""


def quiet() -> None:
    """Ignore loky's warning that a process ended; raised as an error it would stop loky's
    thread."""
    # loky ends a process that grew by 300 MB, and an idle one, between two robots.
    warnings.filterwarnings(
        "ignore", message="A worker (stopped|was restarted) while some jobs were given"
    )


_here = threading.local()


def do_on_worker(task: Task, robot: Robot) -> Outcome:
    """Process a robot on a Dask worker; each of its threads keeps one process."""
    if not hasattr(_here, "guard"):
        quiet()
        # Daemon processes may have no children; this one's end with it, see _end_with.
        multiprocessing.current_process().daemon = False
        _here.guard = Guard()
    guard: Guard = _here.guard
    return guard.do(task, robot)


def _process() -> ProcessPoolExecutor:
    from loky import ProcessPoolExecutor

    return ProcessPoolExecutor(
        1, timeout=_IDLE, initializer=_begin, initargs=(os.getpid(),), env=_ONE_THREAD
    )


def _begin(parent: int) -> None:
    # Ctrl-C stops the parent, not the robot's maintenance
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End when the parent was killed, so that the robot's lock is free when the run resumes."""
    while os.getppid() == parent:
        time.sleep(_LOOK)
    os._exit(1)
