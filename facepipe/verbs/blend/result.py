"""Blends of faces of one topology in the gradient domain: the solution, and the base with all that it changes."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.threads import one_thread
from facepipe.core.tokens import SEAM_RESIDUAL
from facepipe.geometry.polygons import point_normals, point_triangles, touching
from facepipe.geometry.vectors import group_sums, transformed, unit_vectors
from facepipe.parts import Blendshape, FaceParts, Inbetween, Mesh, Recipe
from facepipe.rig import mesh_spaces
from facepipe.rig.sliders import kept, kept_outputs
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes
from facepipe.verbs.blend.options import BlendOptions
from facepipe.verbs.blend.quality import BlendReport, measure
from facepipe.verbs.blend.rigs import blend_skeletons, blend_skins, rebase_animations
from facepipe.verbs.blend.session import BlendSession, Solution
from facepipe.verbs.blend.settings import with_settings
from facepipe.verbs.blend.sources import UNALIGNED, Sources
from facepipe.verbs.blend.weights import Weights

_DEGENERATE = 1e-6  # a sum of unit vectors shorter than this has no direction
_NOISE = 1e-9  # of a sculpt's largest offset: what is less is rounding of the solve, no motion, and no two runs' alike


def blend_normals(
    normals: Sequence[FloatArray | None], surfaces: FloatArray, surface: FloatArray, weights: FloatArray
) -> FloatArray | None:
    """(m, 3) unit normals of a blended surface; None where no source has normals.

    The surface's own normals, plus the weighted mean of what each source's authored normals add to those of its own
    surface: normals that follow the surface go on to do so, and what was put in by hand stays. A source without normals
    adds nothing.

    :param normals: (m, 3) of every source, any length, or None
    :param surfaces: (K, m, 3) unit normals of the sources' surfaces at the same rows
    :param surface: (m, 3) unit normals of the blended surface
    :param weights: (m, K) shares of every row
    """
    if all(authored is None for authored in normals):
        return None
    blended = np.array(surface, dtype=np.float64)
    for k, authored in enumerate(normals):
        if authored is not None:
            vectors = np.asarray(authored, dtype=np.float64)
            # an authored normal of length 0 says nothing: by its share it would take the own surface's normal away
            share = np.where(np.linalg.norm(vectors, axis=1) > 0, weights[:, k], 0.0)
            blended += share[:, None] * (unit_vectors(vectors) - surfaces[k])
    flat = np.linalg.norm(blended, axis=1) <= _DEGENERATE
    blended[flat] = surface[flat]
    return unit_vectors(blended)


def normal_offsets(
    points: FloatArray, deformed: FloatArray, triangles: IntArray, point_indices: IntArray
) -> FloatArray:
    """(k, 3) differences of the unit normals of deformed and neutral points (n, 3), area-weighted, at some points.

    :param triangles: (t, 3) points
    :param point_indices: (k,)
    """
    touched = np.zeros(len(points), dtype=bool)
    touched[point_indices] = True
    near = triangles[touching(triangles, touched)]  # all that the normals asked for depend on
    difference = point_normals(deformed, near)[point_indices] - point_normals(points, near)[point_indices]
    return np.asarray(difference)


def result_parts(session: BlendSession, solution: Solution) -> FaceParts:
    """The base's parts with blended points, normals, shapes, skin weights, joints, and clips re-based on them.

    Sliders, bone limits, landmarks, regions, UVs and materials are the base's; sliders and clips lose the shapes that
    were skipped.
    """
    sources, neutral = session.sources, solution.neutral
    base = with_settings(sources, solution)
    meshes = []
    for number, (mesh, space) in enumerate(zip(base.meshes, mesh_spaces(base), strict=True)):
        sculpted = [parts.meshes[number] for parts in sources.parts]
        span, back = slice(*sources.mesh_offsets[number : number + 2]), np.linalg.inv(space)
        points, shares = transformed(neutral.points[span], back), neutral.shares[span]
        meshes.append(
            replace(
                mesh,
                points=points,
                normals=_normals(sources, shares, number, points),
                skin=blend_skins([one.skin for one in sculpted], shares),
                blendshapes=_blendshapes(sculpted, points, solution, span, back[:3, :3]),
            )
        )
    skeleton = blend_skeletons(
        [parts.skeleton for parts in sources.parts],
        session.joint_worlds,
        neutral.joints,
        neutral.joint_shares,
        aligned=sources.aligned != UNALIGNED,
    )
    gone, network = set(session.skipped), base.slider_network
    animations = []
    for animation in rebase_animations(base.animations, base.skeleton, skeleton):
        stay = [number for number, name in enumerate(animation.shapes) if name not in gone]
        if len(stay) < len(animation.shapes) and animation.shape_weights is not None:
            names = tuple(animation.shapes[number] for number in stay)
            animation = replace(animation, shapes=names, shape_weights=animation.shape_weights[:, stay])
        animations.append(animation)
    return replace(
        base,
        meshes=tuple(meshes),
        skeleton=skeleton,
        animations=tuple(animations),
        sliders=tuple(kept(slider, lambda joint: True, lambda shape: shape not in gone) for slider in base.sliders),
        slider_network=None
        if network is None
        else kept_outputs(network, lambda _: True, lambda shape: shape not in gone),
        photos=(),  # they show the person of one source
    )


def _normals(sources: Sources, shares: FloatArray, number: int, points: FloatArray) -> FloatArray | None:
    """The normals of one mesh, per point or corner as the base has them; `points` (n, 3) are the blended ones."""
    base, span = sources.base.meshes[number], slice(*sources.mesh_offsets[number : number + 2])
    if base.normals is None:
        return None
    triangles = point_triangles(base.face_vertex_counts, base.face_vertex_indices)
    back = np.linalg.inv(mesh_spaces(sources.base)[number])
    surfaces = [point_normals(transformed(one[span], back), triangles) for one in sources.points]
    corners = base.face_vertex_indices
    rows = np.arange(len(points)) if len(base.normals) == len(points) else corners
    authored: list[FloatArray | None] = []
    for parts, to_base in zip(sources.parts, sources.to_base, strict=True):
        given = parts.meshes[number].normals
        if given is not None and (len(given) == len(points)) != (len(rows) == len(points)):
            # a source gives them per point, the base per corner, or the other way round
            given = group_sums(corners, given, len(points)) if len(rows) == len(points) else given[corners]
        turn = back[:3, :3] @ to_base[:3, :3] @ mesh_spaces(parts)[number][:3, :3]
        side = np.sign(np.linalg.det(turn))
        authored.append(None if given is None else side * (given @ np.linalg.inv(turn)))  # the inverse transpose
    surface = point_normals(points, triangles)
    return blend_normals(authored, np.stack(surfaces)[:, rows], surface[rows], shares[rows])


def _blendshapes(
    meshes: list[Mesh], points: FloatArray, solution: Solution, span: slice, linear: FloatArray
) -> tuple[Blendshape, ...]:
    """The shapes of one mesh, in the order of the base."""
    triangles = point_triangles(meshes[0].face_vertex_counts, meshes[0].face_vertex_indices)
    with_normals = {shape.name for mesh in meshes for shape in mesh.blendshapes if shape.normal_offsets is not None}
    # shapes that move no point anywhere: they stay on the face, so that what drives them finds them
    moving = {sculpt.shape for sculpt in solution.sculpts if len(sculpt.points)}
    still = ({sculpt.shape for sculpt in solution.sculpts} - moving) & {
        shape.name for mesh in meshes for shape in mesh.blendshapes
    }
    collected: dict[str, dict[tuple[float, str | None], tuple[IntArray, FloatArray]]] = {}
    for sculpt, offsets in zip(solution.sculpts, solution.offsets, strict=True):
        inside = slice(*np.searchsorted(sculpt.points, [span.start, span.stop]))
        moved = offsets[inside] @ linear.T
        moved[np.abs(moved) < _NOISE * np.abs(offsets).max(initial=0.0) * np.abs(linear).max()] = 0.0
        local = (sculpt.points[inside] - span.start, moved)
        collected.setdefault(sculpt.shape, {})[sculpt.weight, sculpt.inbetween] = local
    shapes = []
    for name, sculpts in collected.items():
        indices: IntArray = np.unique(np.concatenate([places for places, _ in sculpts.values()])).astype(np.int32)
        if name in with_normals:
            # beside moving points triangles turn: normals change there at points that stay
            # `indices` and the points of all triangles at them: their normals turn, though they don't move
            touched = np.isin(triangles, indices).any(axis=1)
            indices = np.unique(np.concatenate([indices, triangles[touched].ravel()])).astype(np.int32)
        elif not len(indices) and name in still:
            indices = np.zeros(1, dtype=np.int32)  # USD reads a shape without indices as one over all points
        if len(indices):
            spread = {key: np.zeros((len(indices), 3)) for key in sculpts}
            for key, (places, offsets) in sculpts.items():
                spread[key][np.searchsorted(indices, places)] = offsets
            shapes.append(_shape(name, indices, spread, (points, triangles) if name in with_normals else None))
    return tuple(shapes)


def _shape(
    name: str,
    indices: IntArray,
    sculpts: Mapping[tuple[float, str | None], FloatArray],
    surface: tuple[FloatArray, IntArray] | None,
) -> Blendshape:
    def normals(offsets: FloatArray) -> FloatArray | None:
        if surface is None:
            return None
        points, triangles = surface
        moved = points.copy()
        moved[indices] += offsets
        # normals are no linear function of points: blended offsets of normals would not fit the blended surface
        return normal_offsets(points, moved, triangles, indices)

    inbetweens = tuple(
        Inbetween(name=inbetween, weight=weight, offsets=offsets, normal_offsets=normals(offsets))
        for (weight, inbetween), offsets in sculpts.items()
        if inbetween is not None
    )
    whole = sculpts[1.0, None]
    return Blendshape(
        name=name, point_indices=indices, offsets=whole, normal_offsets=normals(whole), inbetweens=inbetweens
    )


@dataclass(frozen=True, kw_only=True)
class Blend:
    """Edge vectors of K faces, mixed by region, and the points that fit them best.

    Source: the gradient-domain face blending document, claims 1-10, S601-S606'. Its incidence matrix holds 1 at both
    ends of an edge, which can't satisfy ``M x = D``; here rows hold -1 and +1.

    >>> weights = Weights(regions={"eyes": (0.8, 0.2)})
    >>> with sources[0].deriving("blended.usdc") as face:
    ...     report = Blend(weights=weights)(face, sources)

    :raises InputError: weights or options of another type
    """

    weights: Weights = field(default_factory=Weights)
    options: BlendOptions = field(default_factory=BlendOptions)

    def __post_init__(self) -> None:
        for name, value, kind in (("weights", self.weights, Weights), ("options", self.options, BlendOptions)):
            if not isinstance(value, kind):
                raise InputError(f"Blend -> {name}", f"{type(value).__name__}, expected {kind.__name__}(...)")

    @one_thread()
    def __call__(
        self,
        face: Face,
        sources: Sequence[Face] | BlendSession,
        *,
        recipe: Recipe | None = None,
        done: Callable[[], object] = lambda: None,
    ) -> BlendReport:
        """Blend and author the result on `face`, which stands over the first source.

        :param sources: the faces, or a session over them, whose options win
        :param recipe: authored with the result ; without, the result has none, whatever the
            first source has
        :param done: called after every sculpt
        :raises InputError, TopologyError: sources, weights or options that can't be blended; nothing is authored then
        """
        start = time.perf_counter()
        session = sources if isinstance(sources, BlendSession) else BlendSession(sources, self.options, live=False)
        solution = session.solve(self.weights, done)
        report, residual = measure(session, solution)
        parts = replace(result_parts(session, solution), recipe=recipe)
        authored = author_changes(face, parts, primvars={SEAM_RESIDUAL: residual})
        return replace(report, authored=authored, seconds=time.perf_counter() - start)
