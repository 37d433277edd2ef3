"""The joint loss of a face and photos of it: [0134]-[0167], every term by name.

Content, identity and attributes look through networks ([0141]-[0164]).

Colours are compared in fine detail before slow shading: the light of a photo is never that of nine spherical harmonics;
shadows, highlights and creases differ from it over many pixels, while lips, brows, lids and outlines differ over few.
So the difference is split into bands (the Laplacian pyramid of Burt and Adelson, 1983), of which the finest count most.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import cast

import torch
from torch import Tensor
from torch.nn import functional

from facepipe.core.arrays import FloatArray
from facepipe.networks.files import sample_crop
from facepipe.networks.onnx_file import Kind
from facepipe.photo.descent.descent import Unknowns
from facepipe.photo.descent.landmark_fit import LandmarkFit, huber, standardised
from facepipe.photo.descent.landmark_rig import COUNT
from facepipe.photo.descent.shadows import Shadows
from facepipe.photo.descent.subject import FOCAL
from facepipe.photo.descent.working_photo import WorkingPhoto, to_srgb
from facepipe.photo.features.extractor import Extractor, Features
from facepipe.photo.options import PhotoFitOptions
from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.face_model import FaceModel, Look
from facepipe.photo.renderer.light import KeyLight, hue_cost

SPREAD = (0.03, 0.03, 0.04, 0.20)  # sRGB by which each band is off where a fit is good, finest first; last the rest
_MOST = 4.0  # what a pixel counts at most: hair over a brow, clothes and shadows say nothing about a face
_USUAL = 0.35  # median of the differences in spreads that a good face has before it is fitted to pixels
FEATURES: tuple[Kind, ...] = ("content", "identity", "attributes")
IMAGE = ("color", *FEATURES)
_CORNER = 1e-3  # of a range, below which L1 norms are smooth


def color_loss(image: Tensor, photo: Tensor, coverage: Tensor, spread: Sequence[float] = SPREAD) -> Tensor:
    """Mean over the covered pixels and bands of the differences of pictures (h, w, 3), in spreads, none beyond `_MOST`.

    :param coverage: (h, w) 0..1
    """
    total = image.new_zeros(())
    for number, (band, width) in enumerate(zip(_bands(image - photo, len(spread)), spread, strict=True)):
        values = band / width
        # half the squares of small values, at most `_MOST` of large ones (Geman and McClure)
        square = values * values
        total = (
            total + 4.0**number * (0.5 * square / (1 + square / (2 * _MOST))).mean(dim=1).sum()
        )  # a coarse pixel stands for many
    return total / (len(spread) * coverage.detach().sum().clamp(min=1))


def _bands(difference: Tensor, count: int) -> Iterator[Tensor]:
    """(1, 3, h, w) what each halving of a picture (h, w, 3) loses, then the rest."""
    rest = difference.permute(2, 0, 1)[None]
    for _ in range(count - 1):
        padded = functional.pad(rest, (0, rest.shape[3] % 2, 0, rest.shape[2] % 2), mode="replicate")
        smooth = functional.avg_pool2d(functional.pad(padded, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
        coarse = functional.avg_pool2d(smooth, 2)
        yield rest - functional.interpolate(coarse, rest.shape[2:], mode="bilinear", align_corners=False)
        rest = coarse
    yield rest


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
        # networks with the kinds that they are asked for, each photo's crop (2, 3), and what they see there
        self._models = []
        for extractor in dict.fromkeys(extractors.values()):
            kinds = tuple(kind for kind, one in extractors.items() if one is extractor)
            crops = tuple(extractor.crop_matrix(each) for each in landmarks)
            with torch.no_grad():
                seen = tuple(_see(extractor, photo, crop) for photo, crop in zip(photos, crops, strict=True))
            self._models.append((extractor, kinds, crops, seen))

    def __call__(self, image: Tensor, view: int) -> dict[str, Tensor]:
        """By kind, the term of a picture (h, w, 3) sRGB 0..1 of the photo with number `view`."""
        terms: dict[str, Tensor] = {}
        for extractor, kinds, crops, seen in self._models:
            found = _see(extractor, image, crops[view])
            terms |= {kind: _TERMS[kind](found[kind], seen[view][kind]) for kind in kinds}
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


class JointLoss:
    """Unknowns to weighted terms."""

    def __init__(
        self,
        model: FaceModel,
        fit: LandmarkFit,
        photos: Sequence[WorkingPhoto],
        extractors: Mapping[Kind, Extractor],
        options: PhotoFitOptions,
    ) -> None:
        self.options = options = options.with_networks(extractors)
        self.model, self.fit, self.photos = model, fit, tuple(photos)
        self.shadows: list[Shadows | None] = [None] * len(self.photos)  # None: no lamp either
        subject = fit.subject
        self.spreads: list[tuple[float, ...]] = [SPREAD] * len(self.photos)
        self._free = torch.as_tensor(subject.sliders)
        self._shapes = torch.as_tensor(subject.expressions, dtype=torch.int64)
        self._lower, self._upper, self._default = (
            torch.as_tensor(each, dtype=torch.float32)
            for each in (subject.lower, subject.upper, subject.default_shares)
        )
        used = {kind: one for kind, one in extractors.items() if getattr(options, kind) > 0}
        marks = [photo.landmarks(each[:COUNT]) for photo, each in zip(self.photos, fit.targets, strict=True)]
        self._features = FeatureLosses(used, [photo.pixels for photo in self.photos], marks)

    def __call__(self, at: Unknowns) -> dict[str, Tensor]:
        """Every term that is switched on, weighted, and their sum as "total"; image terms are means over the photos."""
        options, priors = self.options, self.fit.priors
        sliders = self.sliders(at.shares)
        views = range(len(self.photos))
        terms = [self._of_view(at, sliders, view) for view in views]
        result = {name: sum(each[name] for each in terms) / len(terms) for name in terms[0]}
        off = (at.shares - self._default).abs()
        # All photos share the person: like the others, the term is its share in one of them.
        person = 0.5 * (off * off).sum() / priors.slider_sigma**2 / len(self.photos)
        lens = (at.poses[:, 5:].sum(dim=1) - math.log(FOCAL)) / priors.focal_sigma
        result["prior"] = (person + 0.5 * (lens * lens).mean()) / COUNT
        result["sparsity"] = (off * off + _CORNER**2).sqrt().sum()
        result["expression_sparsity"] = at.expressions.sum(dim=1).mean()
        result["hue"] = torch.stack([hue_cost(*one) for one in zip(at.light, at.key, strict=True)]).mean()
        weights = {name: getattr(options, name, 1.0) for name in result}  # the prior has none
        weights["sparsity"] = priors.slider_sparsity / COUNT
        weighted = {name: weights[name] * value for name, value in result.items() if weights[name]}
        return {**weighted, "total": sum(weighted.values(), 0 * at.poses.sum())}  # with a slope without terms too

    def calibrate(self, at: Unknowns) -> None:
        """Trust the pixels of each photo as far as the face explains them at its start."""
        with torch.no_grad():
            for view, photo in enumerate(self.photos):
                picture, coverage = self._picture(at, view)
                # the spreads for a photo that shows what the face can't: wider where its pixels differ more than is
                # usual. A face without the photo's freckles, hair or beard is to be led by landmarks and features more
                # than by pixels.
                covered = coverage.detach()[None, None]
                wider = []
                for band, width in zip(_bands((picture - photo.pixels).detach(), len(SPREAD)), SPREAD, strict=True):
                    inside = functional.interpolate(covered, band.shape[2:], mode="area")[0, 0] > 0.5
                    sizes = band[0].abs().mean(dim=0)[inside]
                    typical = float(sizes.median()) / width if len(sizes) else 0.0
                    wider.append(width * max(1.0, typical / _USUAL))
                self.spreads[view] = tuple(wider)

    def sliders(self, shares: Tensor) -> Tensor:
        """(s,) values of all sliders from the free ones' shares (f,)."""
        own = self.model.rig.sliders.value
        return own.index_copy(0, self._free, self._lower + shares * (self._upper - self._lower))

    def weights(self, expressions: Tensor) -> Tensor:
        """(shapes,) weights of all shapes from those of the expressions (e,)."""
        zero = expressions.new_zeros(len(self.model.rig.shapes))
        return zero.index_copy(0, self._shapes, expressions)

    def image(self, at: Unknowns, view: int) -> Tensor:
        """(h, w, 4) linear colour over the photo, and coverage, in the photo's working pixels."""
        photo = self.photos[view]
        points = self.model.rig(self.sliders(at.shares), self.weights(at.expressions[view]))
        height, width = photo.size
        return self.model.image(points, self.look(at, view), height=height, width=width)

    def look(self, at: Unknowns, view: int) -> Look:
        """Camera, light and colours of a photo."""
        camera = single(self.photos[view].camera(self.fit.spaces[view].camera(at.poses[view])))
        shadows = self.shadows[view]
        return Look(
            camera=camera,
            light=at.light[view],
            background=self.photos[view].linear,
            tint=at.tint.exp(),
            shadow=None if shadows is None else shadows.transfer,
            key=None if shadows is None else KeyLight(numbers=at.key[view], arriving=shadows.arriving),
        )

    def _of_view(self, at: Unknowns, sliders: Tensor, view: int) -> dict[str, Tensor]:
        terms: dict[str, Tensor] = {}
        if self.options.landmarks:
            # [0138] in standard deviations, robust: Huber's norm, summed; contour points slide
            rig, camera = self.fit.rig, self.fit.spaces[view].camera(at.poses[view])
            points = rig.rig(sliders.double(), self.weights(at.expressions[view]).double())
            marks, outward = rig.landmarks(points, camera)
            targets = self.fit.targets[view]
            off = standardised(marks[: len(targets)], outward, targets, self.fit.sigma[view])
            terms["landmarks"] = huber(off).sum() / COUNT
        if not any(getattr(self.options, name) for name in IMAGE):
            return terms
        picture, coverage = self._picture(at, view)
        if self.options.color:
            terms["color"] = color_loss(picture, self.photos[view].pixels, coverage, self.spreads[view])
        return {**terms, **self._features(picture, view)}

    def _picture(self, at: Unknowns, view: int) -> tuple[Tensor, Tensor]:
        """(h, w, 3) sRGB, behind what covers the face in the photo, and (h, w) where it shows."""
        photo, image = self.photos[view], self.image(at, view)
        picture, coverage = to_srgb(image[..., :3]), image[..., 3]
        if bool((photo.face == 1).all()):
            return picture, coverage
        return torch.lerp(photo.pixels, picture, photo.face[..., None]), coverage * photo.face


def single(camera: Camera) -> Camera:
    """A camera in float32."""
    return Camera(
        rotation=camera.rotation.float(),
        translation=camera.translation.float(),
        focal=camera.focal.float(),
        center=camera.center.float(),
    )
