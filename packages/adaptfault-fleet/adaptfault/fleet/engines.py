"""Parallel execution over robots: joblib threads on this machine, or a Dask cluster; one process
per robot."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from queue import SimpleQueue
from typing import TYPE_CHECKING

from adaptfault.data.cluster import WAIT, connected
from adaptfault.fleet.guard import Guard, Task, do_on_worker, quiet
from adaptfault.fleet.listing import Robot
from adaptfault.fleet.outcome import Outcome

if TYPE_CHECKING:
    from distributed import Client, Future

Engine = Callable[[Sequence[Robot]], Iterator[Outcome]]
"""Maintains robots and yields their outcomes in order of completion."""

_LOOK = 0.1  # s between two checks for finished robots
_DIED = "every Dask worker that processed it died; memory may be short"


@contextmanager
def engine(task: Task, *, jobs: int | None, dask: str | None) -> Iterator[Engine]:
    """Return the engine for these options; see :func:`adaptfault.maintain_fleet` for the arguments.

    Raises:
        ValueError: Dask is not installed, or the address has no port.
        OSError: no scheduler answers at the address, or it has no worker.
    """
    if dask is None:
        from joblib import cpu_count

        guards = [Guard() for _ in range(jobs or cpu_count())]
        with warnings.catch_warnings():
            quiet()
            try:
                yield partial(_on_joblib, task, guards)
            finally:
                for guard in guards:
                    guard.close()
        return
    with connected(dask) as client:
        yield partial(_on_dask, client, task)


def _on_joblib(task: Task, guards: Sequence[Guard], robots: Sequence[Robot]) -> Iterator[Outcome]:
    from joblib import Parallel, delayed

    free: SimpleQueue[Guard] = SimpleQueue()
    for guard in guards:
        free.put(guard)

    def done(robot: Robot) -> Outcome:
        guard = free.get()
        try:
            return guard.do(task, robot)
        finally:
            free.put(guard)

    # Threads that wait for the guards' processes: a crash in joblib's own process pool would end
    # the whole pool.
    parallel = Parallel(
        len(guards), backend="threading", return_as="generator_unordered", batch_size=1
    )
    yield from parallel(delayed(done)(robot) for robot in robots)


def _on_dask(client: Client, task: Task, robots: Sequence[Robot]) -> Iterator[Outcome]:
    # Not through joblib: its Dask backend (1.6) never returns a task whose worker died.
    suspects = []
    for robot, outcome in _finished(client, task, robots):
        if outcome is None:
            suspects.append(robot)
        else:
            yield outcome
    for (
        suspect
    ) in suspects:  # one at a time: some only shared a worker with the robot that crashes it
        for robot, outcome in _finished(client, task, [suspect]):
            yield outcome or Outcome.error(robot, _DIED)


def _finished(
    client: Client, task: Task, robots: Sequence[Robot]
) -> Iterator[tuple[Robot, Outcome | None]]:
    """Yield robots in order of completion, with None where their workers died.

    Raises:
        OSError: the scheduler or the last worker disappeared.
    """
    from distributed import as_completed

    robot_of = dict(
        zip(client.map(partial(do_on_worker, task), robots, pure=False), robots, strict=True)
    )
    coming = as_completed(list(robot_of), loop=client.loop)
    seen = time.monotonic()
    while robot_of:
        for future in coming.next_batch(block=False):
            if future.cancelled():
                raise OSError(
                    "the Dask scheduler went away or was restarted; start the run again to"
                    " resume it"
                )
            yield (robot := robot_of.pop(future)), _outcome(future, robot)
        if not coming.has_ready():
            time.sleep(_LOOK)
        if (idle := time.monotonic() - seen) > WAIT / 10:
            if client.nthreads():
                seen = time.monotonic()
            elif idle > WAIT:
                raise OSError(
                    f"no Dask worker for {WAIT} s; start workers, then the run again to resume it"
                )


def _outcome(future: Future, robot: Robot) -> Outcome | None:
    from distributed import KilledWorker

    if future.status != "error":
        outcome: Outcome = future.result()
        return outcome
    error = future.exception()
    return (
        None
        if isinstance(error, KilledWorker)
        else Outcome.error(robot, f"{type(error).__name__}: {error}")
    )
