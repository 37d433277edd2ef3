"""How much the pixels of two pictures differ, fine detail before slow shading.

The light of a photo is never that of nine spherical harmonics: shadows, highlights and creases differ from it over
many pixels, while lips, brows, lids and outlines differ over few. So the difference is split into bands (the Laplacian
pyramid of Burt and Adelson, 1983), of which the finest count most.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from torch import Tensor
from torch.nn import functional

SPREAD = (0.03, 0.03, 0.04, 0.20)  # sRGB by which each band is off where a fit is good, finest first; last the rest
_MOST = 4.0  # what a pixel counts at most: hair over a brow, clothes and shadows say nothing about a face
_USUAL = 0.35  # median of the differences in spreads that a good face has before it is fitted to pixels


def color_loss(image: Tensor, photo: Tensor, coverage: Tensor, spread: Sequence[float] = SPREAD) -> Tensor:
    """Mean over the covered pixels and bands of the differences of pictures (h, w, 3), in spreads, none beyond `_MOST`.

    :param coverage: (h, w) 0..1
    """
    total = image.new_zeros(())
    for number, (band, width) in enumerate(zip(_bands(image - photo, len(spread)), spread, strict=True)):
        total = total + 4.0**number * _robust(band / width).mean(dim=1).sum()  # a coarse pixel stands for many
    return total / (len(spread) * coverage.detach().sum().clamp(min=1))


def spread_of(image: Tensor, photo: Tensor, coverage: Tensor) -> tuple[float, ...]:
    """The spreads for a photo that shows what the face can't: wider where its pixels differ more than is usual.

    A face without the photo's freckles, hair or beard is to be led by landmarks and features more than by pixels.
    """
    covered = coverage.detach()[None, None]
    wider = []
    for band, width in zip(_bands((image - photo).detach(), len(SPREAD)), SPREAD, strict=True):
        inside = functional.interpolate(covered, band.shape[2:], mode="area")[0, 0] > 0.5
        sizes = band[0].abs().mean(dim=0)[inside]
        typical = float(sizes.median()) / width if len(sizes) else 0.0
        wider.append(width * max(1.0, typical / _USUAL))
    return tuple(wider)


def _bands(difference: Tensor, count: int) -> Iterator[Tensor]:
    """(1, 3, h, w) what each halving of a picture (h, w, 3) loses, then the rest."""
    rest = difference.permute(2, 0, 1)[None]
    for _ in range(count - 1):
        coarse = _halved(rest)
        yield rest - functional.interpolate(coarse, rest.shape[2:], mode="bilinear", align_corners=False)
        rest = coarse
    yield rest


def _halved(picture: Tensor) -> Tensor:
    """Half as many pixels each way, smoothed."""
    padded = functional.pad(picture, (0, picture.shape[3] % 2, 0, picture.shape[2] % 2), mode="replicate")
    smooth = functional.avg_pool2d(functional.pad(padded, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    return functional.avg_pool2d(smooth, 2)


def _robust(values: Tensor) -> Tensor:
    """Half the squares of small values, at most `_MOST` of large ones (Geman and McClure)."""
    square = values * values
    return 0.5 * square / (1 + square / (2 * _MOST))
