"""The head of earlier versions, which is no longer fitted: bundles and adapted models that hold one can be read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn


class EarlierHead(nn.Module):
    """One kernel ridge regression with a weighted sum of two kernels, and at times a forest of randomised trees.

    Args:
        about: what an earlier version stored of it: shapes of the views, the share of the kernel regression in the
            probabilities, and shape and scale of the forest.
        n_classes: number of logits.
    """

    def __init__(self, about: Mapping[str, Any], n_classes: int) -> None:
        super().__init__()
        self.about, self.n_classes = dict(about), n_classes
        shapes, forest = about["kernel"], about["forest"]
        m, k = shapes[0][0], len(shapes)
        self.kernel = nn.Module()
        for i, shape in enumerate(shapes):
            self.kernel.register_buffer(f"known{i}", torch.zeros(*shape))
        for name, size in (("widths", (k,)), ("shares", (k,)), ("weights", (m, n_classes)), ("bias", (n_classes,))):
            self.kernel.register_buffer(name, torch.zeros(*size))
        self.forest: nn.Module | None = None
        if forest is not None:
            self.forest = nn.Module()
            self.forest.register_buffer("nodes", torch.zeros(*forest["shape"], 3, dtype=torch.int32))
            self.forest.register_buffer("thresholds", torch.zeros(*forest["shape"]))

    def forward(self, views: Sequence[Tensor]) -> Tensor:
        """Map features and cells of N windows, each ``[N, p]``, to logits ``[N, n_classes]``."""
        part = self.kernel.get_buffer
        similar = torch.zeros((), dtype=torch.double, device=views[0].device)
        for i, (share, width) in enumerate(zip(part("shares"), part("widths"), strict=True)):
            distance = torch.cdist(views[i].double(), part(f"known{i}").double()).square()
            similar = similar + share * torch.exp(-distance / width)
        logits: Tensor = (similar @ part("weights").double() + part("bias")).float()
        if self.forest is None:
            return logits
        share = self.about["share"]
        voted = torch.softmax(self.about["scale"] * self._votes(views[1]), 1)
        mixed: Tensor = share * torch.softmax(logits, 1) + (1 - share) * voted
        return mixed.clamp_min(torch.finfo(mixed.dtype).tiny).log()

    def _votes(self, x: Tensor) -> Tensor:
        """Map ``[N, p]`` to log shares of the trees' votes, with one extra vote spread evenly.

        A node holds a feature, the next node if it is at most the threshold, and the next node if above. A leaf has an
        infinite threshold, is its own next node, and holds its class.
        """
        assert self.forest is not None
        nodes, thresholds = self.forest.get_buffer("nodes").long(), self.forest.get_buffer("thresholds")
        trees = torch.arange(len(nodes), device=x.device).expand(len(x), -1)
        at = torch.zeros_like(trees)
        for _ in range(self.about["forest"]["depth"]):
            feature, below, above = nodes[trees, at].unbind(-1)
            threshold = thresholds[trees, at]
            tested = torch.gather(x, 1, feature.masked_fill(torch.isinf(threshold), 0))
            at = torch.where(tested <= threshold, below, above)
        votes = nn.functional.one_hot(nodes[trees, at, 0], self.n_classes).sum(1)
        logits: Tensor = ((votes + 1 / self.n_classes) / (len(nodes) + 1)).log()
        return logits
