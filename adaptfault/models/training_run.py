"""State of a training run: weights, their average, moments of Adam and history, also on disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from adaptfault.models.adam import Adam
from adaptfault.models.checkpoint import read_checkpoint, write_checkpoint
from adaptfault.models.history import History

Loss = Callable[[Tensor, Tensor], Tensor]


class Optimisation:
    """Adam on a model's parameters, fused, and their exponential average."""

    def __init__(self, model: nn.Module, learning_rate: float, averaging: float) -> None:
        self.averaging = averaging
        self.trained = {name: p for name, p in model.named_parameters() if p.requires_grad}
        if not self.trained:
            raise ValueError(
                "nothing to train: every parameter of the model has requires_grad False"
            )
        self.optimizer = Adam(self.trained.values(), learning_rate)
        self.average = {name: p.detach().clone() for name, p in self.trained.items()}
        self.steps = 0

    def step(self, loss: Tensor) -> None:
        """Make one step down the gradient of ``loss``."""
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        self._follow()

    @torch.no_grad()
    def _follow(self) -> None:
        """Update the average after a step."""
        self.steps += 1
        # at first over the last tenth of few steps
        kept = min(self.averaging, self.steps / (self.steps + 10))
        torch._foreach_lerp_(list(self.average.values()), list(self.trained.values()), 1 - kept)

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """Put the averaged weights into the model within a context."""
        self._swap()
        try:
            yield
        finally:
            self._swap()

    def _swap(self) -> None:
        for name, parameter in self.trained.items():
            parameter.data, self.average[name] = self.average[name], parameter.data


class TrainingRun(Optimisation):
    """State of a run: model, best weights, moments of Adam and history, also on disk if a path is
    given."""

    def __init__(
        self,
        model: nn.Module,
        learning_rate: float,
        averaging: float,
        path: str | Path | None,
    ) -> None:
        super().__init__(model, learning_rate, averaging)
        self.model = model
        self.device = next(model.parameters()).device
        self.path = None if path is None else Path(path)
        self.history = History()
        frozen = {name for name, p in model.named_parameters() if not p.requires_grad}
        # training changes these
        self.names = [name for name in model.state_dict() if name not in frozen]
        self.best = self._weights()
        self.settings: dict[str, Any] = {}
        self.loss: Loss = F.cross_entropy

    def _weights(self) -> dict[str, Tensor]:
        state = self.model.state_dict()
        return {
            name: state[name].detach().clone(memory_format=torch.contiguous_format)
            for name in self.names
        }

    def restore_best(self) -> None:
        """Put the best weights into the model."""
        self.model.load_state_dict(self.best, strict=False)

    def record(self, history: History, *, save: bool = True) -> None:
        """Set the history, store the weights if the last epoch is the best, write the
        checkpoint."""
        if history.best_epoch == history.epochs:
            with self.averaged():
                self.best = self._weights()
        self.history = history
        if not save or self.path is None:
            return
        tensors = {f"model.{name}": tensor for name, tensor in self._weights().items()}
        tensors |= {f"best.{name}": tensor for name, tensor in self.best.items()}
        for name, parameter in self.trained.items():
            tensors[f"average.{name}"] = self.average[name]
            tensors |= {
                f"adam.{key}.{name}": value
                for key, value in self.optimizer.state.get(parameter, {}).items()
            }
        write_checkpoint(self.path, tensors, settings=self.settings, state=history.to_dict())

    def resume(self) -> None:
        """Continue from the checkpoint if there is one."""
        if self.path is None or not self.path.exists():
            return
        tensors, state = read_checkpoint(self.path, self.settings)
        self.history = History.from_dict(state)
        self.model.load_state_dict(_under("model.", tensors), strict=False)
        self.best = _under("best.", tensors)
        average = _under("average.", tensors)
        self.average = {name: average[name].to(p.device) for name, p in self.trained.items()}
        for key in ("step", "exp_avg", "exp_avg_sq"):
            for name, value in _under(f"adam.{key}.", tensors).items():
                state = self.optimizer.state.setdefault(self.trained[name], {})
                state[key] = value.to(self.trained[name].device)
                if key == "step":
                    self.steps = int(value)


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose names start with a prefix, without the prefix."""
    return {
        name[len(prefix) :]: tensor for name, tensor in tensors.items() if name.startswith(prefix)
    }
