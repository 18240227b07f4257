"""Record of a training run, epoch by epoch."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from adaptfault.data.documents import rebuilt
from diagnostics.shown import shown

Stopped = Literal["epochs", "patience", "budget"]


@shown
@dataclass(frozen=True)
class History:
    """Record of a training run.

    Attributes:
        train_loss, validation_loss, validation_accuracy, seconds: one number an epoch: mean losses
        (cross entropy, or
            mean squared error of values), accuracy (R2 of values), wall clock.
        best_epoch: epoch of the selected weights, counted from 1; 0 = the starting weights.
        stopped: "epochs" (all done), "patience" (no improvement), "budget" (time is up, also within
            an epoch).
        start: validation loss and accuracy of the starting weights, if evaluated.
    """

    train_loss: tuple[float, ...] = ()
    validation_loss: tuple[float, ...] = ()
    validation_accuracy: tuple[float, ...] = ()
    seconds: tuple[float, ...] = ()
    best_epoch: int = 0
    stopped: Stopped = "epochs"
    start: tuple[float, float] | None = None

    @property
    def epochs(self) -> int:
        """Number of epochs trained; the budget may have cut the last one short."""
        return len(self.train_loss)

    @property
    def best_accuracy(self) -> float:
        """Validation accuracy of the selected weights; NaN if nothing was evaluated."""
        if self.best_epoch:
            return self.validation_accuracy[self.best_epoch - 1]
        return self.start[1] if self.start else math.nan

    def __str__(self) -> str:
        return self.told()

    def told(self, measure: str = "accuracy") -> str:
        """Return the run as text; ``measure`` is what the validation accuracy is, as "R2"."""
        epochs = "1 epoch" if self.epochs == 1 else f"{self.epochs} epochs"
        return (
            f"{epochs} in {sum(self.seconds):.1f} s, stopped by {self.stopped}; "
            f"best is epoch {self.best_epoch}, validation {measure} {self.best_accuracy:.3f}"
        )

    def longer(self, train_loss: float, scores: tuple[float, float], seconds: float) -> History:
        """Return the history with one more epoch. The best epoch has the highest accuracy, of
        equals the lowest loss.

        Args:
            train_loss: mean loss of the epoch.
            scores: validation loss and accuracy after the epoch.
            seconds: wall clock.
        """
        loss, accuracy = scores
        earlier = list(
            zip(self.validation_accuracy, (-v for v in self.validation_loss), strict=True)
        )
        if self.start is not None:
            earlier.append((self.start[1], -self.start[0]))
        return replace(
            self,
            train_loss=(*self.train_loss, train_loss),
            validation_loss=(*self.validation_loss, loss),
            validation_accuracy=(*self.validation_accuracy, accuracy),
            seconds=(*self.seconds, seconds),
            best_epoch=self.epochs + 1
            if all((accuracy, -loss) > e for e in earlier)
            else self.best_epoch,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        return asdict(self)

    @classmethod
    def from_dict(cls, d: dict[str, Any]) -> History:
        """Build a history from the dict of :meth:`to_dict`, also after JSON."""
        return rebuilt(d, cls)
