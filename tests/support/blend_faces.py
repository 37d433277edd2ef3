"""Faces to blend in tests: ICT-FaceKit and MakeHuman where ../shared is present, the built-in sample everywhere."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from faces import replace_mesh
from import_data import shared
from scipy.spatial.transform import Rotation
from small_head import make

from facepipe.geometry.balls import fit_ball
from facepipe.geometry.vectors import unit_vectors
from facepipe.importers import ict, makehuman
from facepipe.parts import Blendshape, FaceParts, Inbetween, Mesh
from facepipe.rig import mesh_spaces
from facepipe.stage import Face
from facepipe.verbs.blend import Blend, BlendOptions, BlendSession, Weights

KINDS = ("sample", "ict", "makehuman")
EYES = {"makehuman": ("EyeLeft", "EyeRight")} | dict.fromkeys(("sample", "ict"), ("EyeballLeft", "EyeballRight"))
TEETH = {"makehuman": ("TeethUpper", "TeethLower")} | dict.fromkeys(("sample", "ict"), ("Teeth",))
REGION_WEIGHTS = {  # first of two sources
    "features": {"eyes": 0.9, "eyebrows": 0.8, "nose": 0.2, "mouth": 0.1, "chin": 0.3},
    "one region": {"mouth": 1.0},
    "whole regions": {"eyes": 1.0, "eyebrows": 1.0, "nose": 0.0, "mouth": 1.0, "cheek": 0.0, "chin": 1.0, "ears": 1.0},
}
_TARGETS = (
    {"nose/nose-point-up": 1.0, "mouth/mouth-scale-horiz-incr": 0.8, "chin/chin-width-incr": 0.7},
    {"macro/african-female-young": 1.0, "nose/nose-scale-depth-incr": 0.6},
    {"macro/asian-male-old": 1.0, "mouth/mouth-scale-vert-incr": 0.5},
)
_GRID = 2.0**-16


def two(first: float) -> tuple[float, float]:
    """Weights of two sources."""
    return first, 1.0 - first


def by_region(name: str, default: float = 0.5) -> Weights:
    """Two sources' weights of `REGION_WEIGHTS`."""
    return Weights(regions={region: two(one) for region, one in REGION_WEIGHTS[name].items()}, default=two(default))


@functools.cache
def head(kind: str, number: int) -> FaceParts:
    """One identity of a kind; skips the test where its data is absent."""
    if kind == "ict":
        return ict.read(shared("ict_facekit/ict_facekit.npz"), ict.Options(identity_seed=number + 1)).parts
    if kind == "makehuman":
        options = makehuman.Options(targets=_TARGETS[number])
        return makehuman.read(shared("makehuman/makehuman_head.npz"), options).parts
    return replace(changed(make(number + 1), bare), materials=())


def rolling_eyes(parts: FaceParts) -> FaceParts:
    """The small head with balls for eyeballs, a little behind the lids, that turn in the looks of their side."""
    turns = {"eyeLookIn": Rotation.from_rotvec((0, -0.5, 0)), "eyeLookUp": Rotation.from_rotvec((-0.4, 0, 0))}

    def one(mesh: Mesh) -> Mesh:
        if mesh.name not in EYES["sample"]:
            return mesh
        ball, side = fit_ball(np.asarray(mesh.points)), mesh.name.removeprefix("Eyeball")
        out = unit_vectors(mesh.points - ball.centre) * 0.9 * ball.radius
        every = np.arange(len(out), dtype=np.int32)
        shapes = tuple(
            Blendshape(name=look + side, point_indices=every, offsets=turn.apply(out) - out)
            for look, turn in turns.items()
        )
        return replace_mesh(mesh, points=ball.centre + out, blendshapes=shapes)

    return changed(parts, one)


def bare(mesh: Mesh) -> Mesh:
    """Without materials: their textures need files."""
    return replace_mesh(mesh, material=None, material_faces=())


def changed(parts: FaceParts, change: Callable[[Mesh], Mesh]) -> FaceParts:
    """The face with every mesh changed."""
    return replace(parts, meshes=tuple(change(mesh) for mesh in parts.meshes))


def with_shapes(mesh: Mesh, change: Callable[[np.ndarray], np.ndarray]) -> Mesh:
    """The mesh with the offsets and normal offsets of all its shapes changed."""

    def one(shape: Blendshape | Inbetween) -> Blendshape | Inbetween:
        normals = None if shape.normal_offsets is None else change(np.asarray(shape.normal_offsets))
        new = replace(shape, offsets=change(np.asarray(shape.offsets)), normal_offsets=normals)
        return replace(new, inbetweens=tuple(map(one, new.inbetweens))) if isinstance(new, Blendshape) else new

    return replace_mesh(mesh, blendshapes=tuple(map(one, mesh.blendshapes)))


def moved(parts: FaceParts, matrix: np.ndarray) -> FaceParts:
    """The whole face moved by a (4, 4) rigid motion of skeleton space: points, shapes, normals, joints."""
    meshes = []
    for mesh, space in zip(parts.meshes, mesh_spaces(parts), strict=True):
        own = np.linalg.inv(space) @ matrix @ space
        turn = own[:3, :3]

        def turned(vectors: np.ndarray, turn: np.ndarray = turn) -> np.ndarray:
            return np.asarray(vectors, np.float64) @ turn.T

        new = with_shapes(mesh, turned)
        normals = None if mesh.normals is None else turned(mesh.normals)
        meshes.append(replace_mesh(new, points=turned(mesh.points) + own[:3, 3], normals=normals))
    skeleton = parts.skeleton
    rest = np.array(skeleton.rest_transforms, np.float64)
    rest[skeleton.parents < 0] = matrix @ rest[skeleton.parents < 0]
    bind = matrix @ np.asarray(skeleton.bind_transforms, np.float64)
    return replace(parts, meshes=tuple(meshes), skeleton=replace(skeleton, bind_transforms=bind, rest_transforms=rest))


def misaligned(parts: FaceParts, mm: float = 5.0, degrees: float = 3.0, seed: int = 0) -> FaceParts:
    """Turned about its middle and moved, in random directions: what a library without alignment holds."""
    rng = np.random.default_rng(seed)
    axis, direction = rng.normal(size=(2, 3)) / np.linalg.norm(np.ones(3))
    axis, direction = axis / np.linalg.norm(axis), direction / np.linalg.norm(direction)
    middle = np.concatenate([mesh.points for mesh in parts.meshes]).mean(axis=0)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
    matrix[:3, 3] = middle - matrix[:3, :3] @ middle + direction * mm / (parts.meters_per_unit * 1000.0)
    return moved(parts, matrix)


def livelier(parts: FaceParts, factor: float = 1.3, degrees: float = 10.0) -> FaceParts:
    """Shapes that move further and in other directions: identities of one model often share their shapes."""
    turn = factor * Rotation.from_euler("xyz", [degrees, -degrees / 2, degrees / 3], degrees=True).as_matrix()
    return changed(parts, lambda mesh: with_shapes(mesh, lambda offsets: np.asarray(offsets, np.float64) @ turn.T))


def without_shapes(parts: FaceParts, *names: str) -> FaceParts:
    """The face without the shapes called `names`."""
    return changed(
        parts,
        lambda m: replace_mesh(
            m, blendshapes=tuple(blendshape for blendshape in m.blendshapes if blendshape.name not in names)
        ),
    )


def only_shapes(parts: FaceParts, *names: str) -> FaceParts:
    """The face with no shapes but those called `names`, and no control over the others."""
    shapes = {blendshape.name for mesh in parts.meshes for blendshape in mesh.blendshapes}
    return replace(without_shapes(parts, *(shapes - set(names))), sliders=(), animations=())


def snapped(parts: FaceParts) -> FaceParts:
    """Points on a binary grid, so that float32 holds them exactly even after a translation by multiples of it."""
    return changed(parts, lambda mesh: replace_mesh(mesh, points=np.round(np.asarray(mesh.points) / _GRID) * _GRID))


@functools.cache
def sources(kind: str, count: int = 2, variant: str = "aligned") -> tuple[Face, ...]:
    """`count` identities of a kind.

    :param variant: aligned; misaligned: those after the first moved by 5 mm and 3 degrees, and their shapes made
        livelier; neutral, misaligned neutral: the same without shapes
    """
    parts = [head(kind, number) for number in range(count)]
    if "neutral" in variant:
        parts = [only_shapes(part) for part in parts]
    if "misaligned" in variant:
        parts = [parts[0], *(misaligned(livelier(one), seed=i) for i, one in enumerate(parts[1:]))]
    return tuple(Face.from_parts(part) for part in parts)


@functools.cache
def session(kind: str, count: int = 2, variant: str = "aligned", options: BlendOptions | None = None) -> BlendSession:
    """A session over `sources`, as they lie without options, kept for all tests."""
    return BlendSession(sources(kind, count, variant), options or BlendOptions(align="none", contacts=False))


def blended(blend: BlendSession, weights: Weights) -> Face:
    """The result on a stage of its own."""
    face = Face.from_parts(blend.sources.base)
    Blend(weights=weights)(face, blend)
    return Face(face.stage)


def weighted(shares: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(n, 3) means of (K, n, 3) values under shares (K,) or (n, K)."""
    return np.einsum("nk,knc->nc", np.broadcast_to(shares, (values.shape[1], len(values))), values)


def head_height(blend: BlendSession) -> float:
    """Of the first source."""
    return blend.faces[0].head_height


def mesh_points(blend: BlendSession) -> dict[str, np.ndarray]:
    """Mesh -> numbers of its points among all."""
    offsets = blend.sources.mesh_offsets
    return {mesh.name: np.arange(*offsets[i : i + 2]) for i, mesh in enumerate(blend.sources.base.meshes)}


def steady(values: np.ndarray, about: float) -> None:
    """Fails unless all rows are one vector up to `about`: the difference is a translation."""
    assert float(np.linalg.norm(values - values.mean(axis=0), axis=1).max()) <= about


def same(found: np.ndarray, expected: np.ndarray, about: float) -> None:
    """Fails where rows lie further apart than `about`."""
    assert found.shape == expected.shape
    assert float(np.linalg.norm(found - expected, axis=-1).max(initial=0.0)) <= about


def kinds(*names: object) -> pytest.MarkDecorator:
    """Runs a test on heads of every kind; those that need ../shared skip without it.

    ICT-FaceKit as it is takes much longer than the sample, which is made of it, and is slow.
    """
    heads = [pytest.param(name, marks=pytest.mark.slow) if name == "ict" else name for name in names or KINDS]
    return pytest.mark.parametrize("kind", heads)
