"""Whether any fine-tuning beats the head in closed form: fine_tuning.py [GRASPS.npz] [--splits 0 1] [--small]

For each split and fault set the network is trained for a few epochs behind the linear fill, in one of the forms below.
Then a head is fitted to its features, as to those of the fault-free network ("head"). Printed are loss and accuracy on
validation recordings, of heads fitted without them, the accuracy on test recordings, and the CPU seconds.

    all        every parameter, cross entropy
    norms      scale and offset of the LayerNorms alone, cross entropy
    distil     every parameter; targets are features and probabilities of the fault-free network that sees all cells of
               the same windows, so no label is used
    average    mean of the weights of "all" and the fault-free ones
    two heads  mean of the probabilities of "head" and the head of "all"

The fault-free networks are kept in ``--out``, or read from there (base0 for split 0, as adaptation_figures.py keeps
them). Without recordings the grasps are simulated.
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
from torch import Tensor, nn

import adaptfault as af
from adaptfault.adaptation.reduced_model import ReducedModel, reduce_windows
from adaptfault.adaptation.stages import Run
from adaptfault.models.network import logits_of
from diagnostics import FaultSet

RATE, NORM_RATE, BATCH = 1e-4, 1e-3, 32


class Trial:
    """Forms of fine-tuning for one fault set."""

    def __init__(self, adapter: af.Adapter, faults: FaultSet, test: af.Windows, epochs: int, seed: int) -> None:
        self.adapter, self.faults, self.epochs, self.seed = adapter, faults, epochs, seed
        self.run = Run(adapter, faults, None, seed, False)
        self.test = reduce_windows(test, faults)

    def behind(self, network: nn.Module) -> ReducedModel:
        front = self.adapter.imputation.linear(self.faults)
        return ReducedModel(network, self.faults, front if len(self.faults) else None).eval()

    def head(self, network: nn.Module) -> tuple[Tensor, Tensor]:
        """Return log probabilities of validation and test windows with a head on the features of a network."""
        self.run.quick = self.adapter.compacted(network)
        reduced = self.behind(network)
        reduced.head, held = self.run._head(reduced)
        return held.log_softmax(1), logits_of(reduced, self.test.x, batch_size=64).log_softmax(1)

    def tuned(self, form: str) -> nn.Module:
        network, free = copy.deepcopy(self.adapter.model), self.adapter.model
        reduced = self.behind(network)
        trained = list(reduced.parameters())
        if form == "norms":
            trained = [
                p for module in network.modules() if isinstance(module, nn.LayerNorm) for p in module.parameters()
            ]
        optimizer = torch.optim.Adam(trained, lr=NORM_RATE if form == "norms" else RATE)
        whole, y = (torch.from_numpy(of) for of in (self.adapter.train.x, self.adapter.train.y))
        with torch.no_grad():
            wanted = torch.cat([free.features(x) for x in torch.split(whole, 256)])
            likely = free.head(wanted).softmax(1)
        generator = torch.Generator().manual_seed(self.seed)
        reduced.train()
        for _ in range(self.epochs):
            for i in torch.randperm(len(y), generator=generator).split(BATCH):
                features = network.features(reduced.complete(whole[i][..., self.faults.healthy]))
                logits = network.head(network.dropout(features))
                loss = nn.functional.cross_entropy(logits, likely[i] if form == "distil" else y[i])
                if form == "distil":
                    loss = loss + nn.functional.mse_loss(features, wanted[i]) / wanted.var()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
        return network.eval()

    def results(self) -> Iterator[tuple[str, Tensor, Tensor, float]]:
        """Yield each form with the outputs for validation and test windows and the CPU seconds."""
        found, networks = {}, {}
        for form in ("head", "all", "norms", "distil", "average", "two heads"):
            began = time.process_time()
            if form == "two heads":
                found[form] = tuple(torch.logaddexp(*of) for of in zip(found["head"], found["all"], strict=True))
            else:
                free = self.adapter.model
                match form:
                    case "head":
                        networks[form] = free
                    case "average":
                        networks[form] = averaged(free, networks["all"])
                    case _:
                        networks[form] = self.tuned(form)
                found[form] = self.head(networks[form])
            yield form, *found[form], time.process_time() - began


def averaged(first: nn.Module, second: nn.Module) -> nn.Module:
    mean = copy.deepcopy(first)
    with torch.no_grad():
        for parameter, other in zip(mean.parameters(), second.parameters(), strict=True):
            parameter.lerp_(other, 0.5)
    return mean


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="?", help="labelled recordings of a healthy array")
    parser.add_argument("--splits", type=int, nargs="+", default=[0])
    parser.add_argument("--epochs", type=int, default=20, help="of the fault-free network")
    parser.add_argument("--tuned", type=int, default=2, help="epochs of fine-tuning")
    parser.add_argument("--small", action="store_true", help="the smallest setting, to see that everything runs")
    parser.add_argument("--out", type=Path, default=Path("fine_tuning"), help="where fault-free networks are")
    args = parser.parse_args()
    args.repairable = False
    if args.small:
        args.epochs = args.tuned = 1
    recordings = af.load([args.recordings]).recordings if args.recordings else af.simulate(6 if args.small else 40)
    windows = af.make_windows(recordings.frames, recordings.labels, recordings.layout)
    for split in args.splits:
        parts = af.split(windows, seed=split)
        adapter = af.Adapter(base(args.out / f"base{split}", parts, recordings.layout, split, args), *parts[:2])
        y, truth = torch.from_numpy(adapter.validation.y), parts[2].y
        sets = cases(recordings.layout, split, args.recordings is None)
        wanted = [name for name in sets if name in ("random 50%", "100 cells", "five rows, all pads", "one pad")]
        for name in wanted[: 1 if args.small else None]:
            for form, held, test, seconds in Trial(adapter, sets[name], parts[2], args.tuned, split).results():
                loss = float(nn.functional.nll_loss(held - held.logsumexp(1, keepdim=True), y))
                accuracy, reached = (held.argmax(1) == y).double().mean(), np.mean(test.argmax(1).numpy() == truth)
                print(
                    f"split {split}, {name:20s} {form:10s} validation loss {loss:.4f}, accuracy {accuracy:.4f};"
                    f" test {reached:.4f}; {seconds:.0f} s CPU",
                    flush=True,
                )


if __name__ == "__main__":
    main()
