"""Time budget of a training run: predicts whether the next batch and validation still fit."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager


class Clock:
    """Decides when to stop, so that the next batch and the validation after it fit into the
    budget."""

    def __init__(self, budget: float | None) -> None:
        self.began = time.perf_counter()
        self.budget = math.inf if budget is None else budget
        self.spent = 0.0
        self.pace = 0.0  # seconds of training per window
        self.close = 0.0  # seconds of the last validation and checkpoint
        self.over = False  # an epoch was cut short

    @contextmanager
    def closing(self, share: float = 1.0) -> Iterator[None]:
        """Measure the time of a validation and checkpoint, or of this share of one."""
        began = time.perf_counter()
        yield
        self.close = (time.perf_counter() - began) / share

    def late(self, batch: int) -> bool:
        """Return whether another batch of this many windows would exceed the budget."""
        return (
            time.perf_counter() - self.began + self.spent + self.close + self.pace * batch
            > self.budget
        )
