"""A blended face whose weights move: its sources are read and factored once, then it is solved for any weights."""

from __future__ import annotations

import dataclasses
import tempfile
import threading
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

from facepipe.core.arrays import FloatArray
from facepipe.geometry.vectors import transformed
from facepipe.parts import FaceParts
from facepipe.performing import job_of, read_kept
from facepipe.stage import Face, open_face
from facepipe.verbs.blend import BlendFaces, BlendSession, Weights
from facepipe.verbs.blend.quick_neutral import QuickNeutral
from facepipe.verbs.blend.result import result_parts
from facepipe.verbs.blend.topologies import gathered, read_source
from facepipe.verbs.blend.weights import weights_from_json

_DEFAULT = "default"
_MM = 1e3  # of a metre


class LiveBlend:
    """The blend that a recipe describes. Calls from several threads wait for each other."""

    def __init__(self, blend: BlendFaces) -> None:
        self.sources, self.weights, self._blend = blend.sources, blend.weights or Weights(), blend
        self._lock = threading.Lock()

    @classmethod
    def from_stage(cls, path: Path) -> LiveBlend | None:
        """The blend of a face stage; None where the face was not made by a blend.

        :raises InputError: a source of the recipe is gone
        :raises SchemaError: a stage without a face, or a damaged recipe
        """
        recipe = open_face(path).parts().recipe
        made = recipe is not None and recipe.verb == BlendFaces.verb
        return cls(BlendFaces(**read_kept(path, BlendFaces).values)) if made else None

    @cached_property
    def session(self) -> BlendSession:
        """The warm session; made when it is first needed, which takes seconds, and half a minute for each source of
        another topology.

        :raises FacepipeError: a source that can't be used
        """
        found = gathered(self._first, self.sources, job_of(self._blend, self.sources[0]))
        return BlendSession(found.faces, self._blend)

    @cached_property
    def quick(self) -> QuickNeutral:
        """What answers while weights are dragged."""
        return QuickNeutral(self.session)

    @cached_property
    def base(self) -> FaceParts:
        """The first source."""
        return self._first.parts()

    @cached_property
    def _first(self) -> Face:
        return read_source(self.sources[0])  # what it lacks is authored on it in memory, and never saved

    @property
    def rows(self) -> dict[str, list[float]]:
        """A row of weights, one for each source, for the recipe's regions and for ``default``, all others."""
        count = len(self.sources)
        default = [float(one) for one in self.weights.default or [1.0 / count] * count]
        return {_DEFAULT: default} | {name: [float(one) for one in row] for name, row in self.weights.regions.items()}

    @property
    def regions(self) -> tuple[str, ...]:
        """The regions that can have weights of their own."""
        return tuple(sorted({name for mesh in self.base.meshes for name in mesh.regions}))

    def points(self, rows: Mapping[str, object], axes: FloatArray) -> bytes:
        """Points (n, 3) of the neutral's meshes one after another at bind time, float32.

        :param rows: as `rows`
        :param axes: (4, 4) from world space of the stage to that of the points
        :raises InputError: weights that can't be blended
        """
        weights = self._weights(rows)
        with self._lock:
            found = self.session.neutral(weights).points
        return bytes(transformed(found, axes @ self.base.skeleton.transform).astype("<f4").tobytes())

    def offsets(self, weights: Weights, *, settled: bool = True) -> FloatArray:
        """(n, 3) millimetres in glTF space from the first source's points, meshes one after another.

        :param settled: with what keeps lids off eyeballs and lips apart; without it a call takes milliseconds, and one
            from another thread needn't wait
        :raises InputError: weights that can't be blended
        """
        if settled:
            with self._lock:
                points = self.session.neutral(weights).points
        else:
            points = self.quick.points(weights)
        turn = (self.base.gltf_axes @ self.base.skeleton.transform)[:3, :3]
        moved: FloatArray = (points - self.session.sources.points[0]) @ turn.T * _MM
        return moved

    def face(self, rows: Mapping[str, object]) -> FaceParts:
        """The whole blended face, as `facepipe blend` would author it.

        :raises InputError: weights that can't be blended
        """
        weights = self._weights(rows)
        with self._lock:
            return result_parts(self.session, self.session.solve(weights))

    def _weights(self, rows: Mapping[str, object]) -> Weights:
        """The recipe's weights with other rows; gains and locks stay."""
        own = {name: row for name, row in rows.items() if name not in self.weights.locked}
        given = weights_from_json(own, "weights")
        return dataclasses.replace(self.weights, regions=given.regions, default=given.default)


def reblended(path: Path) -> tuple[FaceParts, tuple[str, ...]]:
    """Blend again what `facepipe blend` wrote as `path`, which stays as it is; a line for each source changed since.

    :raises InputError: no recipe of a blend, a source that is gone
    :raises SchemaError, TopologyError: a damaged recipe, or sources that can't be blended any more
    """
    kept = read_kept(path, BlendFaces)
    blend = BlendFaces(**kept.values)
    with (
        tempfile.TemporaryDirectory() as folder,
        open_face(blend.base).deriving(Path(folder) / "blended.usdc", flatten=kept.standalone) as face,
    ):
        report = blend.author(face, job_of(blend, path))
        parts = Face(face.stage, face.prim).parts()
    return parts, (*kept.warnings, *report.warnings)
