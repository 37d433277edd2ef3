"""The faces to blend, stacked as arrays in the space of the first one, with the cards of hairs that it wears."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.names import unknown
from facepipe.geometry.closest_points import closest_places, place_shares
from facepipe.geometry.polygons import point_triangles
from facepipe.geometry.similarity import fit_similarity
from facepipe.geometry.vectors import transformed
from facepipe.parts import FaceParts, Mesh, TextureInput, all_regions
from facepipe.rig import build, mesh_spaces, set_face
from facepipe.scans import LANDMARK_COUNT, LANDMARK_SCHEME
from facepipe.stage import Face
from facepipe.verbs.blend.joints import with_joints
from facepipe.verbs.whole_faces import check_same_faces, check_spaces, in_order, world_to_world

LANDMARKS, UNALIGNED = "landmarks", "none"
# The bridge of the nose, its base and the corners of the eyes: what of multipie68 expressions hardly move.
RIGID = (27, 28, 29, 30, 33, 36, 39, 42, 45)
_TURNED = 15.0  # degrees, beyond what faces of one pose differ by
_SCALED = 1.5
_SAME_UV = 1e-3  # of a picture: quantised files move UVs by less
_SIZES = 1e4


@dataclass(frozen=True, kw_only=True)
class Sources:
    """K faces of one topology; the first is the base: the result is made over it, in its units, axes and mesh order.

    Points of all meshes stand one after another. "Bind space" is the base's skeleton space at bind time.
    """

    names: tuple[str, ...]  # where each comes from, for messages
    parts: tuple[FaceParts, ...]  # meshes and joints those of the base, in its order
    shapes: tuple[tuple[str, ...], ...]  # names of each one's shapes
    mesh_offsets: IntArray  # (meshes + 1,) first point of each mesh, and the count
    to_base: FloatArray  # (K, 4, 4) bind space of each -> bind space of the base: units, up axis, and alignment
    points: FloatArray  # (K, n, 3) neutral points in bind space
    mm_per_unit: float  # millimetres in a unit of bind space
    aligned: str  # what later sources are laid on the base by
    warnings: tuple[str, ...] = ()

    @property
    def base(self) -> FaceParts:
        """The first source."""
        return self.parts[0]


def stack(faces: Sequence[Face], align: str = UNALIGNED) -> Sources:
    """Read the faces, each as it is set, and laid on the first one.

    :param align: ``landmarks``, a region of the first one, or ``none``, as in `BlendOptions`
    :raises InputError: no face, one that can't be read, or a region that the first lacks
    :raises TopologyError: meshes that differ, with the first difference
    """
    if not faces:
        raise InputError("sources", "none given, expected at least one face")
    for face in faces:
        if not isinstance(face, Face):
            raise InputError("sources", f"{face!r:.60} given, expected a Face as facepipe.open gives it")
    names = tuple(face.where.partition(" -> ")[0] for face in faces)
    base = set_face(faces[0].parts()).parts
    if not any(len(mesh.points) for mesh in base.meshes):
        raise TopologyError(names[0], "has no points, expected a face with meshes")
    parts, spaces, warnings = [base], list[FloatArray]([np.eye(4)]), list[str]()
    held, aligned = _held(base, align, names[0]) if len(faces) > 1 else ({}, UNALIGNED)
    for name, face in zip(names[1:], faces[1:], strict=True):
        source = set_face(face.parts()).parts
        spaces.append(_aligned(base, source, held))
        source, notes = with_joints(base, names[0], source, name, spaces[-1])
        warnings += notes
        source, worn = with_cards(base, source, spaces[-1])
        if worn:
            warnings.append(f"{name}: wears {', '.join(worn)} of {names[0]}: its own is another, or none")
        parts.append(in_order(base, names[0], source, name))
        extra = [mesh.name for mesh in source.meshes if mesh.name not in {mesh.name for mesh in base.meshes}]
        if extra:
            warnings.append(f"{name}: meshes that {names[0]} lacks are left out: {', '.join(extra)}")
    for name, face_parts in zip(names, parts, strict=True):
        check_spaces(name, face_parts)
    rigs = [replace(build(part), targets=()) for part in parts]  # offsets are read from the parts, once
    to_base = np.array(spaces)
    warnings += _losses(names, parts)
    moved = [transformed(rig.points, matrix) for rig, matrix in zip(rigs, to_base, strict=True)]
    _check_sizes(names, [transformed(rig.points, _to_base(part, base)) for rig, part in zip(rigs, parts, strict=True)])
    warnings += _placements(names, moved)
    return Sources(
        names=names,
        parts=tuple(parts),
        shapes=tuple(rig.shapes for rig in rigs),
        mesh_offsets=rigs[0].mesh_offsets,
        to_base=to_base,
        points=np.stack(moved),
        mm_per_unit=base.meters_per_unit
        * 1000.0
        * float(np.cbrt(np.abs(np.linalg.det(base.skeleton.transform[:3, :3])))),
        aligned=aligned,
        warnings=tuple(warnings),
    )


def _held(base: FaceParts, align: str, where: str) -> tuple[dict[str, tuple[IntArray, FloatArray]], str]:
    """What sources are laid on the base by, mesh -> its points (m,) and their weights (m,), and what that is called.

    :raises InputError: a region that the base lacks
    """
    if align == UNALIGNED:
        return {}, align
    if align == LANDMARKS:
        for mesh in base.meshes:
            marks = mesh.landmarks.get(LANDMARK_SCHEME)
            if marks is not None and len(marks.indices) == LANDMARK_COUNT:
                return {mesh.name: (np.asarray(marks.indices, np.int64)[list(RIGID)], np.ones(len(RIGID)))}, align
        skin = max(base.meshes, key=lambda mesh: (not _is_cards(mesh, base), len(mesh.points)))
        mouth = skin.regions.get("mouth")
        weights = np.ones(len(skin.points)) if mouth is None else 1.0 - np.clip(np.asarray(mouth, np.float64), 0.0, 1.0)
        if not weights.any():  # a mouth that is all there is holds as well as any
            return {skin.name: (np.arange(len(weights)), np.ones(len(weights)))}, skin.name
        return {skin.name: (np.arange(len(weights)), weights)}, f"{skin.name} outside the mouth"
    if align not in (regions := all_regions(base.meshes)):
        raise InputError(f"{where} -> --align", unknown(align, [LANDMARKS, UNALIGNED, *regions], "region"))
    held: dict[str, tuple[IntArray, FloatArray]] = {}
    for mesh in base.meshes:
        mask = np.asarray(mesh.regions.get(align, np.zeros(len(mesh.points))), np.float64)
        if (mask > 0).any():
            held[mesh.name] = np.flatnonzero(mask > 0), mask[mask > 0]
    if not held:
        raise InputError(f"{where} -> --align", f"region '{align}' covers no point, expected one that covers some")
    return held, align


def _aligned(base: FaceParts, source: FaceParts, held: Mapping[str, tuple[IntArray, FloatArray]]) -> FloatArray:
    """(4, 4) from the source's bind space to the base's, with what is `held` laid on the base's by a similarity.

    In closed form and by the same points whatever the source: a threshold, an outlier or a world axis would make a face
    that was turned another blend than the face itself.
    """
    to_base, named = _to_base(source, base), {mesh.name: mesh for mesh in source.meshes}
    own, other, weights = list[FloatArray](), list[FloatArray](), list[FloatArray]()
    for mesh in base.meshes:
        if mesh.name in held and len(named.get(mesh.name, mesh).points) == len(mesh.points) and mesh.name in named:
            rows, shares = held[mesh.name]
            own.append(transformed(_bound(source, named[mesh.name])[rows], to_base))
            other.append(_bound(base, mesh)[rows])
            weights.append(shares)
    if not own:
        return to_base
    fitted = fit_similarity(np.concatenate(own), np.concatenate(other), weights=np.concatenate(weights))
    laid = np.eye(4)
    laid[:3, :3], laid[:3, 3] = fitted.scale * fitted.rotation, fitted.translation
    return np.asarray(laid @ to_base)


def _check_sizes(names: Sequence[str], points: Sequence[FloatArray]) -> None:
    """:raises InputError: a source without size, or of another size altogether"""
    sizes = [float(np.sqrt(((one - one.mean(axis=0)) ** 2).sum(axis=1).mean())) for one in points]
    for name, size in zip(names, sizes, strict=True):
        if not 0 < size < np.inf or not 1 / _SIZES < size / sizes[0] < _SIZES:
            raise InputError(name, f"{size:g} units across, expected a face of the size of {names[0]} ({sizes[0]:g})")


def _placements(names: Sequence[str], points: Sequence[FloatArray]) -> list[str]:
    """Warnings of sources that stay turned or scaled against the first: a blend takes edges as they are."""
    lines = []
    for name, placed in zip(names, points, strict=True):
        fitted = fit_similarity(points[0], placed)
        angle = np.degrees(np.arccos(np.clip((np.trace(fitted.rotation) - 1) / 2, -1, 1)))
        if angle > _TURNED:
            lines.append(f"{name}: turned by {angle:.0f} degrees against {names[0]}; its edges are taken as they are")
        if not 1 / _SCALED < fitted.scale < _SCALED:
            lines.append(f"{name}: {fitted.scale:.2f} times as large as {names[0]}; its edges are taken as they are")
    return lines


def _losses(names: Sequence[str], parts: Sequence[FaceParts]) -> list[str]:
    """What later sources have and the first lacks: it is not on the result."""
    base, lines = parts[0], []
    regions = {region for mesh in base.meshes for region in mesh.regions}
    sliders, clips = {slider.name for slider in base.sliders}, {animation.name for animation in base.animations}
    for name, other in zip(names[1:], parts[1:], strict=True):
        lost = [
            *(f"region {one}" for one in sorted({one for mesh in other.meshes for one in mesh.regions} - regions)),
            *(f"slider {slider.name}" for slider in other.sliders if slider.name not in sliders),
            *(f"clip {animation.name}" for animation in other.animations if animation.name not in clips),
            *(f"skin of {a.name}" for a, b in zip(other.meshes, base.meshes, strict=True) if a.skin and not b.skin),
            *(
                f"landmarks {scheme}"
                for a, b in zip(other.meshes, base.meshes, strict=True)
                for scheme in a.landmarks
                if scheme not in b.landmarks
            ),
        ]
        if lost:
            more = f" and {len(lost) - 4} more" if len(lost) > 4 else ""
            lines.append(f"{name}: {', '.join(lost[:4])}{more}: {names[0]} lacks them, and so does the result")
    return lines


def _to_base(parts: FaceParts, base: FaceParts) -> FloatArray:
    """(4, 4) from bind space to the base's, over the world of both stages."""
    world = world_to_world(parts.meters_per_unit, parts.up_axis, base) @ parts.skeleton.transform
    return np.asarray(np.linalg.inv(base.skeleton.transform) @ world)


def with_cards(base: FaceParts, source: FaceParts, to_base: FloatArray) -> tuple[FaceParts, tuple[str, ...]]:
    """`source` with the cards that `base` wears and it does not, on its own skin; and what these are called.

    Hair of two styles may be of one topology; it is the same where it shows the same places of pictures. A point of a
    card keeps its place on the largest mesh of the face, and its distance from there.

    :param to_base: (4, 4) from the other's bind space to that of the base, which have the same joints
    """
    named = {mesh.name: mesh for mesh in source.meshes}
    missing = [
        mesh
        for mesh in base.meshes
        if _is_cards(mesh, base) and not (_has(source, mesh) and _same_uvs(mesh, named[mesh.name]))
    ]
    faces = [mesh for mesh in base.meshes if not _is_cards(mesh, base) and _has(source, mesh)]
    if not missing or not faces:
        return source, ()
    skin = max(faces, key=lambda mesh: len(mesh.points))
    # found in the base's bind space, authored in the source's, which may differ in unit and up axis
    back = np.linalg.inv(to_base)
    worn = {}
    for mesh in missing:
        space = back @ _space(base, mesh)
        points = _bound(base, mesh)
        surface = _bound(base, skin)
        other = _bound(source, named[skin.name])
        # the points (m, 3) as far from the places that they are nearest to, now on the other surface
        triangles = point_triangles(skin.face_vertex_counts, skin.face_vertex_indices)
        nearest = closest_places(points, surface, triangles)
        shares = place_shares(nearest, surface, triangles)
        places = np.einsum("mk,mkc->mc", shares, other[triangles[nearest.triangles]])
        points = np.asarray(places + (points - nearest.places) @ back[:3, :3].T)
        turn = space[:3, :3].T
        shapes = [
            replace(
                shape,
                offsets=shape.offsets @ turn,
                normal_offsets=None,
                inbetweens=tuple(
                    replace(one, offsets=one.offsets @ turn, normal_offsets=None) for one in shape.inbetweens
                ),
            )
            for shape in mesh.blendshapes
        ]
        worn[mesh.name] = replace(
            mesh,
            points=points,
            transform=source.skeleton.transform,
            skin=mesh.skin and replace(mesh.skin, geom_bind_transform=np.eye(4)),
            normals=None,
            blendshapes=tuple(shapes),
        )
    kept = [mesh for mesh in source.meshes if mesh.name not in worn]
    return replace(source, meshes=(*kept, *worn.values())), tuple(worn)


def difference(base: FaceParts, base_name: str, other: FaceParts, name: str) -> str:
    """In what `other` is not of the base's topology, cards of hair aside; empty: in nothing."""
    worn = [mesh for mesh in base.meshes if not _is_cards(mesh, base)]
    try:
        in_order(replace(base, meshes=tuple(worn or base.meshes)), base_name, other, name)
    except TopologyError as error:
        return str(error)
    return ""


def _is_cards(mesh: Mesh, parts: FaceParts) -> bool:
    """Whether pictures cut it out, as they do hairs."""
    cut = {material.name for material in parts.materials if isinstance(material.opacity, TextureInput)}
    used = {faces.material for faces in mesh.material_faces} | ({mesh.material} if mesh.material else set())
    return bool(used) and used <= cut


def _has(parts: FaceParts, mesh: Mesh) -> bool:
    """Whether a face has a mesh of that name and topology."""
    twin = next((one for one in parts.meshes if one.name == mesh.name), None)
    if twin is None:
        return False
    try:
        check_same_faces(mesh.name, twin, mesh, parts.name)
    except TopologyError:
        return False
    return True


def _same_uvs(mesh: Mesh, other: Mesh) -> bool:
    """Whether meshes of one topology show the same places of pictures, as far as both say."""
    theirs = {uvs.name: uvs for uvs in other.uv_sets}
    pairs = [
        [one.values if one.indices is None else one.values[one.indices] for one in (uvs, theirs[uvs.name])]
        for uvs in mesh.uv_sets
        if uvs.name in theirs
    ]
    return all(one.shape != other.shape or np.allclose(one, other, atol=_SAME_UV) for one, other in pairs)


def _space(parts: FaceParts, mesh: Mesh) -> FloatArray:
    return next(space for one, space in zip(parts.meshes, mesh_spaces(parts), strict=True) if one is mesh)


def _bound(parts: FaceParts, mesh: Mesh) -> FloatArray:
    """(n, 3) points in bind space."""
    return transformed(mesh.points, _space(parts, mesh))
