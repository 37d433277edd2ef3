"""The terms of the joint loss that look through networks: content, identity and attributes ([0141]-[0164])."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.learn.features.crops import sample_crop
from facepipe.learn.features.description import Kind
from facepipe.learn.features.extractor import Extractor
from facepipe.learn.features.heads import Features


@dataclass(frozen=True, kw_only=True)
class _Model:
    """One network, the kinds that it is asked for, and what it sees in each photo."""

    extractor: Extractor
    kinds: tuple[Kind, ...]
    crops: tuple[FloatArray, ...]  # (2, 3) of each photo
    seen: tuple[Mapping[Kind, Features], ...]


class FeatureLosses:
    """What networks see in the photos, and how far pictures are from it."""

    def __init__(
        self, extractors: Mapping[Kind, Extractor], photos: Sequence[Tensor], landmarks: Sequence[FloatArray]
    ) -> None:
        """
        :param extractors: by kind: content, identity, attributes; a network of several kinds runs once
        :param photos: (h, w, 3) sRGB 0..1
        :param landmarks: (68, 2) pixels of these
        """
        self._models = []
        for extractor in dict.fromkeys(extractors.values()):
            kinds = tuple(kind for kind, one in extractors.items() if one is extractor)
            crops = tuple(extractor.crop_matrix(each) for each in landmarks)
            with torch.no_grad():
                seen = tuple(_see(extractor, photo, crop) for photo, crop in zip(photos, crops, strict=True))
            self._models.append(_Model(extractor=extractor, kinds=kinds, crops=crops, seen=seen))

    def __call__(self, image: Tensor, view: int) -> dict[str, Tensor]:
        """By kind, the term of a picture (h, w, 3) sRGB 0..1 of the photo with number `view`."""
        terms: dict[str, Tensor] = {}
        for model in self._models:
            found = _see(model.extractor, image, model.crops[view])
            for kind in model.kinds:
                terms[kind] = _TERMS[kind](found[kind], model.seen[view][kind])
        return terms


def _see(extractor: Extractor, picture: Tensor, crop: FloatArray) -> Mapping[Kind, Features]:
    return cast(Mapping[Kind, Features], extractor.features(sample_crop(picture, crop, extractor.size)))


def content(found: Features, seen: Features) -> Tensor:
    """Equation [0158]: the L1 distances at all depths, each the mean over its features and relative to their size."""
    pairs = zip(found, seen, strict=True)
    return torch.stack([(one - other).abs().mean() / other.abs().mean().clamp(min=1e-6) for one, other in pairs]).sum()


def identity(found: Features, seen: Features) -> Tensor:
    """Equation [0162]: 1 less the cosine of the embeddings."""
    return 1 - torch.nn.functional.cosine_similarity(_single(found), _single(seen), dim=-1).mean()


def attributes(found: Features, seen: Features) -> Tensor:
    """Equation [0142]: the L2 distance, over the square root of their number."""
    off = _single(found) - _single(seen)
    return (off * off).mean().clamp(min=1e-12).sqrt()


def _single(features: Features) -> Tensor:
    return features if isinstance(features, Tensor) else features[0]


_TERMS = {"content": content, "identity": identity, "attributes": attributes}
