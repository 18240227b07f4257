"""Whether any fine-tuning beats the head in closed form.

    python examples/fine_tuning.py [GRASPS.npz] [--splits 0 1] [--small]

For each split and fault set the network is trained for a few epochs behind the linear fill, in one
of the forms below. Then a head is fitted to its features, as to those of the fault-free network
("head"). Printed are loss and accuracy on validation recordings, of heads fitted without them, the
accuracy on test recordings, and the CPU seconds.

    all        every parameter, cross entropy
    norms      scale and offset of the LayerNorms alone, cross entropy
    low rank   a product of rank 4 added to each weight matrix (LoRA, Hu et al. 2022), cross entropy
    distil     every parameter; targets are features and probabilities of the fault-free network
               that sees all cells of the same windows, so no label is used
    masks      every parameter, cross entropy; with F a fifth of the cells beside it is
               dropped, others in each batch
    through    every parameter; cross entropy of a kernel ridge regression on the features
               of other recordings, differentiated (Bertinetto et al. 2019)
    average    mean of the weights of "all" and the fault-free ones
    two heads  mean of the probabilities of "head" and the head of "all"
    two bases  no training; one head on the features of two fault-free networks

The fault-free networks are kept in ``--out``, or read from there (base0 for split 0, as
adaptation_figures.py keeps them; base1000 is the second one of split 0). Without recordings the
grasps are simulated.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from adaptation_figures import base, cases
from scipy.ndimage import binary_dilation
from torch import Tensor, nn
from torch.nn.utils import parametrize

import adaptfault as af
from adaptfault.adaptation.reduced_model import ReducedModel, reduce_windows
from adaptfault.adaptation.stages import Run
from adaptfault.models.network import logits_of
from adaptfault.models.targets import calibrate
from diagnostics import FaultSet

FORMS = (
    "head",
    "all",
    "norms",
    "low rank",
    "distil",
    "masks",
    "through",
    "average",
    "two heads",
    "two bases",
)
# Adam's steps for all parameters and for few
RATE = 1e-4
FEW_RATE = 1e-3
BATCH = 32
RANK = 4
# windows of a regression that is differentiated, a quarter of them predicted
EPISODE = 256
RIDGE = 0.02
PASSES = 3  # of such an epoch through the windows: it has few steps
OTHER = 1000  # added to the seed of the second fault-free network
# sets of cells beside F, and their share
MASKS = 8
SHARE = 0.2


class LowRank(nn.Module):
    """A weight matrix plus a product of low rank, which is zero at first."""

    def __init__(self, weight: Tensor, generator: torch.Generator) -> None:
        super().__init__()
        rows, columns = weight.shape
        self.left = nn.Parameter(torch.zeros(rows, RANK))
        self.right = nn.Parameter(torch.randn(RANK, columns, generator=generator) / columns**0.5)

    def forward(self, weight: Tensor) -> Tensor:
        return weight.detach() + self.left @ self.right


class Pair(nn.Module):
    """Two networks as one, with the features of both."""

    def __init__(self, first: nn.Module, second: nn.Module) -> None:
        super().__init__()
        self.first = first
        self.second = second
        self.layout = first.layout

    def features(self, x: Tensor) -> Tensor:
        return torch.cat([self.first.features(x), self.second.features(x)], 1)


class Trial:
    """Forms of fine-tuning for one fault set."""

    def __init__(
        self,
        adapter: af.Adapter,
        other: nn.Module,
        faults: FaultSet,
        test: af.Windows,
        epochs: int,
        seed: int,
    ) -> None:
        self.adapter = adapter
        self.other = other
        self.faults = faults
        self.epochs = epochs
        self.seed = seed
        self.run = Run(adapter, faults, None, seed, False)
        self.test = reduce_windows(test, faults)

    def behind(self, network: nn.Module) -> ReducedModel:
        front = self.adapter.imputation.linear(self.faults)
        return ReducedModel(network, self.faults, front if len(self.faults) else None).eval()

    def head(self, network: nn.Module) -> tuple[Tensor, Tensor]:
        """Return log probabilities of validation and test windows with a head on the features of a
        network."""
        if isinstance(network, Pair):
            quick = [self.adapter.compacted(each) for each in (network.first, network.second)]
            self.run.quick = None if None in quick else Pair(*quick)
        else:
            self.run.quick = self.adapter.compacted(network)
        reduced = self.behind(network)
        reduced.head, held = self.run._head(reduced)
        return held.log_softmax(1), logits_of(reduced, self.test.x, batch_size=64).log_softmax(1)

    def masks(self, form: str) -> list[tuple[FaultSet, nn.Module]]:
        """Return the sets of cells that are dropped in turn, and what fills them."""
        if form != "masks":
            return [(self.faults, self.adapter.imputation.linear(self.faults))]
        layout = self.adapter.model.layout
        rng = np.random.default_rng(self.seed)
        dead = np.isin(np.arange(layout.n_cells), list(self.faults)).reshape(layout.shape)
        near = (
            np.stack([binary_dilation(pad, np.ones((3, 3))) for pad in dead])
            & ~dead
            & layout.present
        )
        beside = np.flatnonzero(near)
        found = []
        for _ in range(MASKS):
            more = rng.choice(beside, round(SHARE * len(beside)), replace=False)
            faults = FaultSet((*self.faults, *more.tolist()), layout.n_cells)
            found.append((faults, self.adapter.imputation.linear(faults)))
        return found

    def batches(self, form: str, generator: torch.Generator) -> Iterator[Tensor]:
        """Yield the windows of each batch of an epoch, those of one recording together where a head
        is learned."""
        recording = torch.from_numpy(
            np.unique(self.adapter.train.recording, return_inverse=True)[1]
        )
        if form != "through":
            yield from torch.randperm(len(recording), generator=generator).split(BATCH)
            return
        size = min(EPISODE, len(recording))
        for _ in range(PASSES):
            order = torch.randperm(int(recording.max()) + 1, generator=generator)[
                recording
            ].argsort()
            yield from (each for each in order.split(size) if len(each) == size)

    def tuned(self, form: str) -> nn.Module:
        network = copy.deepcopy(self.adapter.model)
        free = self.adapter.model
        generator = torch.Generator().manual_seed(self.seed)
        trained = list(network.parameters())
        rate = RATE
        if form == "norms":
            norms = [module for module in network.modules() if isinstance(module, nn.LayerNorm)]
            trained = [p for module in norms for p in module.parameters()]
            rate = FEW_RATE
        if form == "low rank":
            linear = [module for module in network.modules() if isinstance(module, nn.Linear)]
            added = [LowRank(module.weight, generator) for module in linear]
            for module, of in zip(linear, added, strict=True):
                parametrize.register_parametrization(module, "weight", of)
            trained = [p for of in added for p in of.parameters()]
            rate = FEW_RATE
        optimizer = torch.optim.Adam(trained, lr=rate)
        whole, y = (torch.from_numpy(of) for of in (self.adapter.train.x, self.adapter.train.y))
        with torch.no_grad():
            wanted = torch.cat([free.features(x) for x in torch.split(whole, 256)])
            likely = free.head(wanted).softmax(1)
        masks = self.masks(form)
        step = 0
        network.train()
        for _ in range(self.epochs):
            for i in self.batches(form, generator):
                faults, front = masks[step % len(masks)]
                step += 1
                features = network.features(front(whole[i][..., faults.healthy]))
                if form == "through":
                    loss = regression_loss(features, y[i], free.n_classes)
                else:
                    logits = network.head(network.dropout(features))
                    loss = nn.functional.cross_entropy(
                        logits, likely[i] if form == "distil" else y[i]
                    )
                if form == "distil":
                    loss = loss + nn.functional.mse_loss(features, wanted[i]) / wanted.var()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
        if form == "low rank":
            for module in linear:
                parametrize.remove_parametrizations(module, "weight")
        return network.eval()

    def results(self) -> Iterator[tuple[str, Tensor, Tensor, float]]:
        """Yield each form with the outputs for validation and test windows and the CPU seconds."""
        found = {}
        networks = {}
        free = self.adapter.model
        for form in FORMS:
            began = time.process_time()
            if form == "two heads":
                found[form] = tuple(
                    torch.logaddexp(*of) for of in zip(found["head"], found["all"], strict=True)
                )
            else:
                match form:
                    case "head":
                        networks[form] = free
                    case "average":
                        networks[form] = averaged(free, networks["all"])
                    case "two bases":
                        networks[form] = Pair(free, self.other)
                    case _:
                        networks[form] = self.tuned(form)
                found[form] = self.head(networks[form])
            yield form, *found[form], time.process_time() - began


def regression_loss(features: Tensor, y: Tensor, n_classes: int) -> Tensor:
    """Return the cross entropy of the last quarter of windows, by a kernel ridge regression on the
    others."""
    known = len(y) * 3 // 4
    distances = torch.cdist(features, features).square()
    kernel = (-distances / distances.detach().median()).exp()
    targets = nn.functional.one_hot(y[:known], n_classes) - 1 / n_classes
    weights = torch.linalg.solve(kernel[:known, :known] + RIDGE * torch.eye(known), targets)
    found = kernel[known:, :known] @ weights
    scale = calibrate(found.detach(), y[known:].numpy())[0]
    return nn.functional.cross_entropy(scale * found, y[known:])


def averaged(first: nn.Module, second: nn.Module) -> nn.Module:
    mean = copy.deepcopy(first)
    with torch.no_grad():
        for parameter, other in zip(mean.parameters(), second.parameters(), strict=True):
            parameter.lerp_(other, 0.5)
    return mean


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="?", help="labelled recordings of a healthy array")
    parser.add_argument("--splits", type=int, nargs="+", default=[0])
    parser.add_argument("--epochs", type=int, default=20, help="of the fault-free network")
    parser.add_argument("--tuned", type=int, default=2, help="epochs of fine-tuning")
    parser.add_argument(
        "--small", action="store_true", help="the smallest setting, to see that everything runs"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("fine_tuning"), help="where fault-free networks are"
    )
    args = parser.parse_args()
    args.repairable = False
    if args.small:
        args.epochs = args.tuned = 1
    recordings = (
        af.load([args.recordings]).recordings
        if args.recordings
        else af.simulate(6 if args.small else 40)
    )
    windows = af.make_windows(recordings.frames, recordings.labels, recordings.layout)
    for split in args.splits:
        parts = af.split(windows, seed=split)
        first, second = (
            base(args.out / f"base{seed}", parts, recordings.layout, seed, args)
            for seed in (split, split + OTHER)
        )
        adapter = af.Adapter(first, *parts[:2])
        y, truth = torch.from_numpy(adapter.validation.y), parts[2].y
        sets = cases(recordings.layout, split, args.recordings is None)
        wanted = [
            name
            for name in sets
            if name in ("random 50%", "100 cells", "five rows, all pads", "one pad")
        ]
        for name in wanted[: 1 if args.small else None]:
            for form, held, test, seconds in Trial(
                adapter, second, sets[name], parts[2], args.tuned, split
            ).results():
                loss = float(nn.functional.nll_loss(held - held.logsumexp(1, keepdim=True), y))
                accuracy = (held.argmax(1) == y).double().mean()
                reached = np.mean(test.argmax(1).numpy() == truth)
                print(
                    f"split {split}, {name:20s} {form:10s} validation loss {loss:.4f}, accuracy"
                    f" {accuracy:.4f}; test {reached:.4f}; {seconds:.0f} s CPU",
                    flush=True,
                )


if __name__ == "__main__":
    main()
