"""What a host needs of faces: those on a stage, layers with faces for a stage, and faces as bytes to keep."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from facepipe_schemas import register as register_schemas
from pxr import Sdf, Usd

from facepipe.core import tokens
from facepipe.core.arrays import AnyArray
from facepipe.hosting.edited_face import sculpted
from facepipe.importers.npz import Field, read_arrays
from facepipe.parts import FaceParts, Material, Recipe
from facepipe.rig.rig import Curve, curves
from facepipe.stage import Face, open_face
from facepipe.stage.author import author
from facepipe.stage.author_mesh import check_region_name
from facepipe.stage.files import relative_path, save_layer
from facepipe.stage.prims import is_applied
from facepipe.stage.recipes import author_neural_rig_link, read_neural_rig_link

__all__ = [
    "Curve",
    "Face",
    "Field",
    "arrays_from_bytes",
    "author_neural_rig",
    "check_region_name",
    "curves",
    "face_from_bytes",
    "face_layer",
    "face_to_bytes",
    "faces_on",
    "is_face",
    "neural_rig_of",
    "open_face",
    "recipe_from",
    "register_schemas",
    "sculpted",
]


def is_face(prim: Usd.Prim) -> bool:
    """Whether a prim is a face."""
    return is_applied(prim, tokens.FACE_API)


def faces_on(stage: Usd.Stage) -> tuple[Face, ...]:
    """The faces of a stage, the default prim first.

    :raises SchemaError: a face that doesn't follow the stage convention
    """
    default = stage.GetDefaultPrim()
    found = [prim for prim in stage.Traverse() if is_face(prim)]
    return tuple(Face(stage, prim) for prim in sorted(found, key=lambda prim: prim != default))


def face_layer(parts: FaceParts) -> Sdf.Layer:
    """A layer in memory with the face as its default prim; textures are named, not written.

    :raises InputError: NaN, or a name that USD can't hold
    """
    layer = Sdf.Layer.CreateAnonymous(".usda")
    stage = author(parts)  # it keeps its layer alive
    layer.TransferContent(stage.GetRootLayer())
    return layer


def face_to_bytes(parts: FaceParts) -> bytes:
    """The face as the bytes of a .usdc file, of materials only the names."""
    names = tuple(Material(name=material.name, variants=material.variants) for material in parts.materials)
    layer = face_layer(replace(parts, materials=names))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "face.usdc"
        save_layer(layer, file)
        return file.read_bytes()


def face_from_bytes(data: bytes) -> FaceParts:
    """The face that `face_to_bytes` made bytes of.

    :raises InputError, SchemaError: other bytes
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "face.usdc"
        file.write_bytes(data)
        return open_face(file).parts()


def arrays_from_bytes(data: bytes, fields: Mapping[str, Field]) -> dict[str, AnyArray]:
    """The arrays in the bytes of an .npz file that may be of others.

    :raises InputError: no such file, or one of other arrays or of more than its size may unfold to
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "arrays.npz"
        file.write_bytes(data)
        return read_arrays(file, fields, {})


def recipe_from(recipe: Recipe | None, old: Path, new: Path) -> Recipe | None:
    """The recipe with its sources as seen from the folder `new` instead of `old`, where they are files."""
    if recipe is None:
        return None
    sources = [
        relative_path(str(old / source), new) if (old / source).exists() else source for source in recipe.sources
    ]
    return replace(recipe, sources=tuple(sources))


def neural_rig_of(face: Face) -> tuple[str, ...]:
    """File (absolute where it is there), digest and topology of the neural rig of a face; empty for none."""
    link = read_neural_rig_link(face.prim)
    return () if link is None else (str(link.path or link.file), link.digest, link.topology)


def author_neural_rig(layer: Sdf.Layer, path: Sdf.Path, link: tuple[str, ...], folder: Path) -> None:
    """Put the link of `neural_rig_of` on a face prim of a layer that is to be saved in `folder`."""
    if link:
        stage = Usd.Stage.Open(layer)
        file = relative_path(link[0], folder) if Path(link[0]).is_file() else link[0]
        author_neural_rig_link(stage.GetPrimAtPath(path), file, *link[1:])
