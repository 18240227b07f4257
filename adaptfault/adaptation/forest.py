"""A forest of randomised trees as a torch module: a second classifier of the healthy cells."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

TREES = 100


class Forest(nn.Module):
    """Extremely randomised trees (Geurts, Ernst and Wehenkel 2006), grown by scikit-learn, run by torch.

    Args:
        nodes: int64 ``[trees, nodes, 3]``: feature, next node if it is at most the threshold, next node if above. A
            leaf is its own next node, and its feature is its class.
        thresholds: float32 ``[trees, nodes]``; infinite at a leaf.
        depth: of the deepest tree.
        n_classes: number of logits.
    """

    nodes: Tensor
    thresholds: Tensor

    def __init__(self, nodes: Tensor, thresholds: Tensor, depth: int, n_classes: int) -> None:
        super().__init__()
        self.depth, self.n_classes = depth, n_classes
        self.register_buffer("nodes", nodes.to(torch.int32))
        self.register_buffer("thresholds", thresholds)

    @classmethod
    def fit(cls, x: Tensor, y: NDArray[np.int64], n_classes: int, *, trees: int = TREES, seed: int = 0) -> Forest:
        """Fit trees to ``x [M, p]`` and classes ``y [M]``, with as many threads as torch, on the device of x."""
        from sklearn.ensemble import ExtraTreesClassifier

        # The number of threads does not change the trees: each has a seed of its own.
        grown = ExtraTreesClassifier(trees, random_state=seed, n_jobs=torch.get_num_threads()).fit(x.cpu().numpy(), y)
        of_each = [estimator.tree_ for estimator in grown.estimators_]
        most = max(tree.node_count for tree in of_each)
        nodes, thresholds = np.zeros((trees, most, 3), np.int64), np.full((trees, most), np.inf, np.float32)
        for i, tree in enumerate(of_each):
            n, leaf = tree.node_count, tree.children_left < 0
            itself, classes = np.arange(n), grown.classes_[tree.value[:, 0].argmax(axis=1)]
            nodes[i, :n, 0] = np.where(leaf, classes, tree.feature)
            nodes[i, :n, 1] = np.where(leaf, itself, tree.children_left)
            nodes[i, :n, 2] = np.where(leaf, itself, tree.children_right)
            thresholds[i, :n] = np.where(leaf, np.inf, _as_float32(tree.threshold))
        depth = max(tree.max_depth for tree in of_each)
        forest = cls(torch.from_numpy(nodes), torch.from_numpy(thresholds), depth, n_classes)
        return forest.to(x.device)

    def __add__(self, other: Forest) -> Forest:
        """Return the forest with the trees of both."""
        most = max(self.thresholds.shape[1], other.thresholds.shape[1])
        pad = [most - forest.thresholds.shape[1] for forest in (self, other)]
        nodes = [nn.functional.pad(f.nodes, (0, 0, 0, n)) for f, n in zip((self, other), pad, strict=True)]
        thresholds = [
            nn.functional.pad(f.thresholds, (0, n), value=np.inf) for f, n in zip((self, other), pad, strict=True)
        ]
        return Forest(torch.cat(nodes), torch.cat(thresholds), max(self.depth, other.depth), self.n_classes)

    @classmethod
    def empty(cls, about: dict[str, Any]) -> Forest:
        """Build a forest to load a state into, from :attr:`about`."""
        trees, nodes = about["shape"]
        return cls(torch.zeros(trees, nodes, 3), torch.zeros(trees, nodes), about["depth"], about["n_classes"])

    @property
    def about(self) -> dict[str, Any]:
        """Arguments of :meth:`empty`; JSON-safe."""
        return {"shape": list(self.thresholds.shape), "depth": self.depth, "n_classes": self.n_classes}

    def forward(self, x: Tensor) -> Tensor:
        """Map ``[N, p]`` to logits ``[N, n_classes]``: log vote shares with one extra vote spread evenly."""
        trees, nodes = self.thresholds.shape
        first = nodes * torch.arange(trees, device=x.device)  # of each tree's nodes, all being in one row
        feature, below, above = self.nodes.long().unbind(-1)
        tested = feature.masked_fill(torch.isinf(self.thresholds), 0).flatten()
        thresholds, below, above = (
            of.flatten() for of in (self.thresholds, below + first[:, None], above + first[:, None])
        )
        at = first.expand(x.shape[0], trees)
        for _ in range(self.depth):
            at = torch.where(torch.gather(x, 1, tested[at]) <= thresholds[at], below[at], above[at])
        votes = nn.functional.one_hot(feature.flatten()[at], self.n_classes).sum(1)
        return ((votes + 1 / self.n_classes) / (trees + 1)).log()


def _as_float32(threshold: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the largest float32 not above each threshold, which gives the same decisions as the double."""
    single = threshold.astype(np.float32)
    return np.where(single > threshold, np.nextafter(single, np.float32(-np.inf)), single)
