"""A process for one robot at a time: where it crashes or goes on past the limit, that robot alone is lost."""

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
_START = 600  # s for a process to start and load what maintenance needs, from a cold disk
_IDLE = 300  # s after which a process without work ends by itself
_LOOK = 0.2  # s between two looks whether who started the process still lives
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Task:
    """What is done with each robot.

    Attributes:
        work: gives its outcome.
        ready: loads what ``work`` needs; not counted towards the limit.
        limit: seconds for one robot; None: no limit.
    """

    work: Callable[[Robot], Outcome]
    ready: Callable[[], object]
    limit: float | None = None


class Guard:
    """Keeps one process, loky's; after a death or a robot past its limit the next robot gets a new one."""

    def __init__(self) -> None:
        self._executor: ProcessPoolExecutor | None = None

    def do(self, task: Task, robot: Robot) -> Outcome:
        """Return the robot's outcome; an error if its process died, raised, or had to be killed at the limit."""
        began = time.perf_counter()
        try:
            self._ask(_START, task.ready)
            outcome: Outcome = self._ask(task.limit, task.work, robot)
        except _Lost as lost:
            return Outcome.error(robot, str(lost), time.perf_counter() - began)
        return outcome

    def close(self) -> None:
        """Kill the process, whatever it does; whoever waits for it gets an error."""
        executor, self._executor = self._executor, None
        if executor is not None:
            executor.shutdown(kill_workers=True)

    def _ask(self, seconds: float | None, call: Callable[..., Any], *args: object) -> Any:
        if self._executor is None:
            self._executor = _process()
        try:
            future = self._executor.submit(call, *args)
            error = future.exception(seconds)
        except TimeoutError:
            self.close()
            raise _Lost(f"not done after {seconds:g} s, so its process was killed; look at its recordings") from None
        except BrokenExecutor as broken:  # it died between two robots
            error = broken
        if isinstance(error, BrokenExecutor):
            self.close()
            raise _Lost(_DIED)
        if error is not None:
            raise _Lost(f"{type(error).__name__}: {error}")
        return future.result()


class _Lost(Exception):
    """No outcome, and why."""


def quiet() -> None:
    """Ignore loky's warning that a process ended: it is replaced, and as an error it would stop loky's thread."""
    # A process that grew by 300 MB ends between two robots (loky's guard against leaks), and so does an idle one.
    warnings.filterwarnings("ignore", message="A worker (stopped|was restarted) while some jobs were given")


_here = threading.local()


def do_on_worker(task: Task, robot: Robot) -> Outcome:
    """Do it on a Dask worker: each of its threads keeps a process from robot to robot."""
    if not hasattr(_here, "guard"):
        quiet()
        # Under a nanny the worker may have no children, lest they outlive it; ours end when it does.
        multiprocessing.current_process().daemon = False
        _here.guard = Guard()
    guard: Guard = _here.guard
    return guard.do(task, robot)


def _process() -> ProcessPoolExecutor:
    from loky import ProcessPoolExecutor

    return ProcessPoolExecutor(1, timeout=_IDLE, initializer=_begin, initargs=(os.getpid(),), env=_ONE_THREAD)


def _begin(parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for who started the run, and no robot's error
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End when who started this was killed: the robot's lock has to be free when the run goes on."""
    while os.getppid() == parent:
        time.sleep(_LOOK)
    os._exit(1)
