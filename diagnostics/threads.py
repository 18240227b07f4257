"""One thread for linear algebra, as on the small matrices of a diagnosis more threads take four
times as long; and a thread for work that must not hold up a control loop."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from threading import Lock
from typing import Any, TypeVar

import scipy.linalg  # noqa: F401 - so that its BLAS is among those that are found
from threadpoolctl import ThreadpoolController

Result = TypeVar("Result")


class _OneThread:
    """The context of :func:`one_thread`."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._inside = 0
        self._before: list[int] = []

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._before = [library.num_threads for library in _libraries()]
                _limit([1] * len(self._before))
            self._inside += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                _limit(self._before)


_ONE_THREAD = _OneThread()


def one_thread() -> _OneThread:
    """Return the context in which BLAS takes one thread; entering it takes some 30 us.

    The number of BLAS's threads is the process's: it is one from the first thread that enters to
    the last that leaves.
    """
    return _ONE_THREAD


def _limit(numbers: Sequence[int]) -> None:
    """Set the number of threads of each library, whichever thread did so before."""
    for library, number in zip(_libraries(), numbers, strict=True):
        # threadpoolctl 3.8 does nothing in other threads than the one that was the first
        release = getattr(library, "clear_controlling_thread", None)
        if release is not None:
            release(force=True)
        library.set_num_threads(number)
        if release is not None:
            release(force=True)


@cache
def _libraries() -> tuple[Any, ...]:
    return tuple(ThreadpoolController().select(user_api="blas").lib_controllers)


class Worker:
    """One thread, which makes calls one after another; it begins with the first one.

    The end of the interpreter and a fork wait for a call under way; a forked process has a thread
    of its own.
    """

    def __init__(self) -> None:
        self._thread: ThreadPoolExecutor | None = None
        self._process = 0

    def begin(self, call: Callable[[], Result]) -> Future[Result] | Result:
        """Let the thread make a call; return its result, which comes later. At the end of the
        interpreter the call is made here."""
        if self._thread is None or self._process != os.getpid():
            self._thread = ThreadPoolExecutor(1, "adaptfault")
            self._process = os.getpid()
        try:
            future = self._thread.submit(call)
        except RuntimeError:  # it takes no more calls
            return call()
        _UNDER_WAY.add(future)
        future.add_done_callback(_UNDER_WAY.discard)
        return future


_UNDER_WAY = set[Future[Any]]()

if hasattr(os, "register_at_fork"):  # what a thread holds at a fork, the new process never gets
    os.register_at_fork(before=lambda: wait(tuple(_UNDER_WAY)))
