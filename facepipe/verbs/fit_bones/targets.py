"""What bones are to reach: points of a face over one pose or many, named by words or read from files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import identifier, suggestion, unique_identifiers, unknown
from facepipe.geometry.vectors import transformed
from facepipe.parts import FaceParts, Mesh
from facepipe.rig import build, person_of, sample_transforms, sample_weights
from facepipe.rig.identity import with_identity
from facepipe.stage import Face, open_face
from facepipe.stage.controls_over_time import read_loose_animations, read_point_cache
from facepipe.stage.files import SUFFIXES as USD_SUFFIXES
from facepipe.verbs.cached_points import cached_points
from facepipe.verbs.whole_faces import match_meshes, world_to_world

ALL_SHAPES = "shapes"
LOADED = (".obj", ".glb", ".gltf", ".fbx")
_LARGEST_WEIGHT = 1e6
_LARGEST = 1e12  # stage units: squares add up

Loader = Callable[[Path], FaceParts]


@dataclass(frozen=True, kw_only=True)
class Target:
    """Points to reach, at one pose or at T frames.

    :raises InputError: arrays that don't fit each other, or NaN
    """

    name: str  # a USD identifier
    points: FloatArray  # (T, n, 3) world, stage units, meshes one after another in stage order
    times: FloatArray | None = None  # (T,) seconds, ascending; None: T = 1
    known: BoolArray | None = None  # (n,) points that the target says something about; None: all
    notes: tuple[str, ...] = ()  # what the user should know, one line each
    person: bool = False  # another face, and so who the fitted one is

    def __post_init__(self) -> None:
        shape, frames = np.shape(self.points), 1 if self.times is None else len(self.times)
        if len(shape) != 3 or shape[0] != frames or shape[2] != 3:
            raise InputError(f"target {self.name}", f"points {shape}, expected ({frames}, n, 3)")
        if self.known is not None and np.shape(self.known) != shape[1:2]:
            raise InputError(f"target {self.name}", f"known {np.shape(self.known)}, expected {shape[1:2]}")
        bad = np.flatnonzero(~np.isfinite(self.points).all(axis=(1, 2)))
        if bad.size:
            frame = "" if frames == 1 else f" at frame {bad[0]}"
            raise InputError(f"target {self.name}", f"NaN or infinity{frame}, expected finite points")
        largest = float(np.abs(self.points).max(initial=0.0))
        if largest > _LARGEST:
            raise InputError(f"target {self.name}", f"a coordinate of {largest:g}, expected at most {_LARGEST:g}")


def read_targets(face: Face, words: Sequence[str], load: Loader | None = None) -> tuple[Target, ...]:
    """The targets that words name, in their order.

    A word is a blendshape of the face (``jawOpen``, ``jawOpen=0.5``), ``shapes`` (each of its blendshapes), an
    animation of the face (all its frames), or a file: a face stage (as it is set), a stage with points over time, a
    SkelAnimation of a stage (``clip.usda:talk``), an OBJ, GLB or glTF. Meshes that a file lacks don't count; one that
    has a single mesh of another name stands for ``sculpt.obj:Head``.

    :param load: reads an OBJ, GLB or glTF file as parts; without it such files are refused
    :raises InputError: an unknown or ambiguous word, one twice, or a file that can't be read
    :raises TopologyError: a mesh that is not on the face's topology, with the first difference
    """
    if not words:
        raise InputError("targets", "none given, expected at least one")
    twice = [word for number, word in enumerate(words) if word in words[:number]]
    if twice:
        raise InputError(f"target {twice[0]}", "given twice, expected it once")
    parts = face.parts()
    targets = [target for word in words for target in _read(face, parts, word, load)]
    # each names an animation prim: words that differ may be one identifier
    names = unique_identifiers(target.name for target in targets)
    return tuple(
        target if target.name == name else replace(target, name=name)
        for target, name in zip(targets, names, strict=True)
    )


def _read(face: Face, parts: FaceParts, word: str, load: Loader | None) -> list[Target]:
    file, name = split_file(word)
    if file is not None:
        read = _read_file(parts, file, name, load)
        # a sculpt (OBJ) is the same person in another shape, a face of its own is another
        return [replace(read, person=not name and read.times is None and Path(file).suffix.lower() != ".obj")]
    if word == ALL_SHAPES:
        if not face.shapes:
            raise InputError(f"target {word}", f"{face.where} has no blendshapes, expected some")
        return [_shape(face, shape, 1.0) for shape in face.shapes]
    name, equals, text = word.rpartition("=")
    if equals and name in face.shapes:
        return [_shape(face, name, _weight(word, text), word)]
    clip = any(animation.name == word for animation in face.animations)
    if word in face.shapes and clip:
        fault = f"is a blendshape and an animation, expected {word}=1 for the shape or FILE:{word} for the animation"
        raise InputError(f"target {word}", fault)
    if word in face.shapes:
        return [_shape(face, word, 1.0)]
    if clip:
        points, times = _sampled(face, word)
        return [Target(name=identifier(word), points=points, times=times)]
    known = [*face.shapes, *(animation.name for animation in face.animations)]
    fault = "no such blendshape, animation or file type"
    raise InputError(f"target {word}", fault + suggestion(word, known, "a file (.usda .obj .glb ...)"))


def _shape(face: Face, name: str, weight: float, word: str | None = None) -> Target:
    return Target(name=identifier(word or name), points=face.evaluate({name: weight})[None])


def _weight(word: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not abs(value) <= _LARGEST_WEIGHT:  # NaN too
        raise InputError(f"target {word}", f"expected SHAPE=WEIGHT with a finite number of at most {_LARGEST_WEIGHT:g}")
    return value


def split_file(word: str) -> tuple[str | None, str]:
    """File and name of ``FILE`` or ``FILE:NAME``; no file where neither has a suffix that targets can have."""
    if Path(word).suffix.lower() in (*USD_SUFFIXES, *LOADED):
        return word, ""
    file, _, name = word.rpartition(":")
    return (file, name) if Path(file).suffix.lower() in (*USD_SUFFIXES, *LOADED) else (None, "")


def _read_file(parts: FaceParts, file: str, name: str, load: Loader | None) -> Target:
    """The target that a file gives.

    :param parts: the face to be fitted
    :param name: of an animation of a USD stage, or of the face's mesh that the single mesh of another file is
    :raises InputError: a file that can't be read or has no such animation
    :raises TopologyError: a mesh that is not on the face's topology
    """
    path, called = Path(file), identifier(name or Path(file).stem, "target")
    if path.suffix.lower() in LOADED:
        if load is None:
            raise InputError(path, f"suffix '{path.suffix}' needs an importer, expected a USD stage")
        return _neutral(parts, called, load(path), str(path), name, triangles=path.suffix.lower() in (".glb", ".gltf"))
    cache = read_point_cache(path)
    if name:
        return _animation(parts, called, path, name, cache.has_face)
    if cache.times is None and cache.has_face:
        return _neutral(parts, called, open_face(path).parts(), str(path))
    # points over time; those of a face as its skeleton at rest places them
    cached = cached_points(cache, path)
    points = np.stack([cached.sample(number) for number in range(cached.count)])
    moved = _to_world(parts, points, cache.meters_per_unit, cache.up_axis)
    return _matched(parts, called, cached.meshes, moved, cache.times, str(path))


def _sampled(face: Face, name: str) -> tuple[FloatArray, FloatArray | None]:
    """(T, n, 3) world points of an animation of a face, and its times (T,).

    :raises InputError: no such animation, or joints and shapes that the face lacks
    """
    times = next((animation.times for animation in face.animations if animation.name == name), None)
    frames = [face.sample(name, number) for number in range(1 if times is None else len(times))]
    return np.stack([face.evaluate(weights, joint_transforms=local) for local, weights in frames]), times


def _neutral(
    parts: FaceParts, called: str, other: FaceParts, where: str, only: str = "", *, triangles: bool = False
) -> Target:
    """The neutral of another face, as it is set."""
    person, other = person_of(other), with_identity(other)
    points = build(other).evaluate(person.weights, coefficients=person.coefficients)
    moved = _to_world(parts, points[None], other.meters_per_unit, other.up_axis)
    return _matched(parts, called, other.meshes, moved, None, where, only, triangles=triangles)


def _animation(parts: FaceParts, called: str, path: Path, name: str, has_face: bool) -> Target:
    """An animation of the face of a stage; of a stage without a face, one that moves the face itself."""
    animations = read_loose_animations(path)
    # reversed: of two with one name the first stays
    named = {animation.name: animation for animation in reversed(animations)}
    if name not in named:
        raise InputError(path, unknown(name, [animation.name for animation in animations], "animation"))
    if has_face:
        other = open_face(path)
        points, times = _sampled(other.with_identity(), name)
        moved = _to_world(parts, points, other.meters_per_unit, other.up_axis)
        return _matched(parts, called, other.meshes, moved, times, str(path))
    animation, rig = named[name], build(parts)
    frames = range(animation.samples)
    try:
        posed = [
            rig.evaluate(
                sample_weights(animation, number), joint_transforms=sample_transforms(parts.skeleton, animation, number)
            )
            for number in frames
        ]
    except InputError as error:
        raise error.under(path) from None
    return Target(name=called, points=np.stack(posed), times=animation.times)


def _to_world(parts: FaceParts, points: FloatArray, meters_per_unit: float, up_axis: str) -> FloatArray:
    """(T, n, 3) points of the world of another stage in that of the face."""
    matrix = world_to_world(meters_per_unit, up_axis, parts)
    return transformed(points, matrix)


def _matched(
    parts: FaceParts,
    called: str,
    meshes: Sequence[Mesh],
    points: FloatArray,
    times: FloatArray | None,
    where: str,
    only: str = "",
    *,
    triangles: bool = False,
) -> Target:
    """Points (T, m, 3) of other meshes at the places of the face's."""
    match = match_meshes(parts, meshes, where, only, triangles=triangles)
    rest = build(parts).evaluate()
    placed = np.repeat(rest[None], len(points), axis=0)
    placed[:, match.rows] = points[:, match.others]
    known = np.zeros(len(rest), dtype=bool)
    known[match.rows] = True
    return Target(name=called, points=placed, times=times, known=None if known.all() else known, notes=match.notes)
