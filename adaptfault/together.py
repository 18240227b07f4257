"""Several adaptations at once: what they have to train is trained in one batched pass, on a GPU where there is one.

Reduced models differ in shape with F. Masked ones do not: whole windows come in, the cells of F are set to 0, the fill
is a D x D matrix whose other entries are and stay 0, and its answers replace what was masked. That is the same
arithmetic, so the stacked models (``torch.func``) learn what each would have learnt alone, to within rounding.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap
from torch.nn.attention import SDPBackend, sdpa_kernel
from tqdm import tqdm

from adaptfault.adaptation import Adaptation
from adaptfault.adapter import Adapter
from adaptfault.fills import AffineFill
from adaptfault.history import History
from adaptfault.network import as_tensor, logits_of
from adaptfault.reduction import ReducedModel
from adaptfault.stages import Lesson, Method, Run
from adaptfault.training import Optimisation, seeded
from adaptfault.windows import Windows
from diagnostics import FaultSet

_LEARNING_RATE, _BATCH, _AVERAGING = 1e-4, 32, 0.995  # as train has them


def adapt_many(
    adapter: Adapter,
    fault_sets: Sequence[FaultSet],
    *,
    method: Method = "finetune",
    seed: int = 0,
    at_once: int = 8,
    device: str | torch.device | None = None,
    progress: bool | None = None,
) -> tuple[Adaptation, ...]:
    """Adapt to several F, as ``adapter.adapt(fault_set, method=method, seed=seed)`` does to each, to within rounding.

    What is trained ("finetune", "scratch") is trained together; the closed-form stages run one after the other. On a
    CPU, whose matrix products fill it with one model, that takes 1.0 to 1.3 times as long: it is for GPUs.

    Args:
        adapter: the fault-free model and what it learns from.
        fault_sets: any number of F.
        method: as for :meth:`Adapter.adapt`; "auto" ends with the head, for without a budget it never trains.
        seed: of training, the same for all.
        at_once: models trained together: each needs six times its weights, and its activations.
        device: where all of it happens, as "cuda"; None: where the adapter's model is.
        progress: show or hide progress on stderr; None shows it on a terminal.

    Raises:
        ValueError: as :meth:`Adapter.adapt`; ``at_once`` below 1.
    """
    if at_once < 1:
        raise ValueError(f"at_once must be 1 or more, got {at_once}")
    adapter = adapter if device is None else adapter.to(device)
    for fault_set in fault_sets:
        adapter.check(fault_set, method)
    parts = [fault_sets[i : i + at_once] for i in range(0, len(fault_sets), at_once)]
    return tuple(done for part in parts for done in _adapt(adapter, part, method, seed, progress))


def _adapt(
    adapter: Adapter, fault_sets: Sequence[FaultSet], method: Method, seed: int, progress: bool | None
) -> list[Adaptation]:
    """Let all adaptations run until they ask for training, train them, and so on."""
    work = [Run(adapter, fault_set, None, seed, progress).stages_of(method) for fault_set in fault_sets]
    done: dict[int, Adaptation] = {}
    told: dict[int, History | None] = dict.fromkeys(range(len(work)))
    while told:
        asked: dict[int, Lesson] = {}
        for i, history in told.items():
            try:
                asked[i] = next(work[i]) if history is None else work[i].send(history)
            except StopIteration as end:
                done[i] = end.value
        # Those that still ask are all in the same round, of the same seed and length.
        told = dict(zip(asked, _train(adapter, list(asked.values()), progress), strict=True)) if asked else {}
    return [done[i] for i in range(len(work))]


def _train(adapter: Adapter, lessons: Sequence[Lesson], progress: bool | None) -> list[History]:
    first = lessons[0]
    return train_together(
        [lesson.reduced for lesson in lessons],
        adapter.train,
        adapter.validation,
        epochs=first.epochs,
        seed=first.seed,
        patience=first.patience,
        progress=progress,
    )


def train_together(
    models: Sequence[ReducedModel],
    train: Windows,
    validation: Windows,
    *,
    epochs: int,
    seed: int = 0,
    patience: int | None = None,
    learning_rate: float = _LEARNING_RATE,
    batch_size: int = _BATCH,
    averaging: float = _AVERAGING,
    progress: bool | None = None,
) -> list[History]:
    """Train reduced models, in place, as :func:`~adaptfault.training.train` trains each on its healthy cells.

    Args:
        models: without heads of their own, behind linear fills, of one kind of network, all on one device.
        train, validation: whole windows ``[N, T, D]``; each model sees its healthy cells only.
        epochs, seed, patience, learning_rate, batch_size, averaging: as of ``train``. One that has stopped keeps
            its best weights while the others go on.
        progress: show or hide progress on stderr; None shows it on a terminal.

    Raises:
        ValueError: a loss that is no longer finite.
    """
    together = Together(models)
    run = Optimisation(together, learning_rate, averaging)
    device = together.bias.device
    x, y = as_tensor(train.x), as_tensor(train.y).to(device)
    histories, running = [History() for _ in models], set(range(len(models)))
    best = [together.weights_of(k) for k in range(len(models))]
    with tqdm(total=epochs, unit="epoch", disable=None if progress is None else not progress) as bar:
        for epoch in range(epochs):
            began = time.perf_counter()
            together.train()
            with seeded(seed, epoch, device) as generator:
                order = torch.split(torch.randperm(len(y), generator=generator), batch_size)
                losses = torch.stack(
                    [_step(run, together, x[index].to(device), y[index.to(device)]) * len(index) for index in order]
                ).sum(0)
            with run.averaged():
                scores = _validate(together, validation)
                for k in running:
                    loss, seconds = float(losses[k]) / len(y), (time.perf_counter() - began) / len(models)
                    histories[k] = histories[k].longer(loss, scores[k], seconds)
                    if histories[k].best_epoch == epoch + 1:
                        best[k] = together.weights_of(k)
            bar.update()
            if patience is not None:
                running = {k for k in running if epoch + 1 - histories[k].best_epoch < patience}
            if not running:
                break
    for k, model in enumerate(models):
        _give(model, best[k])
    idle = [patience is not None and h.epochs - h.best_epoch >= patience for h in histories]
    return [replace(h, stopped="patience" if i else "epochs") for h, i in zip(histories, idle, strict=True)]


class Together(nn.Module):
    """K reduced models stacked and masked: whole windows ``[N, T, D]`` to logits ``[K, N, n_classes]``.

    What the cells of a model's F hold cannot reach its logits, NaN included.

    Attributes:
        weight, bias: of the fills, ``[K, D, D]`` and ``[K, D]``.
        missing: bool ``[K, D]``.
    """

    missing: Tensor

    def __init__(self, models: Sequence[ReducedModel]) -> None:
        super().__init__()
        stacked, _ = stack_module_state([model.network for model in models])
        self.names = {name.replace(".", "/"): name for name in stacked}  # torch allows no dots in names
        for key, name in self.names.items():
            self.register_parameter(key, nn.Parameter(stacked[name].detach()))
        self._network = (copy.deepcopy(models[0].network),)  # in a tuple: its own weights are no part of this
        d, device = models[0].fault_set.n_cells, models[0].network.head.weight.device
        self.register_buffer("missing", torch.from_numpy(np.stack([m.fault_set.mask for m in models])).to(device))
        weight, bias = torch.zeros(len(models), d, d), torch.zeros(len(models), d)
        for k, model in enumerate(models):
            if isinstance(model.front, AffineFill):
                lost, healthy = _cells(model.fault_set)
                weight[k][lost[:, None], healthy] = model.front.weight.detach().cpu()
                bias[k][lost] = model.front.bias.detach().cpu()
        self.weight, self.bias = nn.Parameter(weight.to(device)), nn.Parameter(bias.to(device))

    def train(self, mode: bool = True) -> Together:
        """Set training mode or eval mode, also for the network that all are copies of."""
        self._network[0].train(mode)
        return super().train(mode)

    def forward(self, x: Tensor) -> Tensor:
        """Map windows ``[N, T, D]`` to the logits of each model; dropout drops the same in all."""
        networks = {name: getattr(self, key) for key, name in self.names.items()}
        one = vmap(self._one, in_dims=(0, 0, 0, 0, None), randomness="same")
        with sdpa_kernel(SDPBackend.MATH):  # torch cannot stack its fused attention on a CPU
            logits: Tensor = one(networks, self.weight, self.bias, self.missing, x)
        return logits

    def _one(self, network: dict[str, Tensor], weight: Tensor, bias: Tensor, missing: Tensor, x: Tensor) -> Tensor:
        x = torch.where(missing, 0.0, x)  # not a product: NaN * 0 is NaN
        x = torch.where(missing, F.linear(x, weight, bias).clamp(0.0, 1.0), x)
        logits: Tensor = functional_call(self._network[0], network, (x,))
        return logits

    def weights_of(self, k: int) -> dict[str, Tensor]:
        """Return a copy of the weights of model k, by their names in its network, and "weight", "bias" of its fill."""
        own = {name: getattr(self, key) for key, name in self.names.items()}
        return {name: p[k].detach().clone() for name, p in {**own, "weight": self.weight, "bias": self.bias}.items()}


def _step(run: Optimisation, together: Together, x: Tensor, y: Tensor) -> Tensor:
    """Take one step; return the mean loss of each model, ``[K]``."""
    logits = together(x)  # (K, B, n)
    losses = F.cross_entropy(logits.flatten(0, 1), y.repeat(len(logits)), reduction="none")
    losses = losses.view(len(logits), -1).mean(1)
    run.optimizer.zero_grad()
    losses.sum().backward()  # type: ignore[no-untyped-call]  # no model's loss depends on another's weights
    run.optimizer.step()
    run.follow()
    if not losses.isfinite().all():
        raise ValueError(f"the losses became {losses.tolist()}: lower learning_rate")
    return losses.detach()


def _validate(together: Together, windows: Windows) -> list[tuple[float, float]]:
    """Return loss and accuracy of each model."""
    labels, batches = as_tensor(windows.y), torch.split(as_tensor(windows.x), 256)
    logits = torch.cat([logits_of(together, x) for x in batches], dim=1)  # (K, N, n)
    return [(F.cross_entropy(of, labels).item(), (of.argmax(1) == labels).double().mean().item()) for of in logits]


def _give(model: ReducedModel, weights: dict[str, Tensor]) -> None:
    """Put weights of :meth:`Together.weights_of` into a reduced model, which is left in eval mode."""
    weight, bias = weights.pop("weight"), weights.pop("bias")
    model.network.load_state_dict(weights)
    if isinstance(model.front, AffineFill):
        lost, healthy = (cells.to(weight.device) for cells in _cells(model.fault_set))
        with torch.no_grad():
            model.front.weight.copy_(weight[lost[:, None], healthy])
            model.front.bias.copy_(bias[lost])
    model.eval()


def _cells(fault_set: FaultSet) -> tuple[Tensor, Tensor]:
    """Return the indices of missing and healthy cells."""
    return torch.from_numpy(np.flatnonzero(fault_set.mask)), torch.from_numpy(fault_set.healthy.copy())
