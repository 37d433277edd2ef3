"""What the network is trained to make small."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from features_network import CLASSES
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy, normalize, one_hot

_MARGIN, _STEEPNESS, _SHAPE = 0.15, 20.0, 10.0


class IdentityLoss(nn.Module):
    """Cross entropy over the training persons with a cosine margin, and the shape of the head read off linearly.

    Wang et al., "CosFace: Large Margin Cosine Loss for Deep Face Recognition", CVPR 2018, for the margin. The shape is
    the person's neutral landmarks: embeddings are then near where heads are alike, not only where they are one.
    """

    def __init__(self, identities: int, shapes: Tensor, embedding: int) -> None:
        """:param shapes: (p, k) of the training persons"""
        super().__init__()
        self.centers = nn.Parameter(torch.randn(identities, embedding) * 0.1)
        self.shape = nn.Linear(embedding, shapes.shape[1])
        self.register_buffer("mean", shapes.mean(0))
        self.register_buffer("deviation", (shapes - shapes.mean(0)).std())

    def forward(self, embedding: Tensor, identities: Tensor, shapes: Tensor) -> Tensor:
        """The mean over embeddings (b, d) of any length of persons with landmarks (b, k).

        :param identities: (b,) numbers of the persons; -1: by landmarks alone
        """
        unit = normalize(embedding, dim=1)
        cosines = unit @ normalize(self.centers, dim=1).T
        margins = _MARGIN * one_hot(identities.clamp(min=0), len(self.centers))
        missed = self.shape(unit * unit.shape[1] ** 0.5) - (shapes - self.mean) / self.deviation
        classified = cross_entropy(_STEEPNESS * (cosines - margins), identities, ignore_index=-1)
        return classified + _SHAPE * missed.square().mean()


def class_weights(labels: Tensor) -> Tensor:
    """(11,) weights of the classes: by the root of how rare each is, mean 1 over the pixels; 0 where there is none."""
    shares = torch.bincount(labels.flatten().long(), minlength=len(CLASSES)).double()
    shares /= shares.sum()
    weights = torch.where(shares > 0, shares.clamp(min=1e-4) ** -0.5, 0.0)
    return (weights / (weights * shares).sum()).float()


def semantic_loss(logits: Tensor, classes: Tensor, weights: Tensor) -> Tensor:
    """Weighted cross entropy, and 1 - Dice averaged over the classes that the batch shows; below 0 is no class.

    Milletari et al., "V-Net", 3DV 2016, for the Dice term: it counts small parts as much as large ones.
    """
    known = (classes >= 0)[:, None]
    truth = one_hot(classes.clamp(min=0), len(CLASSES)).movedim(3, 1) * known
    found = logits.softmax(1) * known
    shown = truth.sum((0, 2, 3))
    dice = 2 * (found * truth).sum((0, 2, 3)) / (found.sum((0, 2, 3)) + shown + 1.0)
    return cross_entropy(logits, classes, weights, ignore_index=-1) + (1 - dice)[shown > 0].mean()


def attribute_loss(logits: Tensor, values: Tensor) -> Tensor:
    """Binary cross entropy with values 0..1 (b, a), those that are NaN left out."""
    known = values.isfinite()
    return binary_cross_entropy_with_logits(logits[known], values[known]) if known.any() else 0 * logits.sum()


def light_loss(content: Sequence[Tensor]) -> Tensor:
    """How far features move by light, in terms of how far they are from those of the next head.

    :param content: (2 b, c, h, w) the same b heads twice, in two lights
    """
    ratios = []
    for features in content:
        one, other = features.chunk(2)
        apart = (one - one.roll(1, 0)).abs().mean()
        ratios.append((one - other).abs().mean() / (apart + 1e-3))
    return torch.stack(ratios).mean()
