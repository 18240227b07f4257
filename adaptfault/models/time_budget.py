"""A budget of seconds for a training run, kept by looking ahead."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager


class Clock:
    """Tells when to stop a run, so that the next batch and the validation after it still fit into the budget."""

    def __init__(self, budget: float | None) -> None:
        self.began, self.budget, self.spent = time.perf_counter(), math.inf if budget is None else budget, 0.0
        self.pace = 0.0  # seconds that training takes a window
        self.close = 0.0  # seconds that the last validation and checkpoint took
        self.over = False  # an epoch was cut short

    @contextmanager
    def closing(self, share: float = 1.0) -> Iterator[None]:
        """Time the end of an epoch, or this share of one."""
        began = time.perf_counter()
        yield
        self.close = (time.perf_counter() - began) / share

    def late(self, batch: int) -> bool:
        """Say whether another batch would be too much."""
        return time.perf_counter() - self.began + self.spent + self.close + self.pace * batch > self.budget
