"""Parts that keep their shape: eyeballs stay round, teeth rigid up to scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.names import select
from facepipe.geometry.similarity import fit_similarities
from facepipe.geometry.vectors import group_sums
from facepipe.verbs.blend.graph import Graph, mix
from facepipe.verbs.blend.sculpts import Sculpt
from facepipe.verbs.blend.sources import Sources

_RIGID = 0.02  # of a part's motion: what a similarity may leave of it; of real jaws on scaled teeth it leaves 0.005
_AXIS = 0.02  # of a part's points: as many may lie still, on the axis that it turns about
CONCENTRIC = 0.25  # components whose centres lie this close, in radii of the larger, are one part: iris, lens and ball


@dataclass(frozen=True)
class KeptParts:
    """Loose parts in the sources, and their shapes: each moved onto the base's by a similarity."""

    points: IntArray  # (p,) into all points
    part: IntArray  # (p,) number of the part, from 0
    neutrals: FloatArray  # (K, p, 3) as the sources have them
    shapes: FloatArray  # (K, p, 3) moved onto the base's

    def fit(self, solved: FloatArray, shares: FloatArray) -> FloatArray:
        """(p, 3) the parts' mean shape under their shares, moved by similarities nearest to the solved points.

        :param solved: (n, 3) all points
        :param shares: (n, K) of all points
        """
        if not len(self.points):
            return np.zeros((0, 3))
        counts = np.bincount(self.part)
        part_shares = group_sums(self.part, shares[self.points], len(counts)) / counts[:, None]
        shape = mix(part_shares[self.part], self.shapes)
        return fit_similarities(shape, solved[self.points], self.part).apply(shape, self.part)

    def rigid_in(self, sculpt: Sculpt, moving: BoolArray) -> BoolArray:
        """(p,) points of the parts that move by similarities in all sources, all but a few points on an axis."""
        if not len(self.points):
            return np.zeros(0, dtype=bool)
        still = np.bincount(self.part, ~moving[self.points])
        chosen = np.asarray((still <= _AXIS * np.bincount(self.part))[self.part])
        points, number = self.points[chosen], self.part[chosen]
        if not len(points):
            return chosen
        rigid = np.ones(int(number.max()) + 1, dtype=bool)
        for start, sculpted in zip(self.neutrals[:, chosen], sculpt.offsets, strict=True):
            offsets = np.zeros((len(moving), 3))
            offsets[sculpt.points] = sculpted
            motion = offsets[points]
            off = fit_similarities(start, start + motion, number).apply(start, number) - start - motion
            left, whole = (np.bincount(number, (vectors**2).sum(axis=1)) for vectors in (off, motion))
            rigid &= left <= _RIGID**2 * whole
        chosen[chosen] = rigid[number]
        return chosen

    def fit_moved(
        self,
        neutral: FloatArray,
        offsets: FloatArray,
        rigid: BoolArray,
        moving: BoolArray,
    ) -> None:
        """Replace, in `offsets` (n, 3), those of the parts that are `rigid_in` a sculpt by the nearest similarity's.

        Static points stay so.
        """
        if not rigid.any():
            return
        points, number = self.points[rigid], np.unique(self.part[rigid], return_inverse=True)[1].ravel()
        start = neutral[points]
        fitted = fit_similarities(start, start + offsets[points], number).apply(start, number) - start
        offsets[points] = np.where(moving[points][:, None], fitted, 0.0)


def kept_parts(sources: Sources, graph: Graph, globs: str) -> KeptParts:
    """The loose parts of the meshes whose names `globs` match.

    :raises InputError: a glob that matches no mesh
    """
    names = tuple(mesh.name for mesh in sources.base.meshes)
    chosen = _default(names) if globs == "auto" else select(names, globs, "keep_shape")
    ranges = dict(zip(names, zip(sources.mesh_offsets[:-1], sources.mesh_offsets[1:], strict=True), strict=True))
    points = np.concatenate([np.zeros(0, np.int64), *(np.arange(*ranges[name]) for name in chosen)])
    points = points[~graph.main[points]]
    mesh = np.searchsorted(sources.mesh_offsets, points, side="right")
    part = _merge_concentric(sources.points[0, points], graph.component[points], mesh)
    if not len(points):
        nothing = np.zeros((len(sources.points), 0, 3))
        return KeptParts(points, part, nothing, nothing)
    base = sources.points[0, points]
    aligned = [fit_similarities(source[points], base, part).apply(source[points], part) for source in sources.points]
    return KeptParts(points, part, sources.points[:, points], np.stack(aligned))


def _default(names: tuple[str, ...]) -> tuple[str, ...]:
    """Meshes that are eyeballs or teeth by their names."""
    words = ("eyeball", "teeth", "tooth")
    return tuple(
        name for name in names if any(word in name.lower() for word in words) or name in ("EyeLeft", "EyeRight")
    )


def _merge_concentric(points: FloatArray, component: IntArray, mesh: IntArray) -> IntArray:
    """(p,) part numbers from 0: the components, those about one centre in one mesh as one."""
    numbers, first, place = np.unique(component, return_index=True, return_inverse=True)
    place = place.ravel()
    counts = np.bincount(place, minlength=len(numbers))
    centres = group_sums(place, points, len(numbers)) / np.maximum(counts, 1)[:, None]
    radii = np.zeros(len(numbers))
    np.maximum.at(radii, place, np.linalg.norm(points - centres[place], axis=1))
    owner = np.arange(len(numbers))
    for number in np.argsort(-radii, kind="stable"):
        if owner[number] == number:
            near = np.linalg.norm(centres - centres[number], axis=1) <= CONCENTRIC * radii[number]
            near &= (mesh[first] == mesh[first[number]]) & (owner == np.arange(len(numbers))) & (radii <= radii[number])
            owner[near] = number
    return np.unique(owner[place], return_inverse=True)[1].ravel()
