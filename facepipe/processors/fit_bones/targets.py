"""What bones are to reach: points of a face over one pose or many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import identifier, suggestion, unique_identifiers
from facepipe.parts import FaceParts
from facepipe.processors.fit_bones.target_files import Loader, read_file, sampled, split_file
from facepipe.stage import Face

ALL_SHAPES = "shapes"
_LARGEST_WEIGHT = 1e6
_LARGEST = 1e12  # stage units: squares add up


@dataclass(frozen=True, kw_only=True)
class Target:
    """Points to reach, at one pose or at T frames.

    :raises InputError: arrays that don't fit each other, or NaN
    """

    name: str  # a USD identifier
    points: FloatArray  # (T, n, 3) world, stage units, meshes one after another in stage order
    times: FloatArray | None = None  # (T,) seconds, ascending; None: T = 1
    known: npt.NDArray[np.bool_] | None = None  # (n,) points that the target says something about; None: all
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
    found = [target for word in words for target in _read(face, parts, word, load)]
    names = unique_identifiers(target.name for target in found)
    return tuple(_named(target, name) for target, name in zip(found, names, strict=True))


def _named(target: Target, name: str) -> Target:
    if name == target.name:
        return target
    return replace(target, name=name)


def _read(face: Face, parts: FaceParts, word: str, load: Loader | None) -> list[Target]:
    file, name = split_file(word)
    if file is not None:
        read = read_file(parts, file, name, load)
        own = identifier(name or Path(file).stem, "target")
        person = name is None and read.times is None
        return [
            Target(name=own, points=read.points, times=read.times, known=read.known, notes=read.notes, person=person)
        ]
    if word == ALL_SHAPES:
        if not face.shapes:
            raise InputError(f"target {word}", f"{face.where} has no blendshapes, expected some")
        return [_shape(face, shape, 1.0) for shape in face.shapes]
    return [_of_face(face, word)]


def _of_face(face: Face, word: str) -> Target:
    """A blendshape or an animation of the face itself."""
    name, equals, text = word.rpartition("=")
    if equals and name in face.shapes:
        return _shape(face, name, _weight(word, text), word)
    clip = any(one.name == word for one in face.animations)
    if word in face.shapes and clip:
        what = f"is a blendshape and an animation, expected {word}=1 for the shape or FILE:{word} for the animation"
        raise InputError(f"target {word}", what)
    if word in face.shapes:
        return _shape(face, word, 1.0)
    if clip:
        points, times = sampled(face, word)
        return Target(name=identifier(word), points=points, times=times)
    known = [*face.shapes, *(one.name for one in face.animations)]
    what = "no such blendshape, animation or file type"
    raise InputError(f"target {word}", what + suggestion(word, known, "a file (.usda .obj .glb ...)"))


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
