"""Where the work is done: joblib's processes on this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

from adaptfault.fleet.listing import Robot
from adaptfault.fleet.outcome import Outcome

if TYPE_CHECKING:
    from distributed import Client

Work = Callable[[Robot], Outcome]
Attempt = Callable[[Sequence[Robot]], Iterator[Outcome]]
"""Works on robots and yields outcomes as they come; of those at workers that died it yields none."""

_SUSPECTS = 8  # tried alone before the rest is given to all workers again
_WAIT = 30  # s for a cluster's first worker
_DIED = "the process that maintained it died; memory may be short, or a native library crashed"


@contextmanager
def engine(work: Work, *, jobs: int | None, dask: str | None) -> Iterator[Attempt]:
    """Give what works on robots; see :func:`adaptfault.maintain_fleet` for the arguments.

    Raises:
        ValueError: Dask is not installed.
        OSError: there is no scheduler at the address, or it has no worker.
    """
    if dask is None:
        from joblib import cpu_count

        with warnings.catch_warnings():
            # A worker that has grown by 300 MB is replaced between two robots: loky's guard, and no loss.
            warnings.filterwarnings("ignore", message="A worker stopped while some jobs were given")
            yield partial(_on_joblib, work, jobs or cpu_count())
        return
    try:
        from distributed import Client
    except ImportError:
        raise ValueError("a Dask cluster needs Dask: pip install 'adaptfault[fleet]'") from None
    with Client(dask, set_as_default=False) as client:
        try:
            client.wait_for_workers(1, timeout=_WAIT)
        except Exception as error:  # its own TimeoutError, which differs between versions
            raise OSError(f"the Dask scheduler at {dask} has no worker after {_WAIT} s ({error})") from None
        yield partial(_on_dask, client, work)


def outcomes(robots: Sequence[Robot], attempt: Attempt) -> Iterator[Outcome]:
    """Yield every robot's outcome as it comes. Where workers died, who was there is tried again, one at a time."""
    waiting = {robot.name: robot for robot in robots}
    while waiting:
        for outcome in attempt(list(waiting.values())):
            del waiting[outcome.robot.name]
            yield outcome
        for robot in list(waiting.values())[:_SUSPECTS]:
            alone = list(attempt([robot]))
            del waiting[robot.name]
            yield alone[0] if alone else Outcome.error(robot, _DIED)


def _on_joblib(work: Work, jobs: int, robots: Sequence[Robot]) -> Iterator[Outcome]:
    from joblib import Parallel, delayed, parallel_config

    try:
        with parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1):
            # One robot a task: each takes seconds, and its outcome should be on disk when it is there.
            parallel = Parallel(return_as="generator_unordered", batch_size=1)
            yield from parallel(delayed(work)(robot) for robot in robots)
    except BrokenExecutor:
        return


def _on_dask(client: Client, work: Work, robots: Sequence[Robot]) -> Iterator[Outcome]:
    # Not through joblib: its Dask backend (1.6) waits for ever for a task whose worker died.
    from distributed import KilledWorker, as_completed

    robot_of = dict(zip(client.map(work, robots, pure=False), robots, strict=True))
    for future in as_completed(list(robot_of), loop=client.loop):
        robot = robot_of.pop(future)
        if future.status == "finished":
            yield future.result()
        elif not isinstance(error := future.exception(), KilledWorker):
            yield Outcome.error(robot, f"{type(error).__name__}: {error}")
