"""The expressions of the sources: offsets of every shape and inbetween, paired over the sources."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.names import unique_identifiers
from facepipe.geometry.deformation_transfer import Transfer
from facepipe.parts import Blendshape, FaceParts
from facepipe.rig import mesh_spaces
from facepipe.rig.activation import curves
from facepipe.verbs.blend.options import Missing
from facepipe.verbs.blend.sources import Sources


@dataclass(frozen=True)
class Sculpt:
    """One shape at one weight: itself (1) or an inbetween."""

    shape: str
    weight: float
    inbetween: str | None  # name of the inbetween; None: the shape itself
    points: IntArray  # (u,) points that move in some source, ascending
    offsets: FloatArray  # (K, u, 3) in the base's bind space

    @property
    def name(self) -> str:
        """The shape's name, for an inbetween with its weight: ``jawOpen@0.5``."""
        return self.shape if self.inbetween is None else f"{self.shape}@{self.weight:g}"


@dataclass(frozen=True)
class Sculpts:
    """All sculpts of a blend, and the shapes that came from fewer sources or went."""

    sculpts: tuple[Sculpt, ...]
    skipped: tuple[str, ...]
    transferred: tuple[tuple[str, str], ...]  # (shape, source that lacked it)


def pair_sculpts(sources: Sources, triangles: IntArray, missing: Missing, threshold_mm: float) -> Sculpts:
    """Pair the shapes of all sources by name; inbetweens by weight.

    A source without some inbetween of a shape gives the point that its own shape passes at that weight.

    :param threshold_mm: a point that moves no further in any source is static
    :raises InputError: a shape that some source lacks, where `missing` is ``error``
    """
    shapes = tuple(dict.fromkeys(name for own in sources.shapes for name in own))
    lacking = {shape: [k for k, own in enumerate(sources.shapes) if shape not in own] for shape in shapes}
    _require(sources, lacking, missing)
    sculpts, skipped, transferred = [], [], []
    transfer = _Transfers(sources, triangles)
    for shape in shapes:
        lack = lacking[shape]
        if lack and missing == "skip":
            skipped.append(shape)
            continue
        transferred += [(shape, sources.names[k]) for k in lack]
        for weight, name in _weights(sources.parts, shape):
            offsets = _stacked(sources, shape, weight)
            # in any source, whatever its weight: the moving points, and so the factor, are the same for all weights
            points = np.flatnonzero((np.linalg.norm(offsets, axis=2) * sources.mm_per_unit > threshold_mm).any(axis=0))
            if lack:
                transfer.fill(offsets, points, lack)
            sculpts.append(Sculpt(shape, weight, name, points, offsets[:, points]))
    return Sculpts(tuple(sculpts), tuple(skipped), tuple(transferred))


def _require(sources: Sources, lacking: dict[str, list[int]], missing: Missing) -> None:
    lost = {shape: lack for shape, lack in lacking.items() if lack}
    if lost and missing == "error":
        shape, lack = next(iter(lost.items()))
        more = f" (and {len(lost) - 1} more shapes)" if len(lost) > 1 else ""
        what = f"no shape '{shape}', which other sources have{more}; expected it in all (or --missing transfer|skip)"
        raise InputError(sources.names[lack[0]], what)


def _weights(parts: Sequence[FaceParts], shape: str) -> list[tuple[float, str | None]]:
    """Every weight that some source has a sculpt at, with its name in the first that has it; names are unique."""
    named: dict[float, str] = {}
    for one in _shapes(parts, shape):
        for inbetween in one.inbetweens:
            named.setdefault(float(inbetween.weight), inbetween.name)
    ordered = sorted(named.items())
    names = unique_identifiers(name for _, name in ordered)
    return [(1.0, None), *((weight, name) for (weight, _), name in zip(ordered, names, strict=True))]


def _shapes(parts: Sequence[FaceParts], shape: str) -> list[Blendshape]:
    return [
        blendshape
        for face in parts
        for mesh in face.meshes
        for blendshape in mesh.blendshapes
        if blendshape.name == shape
    ]


def _stacked(sources: Sources, shape: str, weight: float) -> FloatArray:
    """(K, n, 3) offsets at a weight of the shape; 0 in sources without it."""
    offsets = np.zeros(sources.points.shape)
    for k, parts in enumerate(sources.parts):
        starts = sources.mesh_offsets[:-1]
        for mesh, start, space in zip(parts.meshes, starts, mesh_spaces(parts), strict=True):
            linear = sources.to_base[k, :3, :3] @ space[:3, :3]
            for blendshape in mesh.blendshapes:
                if blendshape.name == shape:
                    offsets[k, start + blendshape.point_indices] = _at(blendshape, weight) @ linear.T
    return offsets


def _at(shape: Blendshape, weight: float) -> FloatArray:
    """(k, 3) offsets of the shape set to `weight`."""
    offsets = {float(inbetween.weight): inbetween.offsets for inbetween in shape.inbetweens} | {1.0: shape.offsets}
    activations = curves(tuple(float(inbetween.weight) for inbetween in shape.inbetweens))
    parts = [float(curve(weight)) * np.asarray(offsets[at], dtype=np.float64) for at, curve in activations.items()]
    return np.asarray(sum(parts))


class _Transfers:
    """Deformation transfer onto the sources that lack a shape."""

    def __init__(self, sources: Sources, triangles: IntArray) -> None:
        self._sources, self._triangles = sources, triangles

    def fill(self, offsets: FloatArray, points: IntArray, lack: Sequence[int]) -> None:
        """Put transferred offsets into the rows `lack` of (K, n, 3) `offsets`; only `points` may move."""
        neutrals = self._sources.points
        has = [k for k in range(len(neutrals)) if k not in lack]
        fixed = np.ones(neutrals.shape[1], dtype=bool)
        fixed[points] = False
        for k in lack:
            transfer = Transfer(neutrals[k], self._triangles, fixed)
            deformed = transfer.solve(neutrals[has], neutrals[has] + offsets[has])
            offsets[k] = deformed - neutrals[k]
