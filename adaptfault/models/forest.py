"""Extremely randomised trees (Geurts, Ernst and Wehenkel 2006) as tensors: fitted by scikit-learn,
stored as arrays, run by torch and by ONNX Runtime."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.ensemble import ExtraTreesClassifier, ExtraTreesRegressor
from torch import Tensor, nn

GROUPS = 5  # of trees, each fitted without one fold of the held-out windows
TREES = 20  # of a group
_DEPTH = 16  # the most splits between a root and a leaf


class Forest(nn.Module):
    """Trees whose mean is a probability of each class, or a value.

    The nodes of all trees lie in one array, in the order of a walk that goes left first: the left
    child of a node follows it. A leaf is its own right child, and its threshold is -inf. Leaves
    with equal outputs share a row of ``outputs``.

    Args:
        roots: int ``[trees]``, the first node of each tree.
        feature: int ``[nodes]``, which input a node compares.
        threshold: ``[nodes]``; an input up to it goes left.
        right: int ``[nodes]``, the right child.
        row: int ``[nodes]``, of the outputs of a leaf.
        outputs: ``[rows, n]``.
    """

    roots: Tensor
    feature: Tensor
    threshold: Tensor
    right: Tensor
    row: Tensor
    outputs: Tensor

    def __init__(
        self,
        roots: Tensor,
        feature: Tensor,
        threshold: Tensor,
        right: Tensor,
        row: Tensor,
        outputs: Tensor,
    ) -> None:
        super().__init__()
        self.register_buffer("roots", roots)
        self.register_buffer("feature", feature)
        self.register_buffer("threshold", threshold)
        self.register_buffer("right", right)
        self.register_buffer("row", row)
        self.register_buffer("outputs", outputs)

    @classmethod
    def empty(cls, about: Mapping[str, int], n: int) -> Forest:
        """Build a forest to load a state into, from :attr:`about` and the number of outputs."""
        nodes = about["nodes"]
        whole = torch.zeros(nodes, dtype=torch.int32)
        return cls(
            torch.zeros(about["trees"], dtype=torch.int32),
            whole.clone(),
            torch.full((nodes,), -torch.inf),
            whole.clone(),
            whole.clone(),
            torch.zeros(about["rows"], n),
        )

    @classmethod
    def blank(cls, n: int) -> Forest:
        """Build a forest of the usual number of trees that are leaves, all with output 0."""
        return cls.empty({"trees": GROUPS * TREES, "nodes": 1, "rows": 1}, n)

    @property
    def about(self) -> dict[str, int]:
        """Argument of :meth:`empty`; JSON-safe."""
        return {
            "trees": len(self.roots),
            "nodes": len(self.feature),
            "rows": len(self.outputs),
        }

    def reading(self, places: NDArray[np.int64]) -> Forest:
        """Return the same forest for inputs in another order: input i is found at ``places[i]``."""
        feature = torch.from_numpy(places)[self.feature.long()].int()
        return Forest(self.roots, feature, self.threshold, self.right, self.row, self.outputs)

    def scaled(self, unit: Tensor, shift: Tensor) -> Forest:
        """Return the same forest with its outputs times ``unit [n]`` plus ``shift [n]``."""
        return Forest(
            self.roots,
            self.feature,
            self.threshold,
            self.right,
            self.row,
            self.outputs * unit + shift,
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map inputs ``[N, p]``, in double precision, to the mean of the trees ``[N, n]``.

        Single precision would put an input that differs by rounding on the other side of a
        threshold now and then.
        """
        node = self.roots.long().expand(x.shape[0], -1)
        feature = self.feature.long()
        threshold = self.threshold.double()
        right = self.right.long()
        for _ in range(_DEPTH):
            left = x.gather(1, feature[node]) <= threshold[node]
            node = torch.where(left, node + 1, right[node])
        return self.outputs[self.row[node].long()].mean(1)


def fit_forest(
    x: NDArray[np.float64],
    targets: NDArray[np.float32],
    folds: NDArray[np.int64],
    *,
    values: bool = False,
) -> tuple[Forest, Tensor]:
    """Fit a forest in groups of trees, each without one fold of the held-out windows.

    All groups together are the forest. The outputs for a held-out window are those of the group
    that was fitted without it, a fifth of the trees, so they are somewhat worse than the forest.

    Args:
        x: ``[M, p]``; the last n windows are held out.
        targets: ``[M, k]``, values, or class indicators or probabilities, of which the most likely
            class counts.
        folds: int ``[n]``, 0 to 4.
        values: the targets are values.

    Returns:
        The forest, and its outputs ``[n, k]`` for the held-out windows.
    """
    m = len(x) - len(folds)
    single = x.astype(np.float32)
    found = torch.zeros(len(folds), targets.shape[1])
    groups = []
    for fold in range(GROUPS):
        out = np.flatnonzero(folds == fold)
        used = np.delete(np.arange(len(x)), m + out)
        group = _grown(single[used], targets[used], fold, values)
        groups.append(group)
        found[out] = group(torch.from_numpy(x[m + out]))
    return _joined(groups), found


def _grown(x: NDArray[np.float32], targets: NDArray[np.float32], seed: int, values: bool) -> Forest:
    """Fit a group of trees."""
    kind = ExtraTreesRegressor if values else ExtraTreesClassifier
    ensemble = kind(
        TREES,
        max_depth=_DEPTH,
        max_features=1 / 3 if values else "sqrt",
        random_state=seed,
        n_jobs=torch.get_num_threads(),
    )
    ensemble.fit(x, targets if values else targets.argmax(axis=1))
    trees = [each.tree_ for each in ensemble.estimators_]
    counts = [tree.node_count for tree in trees]
    roots = np.cumsum([0, *counts[:-1]])
    own = np.arange(sum(counts))
    feature = np.concatenate([tree.feature for tree in trees])
    leaf = feature < 0
    right = np.concatenate([tree.children_right for tree in trees]) + np.repeat(roots, counts)
    threshold = np.concatenate([tree.threshold for tree in trees])
    outputs = np.concatenate([tree.value for tree in trees])
    outputs = outputs[:, :, 0] if values else outputs[:, 0]
    said = outputs[leaf].astype(np.float32)
    # as bytes: that is quicker than by columns
    whole = np.ascontiguousarray(said).view(f"V{said.itemsize * said.shape[1]}").ravel()
    _, first, row = np.unique(whole, return_index=True, return_inverse=True)
    rows = said[first]
    every = np.zeros((len(rows), targets.shape[1]), dtype=np.float32)
    every[:, slice(None) if values else ensemble.classes_] = rows
    rows_of_nodes = np.zeros(len(leaf), dtype=np.int32)
    rows_of_nodes[leaf] = row.ravel()
    return Forest(
        roots=_tensor(roots),
        feature=_tensor(np.where(leaf, 0, feature)),
        threshold=torch.from_numpy(np.where(leaf, -np.inf, threshold).astype(np.float32)),
        right=_tensor(np.where(leaf, own, right)),
        row=torch.from_numpy(rows_of_nodes),
        outputs=torch.from_numpy(every),
    )


def _tensor(index: NDArray[Any]) -> Tensor:
    return torch.from_numpy(index.astype(np.int32))


def _joined(groups: list[Forest]) -> Forest:
    """Return the forest of all trees of several."""
    nodes = np.cumsum([0, *(len(group.feature) for group in groups)])
    rows = np.cumsum([0, *(len(group.outputs) for group in groups)])
    return Forest(
        torch.cat([group.roots + int(n) for group, n in zip(groups, nodes, strict=False)]),
        torch.cat([group.feature for group in groups]),
        torch.cat([group.threshold for group in groups]),
        torch.cat([group.right + int(n) for group, n in zip(groups, nodes, strict=False)]),
        torch.cat([group.row + int(n) for group, n in zip(groups, rows, strict=False)]),
        torch.cat([group.outputs for group in groups]),
    )
