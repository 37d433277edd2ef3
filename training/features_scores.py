"""How well the network does on heads that it was not trained on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from features_data import Heads
from features_network import CLASSES, LABEL_SIZE, normalised
from torch import Tensor

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

Network = Callable[[Tensor], tuple[Tensor, ...]]  # normalised images -> `OUTPUTS`

_BATCH = 64


def intersections_over_unions(found: IntArray, truth: IntArray) -> dict[str, float]:
    """Class -> IoU over all pixels of two arrays of classes, of the classes that either shows."""
    pairs = np.bincount((truth * len(CLASSES) + found).ravel(), minlength=len(CLASSES) ** 2)
    table = pairs.reshape(len(CLASSES), len(CLASSES)).astype(np.float64)
    unions = table.sum(0) + table.sum(1) - table.diagonal()
    return {name: float(table[i, i] / unions[i]) for i, name in enumerate(CLASSES) if unions[i]}


def verification(embeddings: FloatArray, heads: Heads) -> dict[str, float]:
    """Area under the curve and equal error rate of telling pairs of one person from pairs of two by their cosine.

    Pairs of two persons are of one source, so that its style shows nothing.

    :param embeddings: (n, d) of unit length
    """
    first, second = np.triu_indices(len(embeddings), 1)
    kept = heads.sources[first] == heads.sources[second]
    first, second = first[kept], second[kept]
    cosines = np.einsum("nd,nd->n", embeddings[first], embeddings[second])
    same = heads.identities[first] == heads.identities[second]
    order = np.argsort(-cosines, kind="stable")
    hits, alarms = (np.concatenate([[0.0], np.cumsum(one[order]) / one.sum()]) for one in (same, ~same))
    crossing = int(np.argmin(np.abs(1 - hits - alarms)))
    return {
        "pairs_same": int(same.sum()),
        "pairs_different": int((~same).sum()),
        "area_under_curve": _round(np.trapezoid(hits, alarms)),
        "equal_error_rate": _round((1 - hits[crossing] + alarms[crossing]) / 2),
        "cosine_same": _round(cosines[same].mean()),
        "cosine_different": _round(cosines[~same].mean()),
    }


def held_out_scores(network: Network, heads: Heads, predictor: FloatArray) -> dict[str, Any]:
    """Scores on persons not trained on, in the light and colours that they were rendered with.

    :param network: in evaluation
    :param predictor: (a,) attributes that know nothing of the image: those of training, averaged
    """
    found = answers(network, heads)
    shown = found.truth >= 0
    overlap = intersections_over_unions(found.classes[shown], found.truth[shown])
    known = np.isfinite(heads.attributes)
    kinds = {"other_looks": np.flatnonzero(heads.changing), "one_look": np.flatnonzero(~heads.changing)}
    return {
        "images": len(heads),
        "persons": len(np.unique(heads.identities)),
        "intersection_over_union": {name: _round(value) for name, value in overlap.items()},
        "mean_intersection_over_union": _round(np.mean(list(overlap.values()))),
        "verification": {
            kind: verification(found.embeddings[rows], heads.take(rows)) for kind, rows in kinds.items() if len(rows)
        },
        "attribute_error": _round(np.abs(found.attributes - heads.attributes)[known].mean()),
        "attribute_error_of_the_mean": _round(np.abs(predictor - heads.attributes)[known].mean()),
    }


class Answers(NamedTuple):
    """The network's answers for many pictures, and the classes that they show."""

    classes: IntArray  # (n, 64, 64)
    truth: IntArray  # (n, 64, 64), below 0 outside of the picture
    embeddings: FloatArray  # (n, d) unit length
    attributes: FloatArray  # (n, a)


def answers(network: Network, heads: Heads) -> Answers:
    """What the network finds in the crops that the landmarks ask for."""
    parts = []
    with torch.no_grad():
        for rows in np.array_split(np.arange(len(heads)), max(1, len(heads) // _BATCH)):
            images, truth = heads.cropped(rows, LABEL_SIZE)
            _, _, _, probabilities, embedding, attributes = network(normalised(images))
            parts.append((probabilities.argmax(1), truth, embedding, attributes))
    return Answers(*(torch.cat(one).numpy() for one in zip(*parts, strict=True)))


def _round(value: float) -> float:
    return round(float(value), 4)
