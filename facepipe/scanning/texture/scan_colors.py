"""What a scan shows of the skin's textures: for each texel the colour of its nearest place, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from facepipe.geometry.polygons import point_areas, point_normals
from facepipe.geometry.texels import Texels
from facepipe.scanning.texture.scan_samples import ScanSamples
from facepipe.textures.observed import DARKEST, Observed
from facepipe.textures.seen_skin import step
from facepipe.textures.skin_surface import SkinSurface

_FAR_MM = (0.6, 2.5)  # off the scan: full confidence up to the first, none beyond the second
_TURNED = (0.3, 0.7)  # cosine between both normals: none up to the first, full from the second
_EDGE_MM = (1.0, 8.0)  # off what the scan does not show: confidence begins, and is full
_SHOWN = 0.5  # confidence from which a point counts as shown
_CHUNK = 1 << 18  # texels at a time
_COARSE = 1.5  # texels; samples further apart are mixed


@dataclass(frozen=True, kw_only=True)
class ShownTexels:
    """k texels of one texture that a scan shows."""

    place: IntArray  # (k,) into the texels of the surface
    sample: IntArray  # (k,) nearest of the scan
    trust: Float32Array  # (k,) 0..1


@dataclass(frozen=True, kw_only=True)
class SkinOnScan:
    """A skin in the pose of a scan, and the scan's samples."""

    skin: SkinSurface  # its points as the scan shows them, millimetres
    samples: ScanSamples
    covered: BoolArray | None = None  # (n,) to which its colours do not go

    @cached_property
    def normals(self) -> FloatArray:
        """(n, 3) of the skin's points."""
        return point_normals(self.skin.points, self.skin.triangles)

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.samples.points, balanced_tree=False, compact_nodes=False)

    @cached_property
    def outward(self) -> float:
        """1, or -1 where the scan's normals point inward."""
        distances, near = self._tree.query(self.skin.points, distance_upper_bound=_FAR_MM[1])
        hit = np.isfinite(distances) & self.skin.outside
        agreement = (self.normals[hit] * self.samples.normals[near[hit]]).sum(axis=1)
        return -1.0 if agreement.sum() < 0 else 1.0

    @cached_property
    def trust(self) -> FloatArray:
        """(n,) 0 to 1, of the skin's points: fading towards the border of what the scan shows."""
        from scipy.spatial import cKDTree

        _, near = self.nearest(self.skin.points, self.normals)
        trust = near * self.skin.outside
        if self.covered is not None:
            trust = trust * ~self.covered
        hidden = self.skin.outside & (trust < _SHOWN)
        if not hidden.any():
            return np.asarray(trust)
        off = cKDTree(self.skin.points[hidden]).query(self.skin.points)[0]
        return np.asarray(trust * step(off, *_EDGE_MM))

    def nearest(self, points: FloatArray, normals: FloatArray) -> tuple[IntArray, FloatArray]:
        """Sample (m,) nearest to each point (m, 3), -1 where none is near, and confidence (m,) 0 to 1.

        :param normals: (m, 3) of the skin there
        """
        distances, near = self._tree.query(points, distance_upper_bound=_FAR_MM[1])
        hit = np.isfinite(distances)
        rows = np.where(hit, near, 0)
        agreement = self.outward * (normals * self.samples.normals[rows]).sum(axis=1)
        trust = np.where(hit, (1 - step(np.where(hit, distances, 0), *_FAR_MM)) * step(agreement, *_TURNED), 0.0)
        return np.where(hit, near, -1), trust

    def shown(self, number: int) -> ShownTexels:
        """The texels of one of the skin's textures that the scan shows."""
        texels = self.skin.textures[number].texels
        shown = np.flatnonzero(self.trust[texels.corners].min(axis=1) > 0)
        places, samples, trusts = [], [], []
        for chunk in np.array_split(shown, -(-len(shown) // _CHUNK) or 1):
            part = texels.taken(chunk)
            sample, trust = self.nearest(part.carried(self.skin.points), part.carried(self.normals))
            kept = np.flatnonzero(trust > 0)
            places.append(chunk[kept])
            samples.append(sample[kept])
            trusts.append((trust * part.carried(self.trust[:, None])[:, 0])[kept])
        return ShownTexels(
            place=np.concatenate(places),
            sample=np.concatenate(samples),
            trust=np.concatenate(trusts).astype(np.float32),
        )

    def observed(self, number: int, template: FloatArray) -> Observed:
        """The scan's colours on one of the skin's textures.

        :param template: (m, 3) linear colours of the texture's texels
        """
        shown = self.shown(number)
        seen = np.concatenate(
            [
                self._mixed(self.skin.textures[number].texels.taken(shown.place[chunk]), shown.sample[chunk])
                for chunk in np.array_split(np.arange(len(shown.place)), -(-len(shown.place) // _CHUNK) or 1)
            ]
        )
        ratio = np.log(np.maximum(seen, DARKEST)) - np.log(template[shown.place])
        return Observed(place=shown.place, ratio=ratio.astype(np.float32), trust=shown.trust)

    def _mixed(self, part: Texels, sample: IntArray) -> Float32Array:
        """(k, 3) colours at texels: of the nearest sample, or of some where these are far apart."""
        colors = self.samples.colors
        assert colors is not None
        if self.samples.spacing <= _COARSE * texel_width(self.skin):
            return colors[sample]
        distances, near = self._tree.query(part.carried(self.skin.points), k=4)
        near = np.minimum(near, len(colors) - 1)
        weights = 1 / (distances**2 + (0.1 * self.samples.spacing) ** 2)
        weights /= weights.sum(axis=1, keepdims=True)
        return np.asarray((weights[..., None] * colors[near]).sum(axis=1), np.float32)


def texel_width(skin: SkinSurface) -> float:
    """About how wide a texel of the largest texture is on the skin."""
    areas = point_areas(skin.points, skin.triangles)
    counts = sum(
        (texture.texels.summed(np.ones((len(texture.texels.at), 1)), len(areas)) for texture in skin.textures),
        np.zeros((len(areas), 1)),
    )[:, 0]
    chosen = skin.outside & (counts > 0)
    return float(np.sqrt(np.median(areas[chosen] / counts[chosen])))
