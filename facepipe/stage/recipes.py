"""Recipes, attribution and links of files whose layers may be lost; sources of recipes, and whether they changed.

What importers return, and the neural rig that a face was given, stand here since both are such links to other files.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple
from urllib.parse import unquote

import facepipe_schemas
from pxr import Ar, Sdf, Usd

from facepipe.core import __version__, tokens
from facepipe.core.errors import InputError, SchemaError
from facepipe.core.images import PHOTO_SUFFIXES
from facepipe.core.policy.paths import check_copied, check_model, path_named, real_path
from facepipe.core.reading import digest, files_in, is_file, read_json_object
from facepipe.declare import to_json
from facepipe.parts import FaceParts, Recipe
from facepipe.stage.array_files import is_arrays_file
from facepipe.stage.files import SUFFIXES, dependencies, open_stage, quiet_diagnostics
from facepipe.stage.layer_files import open_layer
from facepipe.stage.materials import copy_refusal
from facepipe.stage.prims import apply_schema, is_applied, put_value
from facepipe.stage.skeleton import read_recipe
from facepipe.stage.values import USD_ERRORS, errors_below, reads_prim, usd_errors

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_MOST_GLTF_BYTES = 1 << 28  # of a glTF document


class NeuralRigLink(NamedTuple):
    """A face's link to its neural rig."""

    file: str  # as authored
    path: Path | None  # of that file; None where there is none, or it may not be read
    digest: str  # "sha256:..." of the file when it was put on the face
    topology: str  # digest of the meshes that it was learned on
    refusal: str = ""  # why the file may not be read


@reads_prim
def read_neural_rig_link(prim: Usd.Prim) -> NeuralRigLink | None:
    """The link on a face prim; None where there is none."""
    if not is_applied(prim, tokens.NEURAL_RIG_API):
        return None
    attribute = prim.GetAttribute(tokens.NEURAL_RIG_FILE)
    file = attribute.Get() or Sdf.AssetPath()
    names = (tokens.NEURAL_RIG_DIGEST, tokens.NEURAL_RIG_TOPOLOGY)
    digest, topology = (str(prim.GetAttribute(name).Get() or "") for name in names)
    path = Path(str(file.resolvedPath)) if file.resolvedPath else None
    refused = copy_refusal(attribute.GetPath(), attribute, file) if path else None
    found = path if path and refused is None and is_file(path) else None
    return NeuralRigLink(str(file.path), found, digest, topology, refused.what if refused else "")


def author_neural_rig_link(prim: Usd.Prim, file: str, digest: str, topology: str) -> None:
    """Author the link on a face prim.

    :param file: path, relative to the layer where it can be
    """
    apply_schema(prim, tokens.NEURAL_RIG_API)
    put_value(prim, tokens.NEURAL_RIG_FILE, Sdf.AssetPath(file))
    put_value(prim, tokens.NEURAL_RIG_DIGEST, digest)
    put_value(prim, tokens.NEURAL_RIG_TOPOLOGY, topology)


@dataclass(frozen=True, kw_only=True)
class Imported:
    """A face read from a source file, and what the user should know about it (one line each)."""

    parts: FaceParts
    warnings: tuple[str, ...] = ()


def with_units(parts: FaceParts, meters_per_unit: float | None, up_axis: Literal["Y", "Z"] | None) -> FaceParts:
    """The face with a unit and an up axis in place of those of its file; None keeps the file's."""
    return replace(parts, meters_per_unit=meters_per_unit or parts.meters_per_unit, up_axis=up_axis or parts.up_axis)


def import_recipe(kind: str, files: Mapping[Path, Iterable[Path]], options: DataclassInstance) -> Recipe:
    """The recipe of an import of `kind`.

    :param files: each source as the user gave it -> the files of it that were read (itself, or some of a folder)
    :param options: the importer's options
    :raises InputError: a file can't be read
    """
    return Recipe(
        verb=f"import {kind}",
        sources=tuple(source.as_posix() for source in files),
        digests=tuple(digest(read) for read in files.values()),
        options=to_json(options),
        version=__version__,
    )


class FileRecipe(NamedTuple):
    """The recipe of a file, and whether the file stands on no other layer but that of its arrays."""

    recipe: Recipe | None
    standalone: bool


def file_recipe(path: str | os.PathLike[str]) -> FileRecipe:
    """The recipe on the default prim of a USD file, also where the layers that it stands on are lost.

    :raises InputError, SchemaError: no readable USD file, or a damaged recipe
    """
    stage = open_stage(path, strict=False)
    prim = stage.GetDefaultPrim()
    with errors_below(os.fspath(path)):
        recipe = read_recipe(prim) if prim else None
    below = [name for name in stage.GetRootLayer().subLayerPaths if not is_arrays_file(name, Path(path))]
    return FileRecipe(recipe, not below)


def recipe_of(path: Path, verb: str) -> tuple[Recipe, bool]:
    """The recipe on a face that `facepipe VERB` made, and whether its file stands on no other layer.

    :raises InputError: no recipe, or one of another verb
    :raises SchemaError: a damaged recipe, or one of a newer facepipe
    """
    recipe, standalone = file_recipe(path)
    expected = f"expected a face made by `facepipe {verb}`"
    if recipe is None:
        raise InputError(path, f"has no recipe, {expected}")
    if recipe.verb != verb:
        raise InputError(path, f"has a recipe of '{recipe.verb[:40]}', {expected}")
    check_recipe(f"{path} -> recipe", recipe)
    return recipe, standalone


def check_recipe(where: str, recipe: Recipe) -> None:
    """:raises SchemaError: a recipe of a newer facepipe, without sources, or without a digest for each"""
    version = recipe.version
    ours, theirs = (re.match(r"(\d{1,6})\.(\d{1,6})(?![0-9])", text) for text in (__version__, version))
    if theirs is None or ours is None:
        raise SchemaError(where, f"version '{version[:40]}', expected one like {__version__}")
    if tuple(map(int, theirs.groups())) > tuple(map(int, ours.groups())):
        raise SchemaError(where, f"made by facepipe {version[:40]}, expected {__version__} or older")
    count = len(recipe.sources)
    if not count or len(recipe.digests) != count:
        what = f"{count} sources and {len(recipe.digests)} digests, expected one digest per source"
        raise SchemaError(where, what)


def named_source(where: str, source: str, file: Path) -> Path:
    """The path of a source that the recipe on the face at `file` names, checked before it is looked at.

    Stages are read anywhere, as those that layers name are; of all else the content comes into the result.

    :raises InputError: a URL, a file that is no stage outside of the roots of `file` and its folder, or one that can
        run code as it is loaded, which the caller does not trust
    """
    path = path_named(where, source, file)
    try:
        check_model(path)
    except InputError as error:
        raise InputError(where, f"{path.name} {error.what}") from None
    if not all(file.suffix.lower() in SUFFIXES for file in (path, real_path(path) or path)):
        check_copied(where, path, file)
    return path


def existing_source(where: str, path: Path, instead: str) -> Path:
    """The absolute path of a source.

    :param instead: the argument that takes another one
    :raises InputError: no such file, or one that can run code as it is loaded, which the caller does not trust
    """
    check_model(path)
    if not is_source(path):
        raise InputError(where, f"{path}: no such file, expected it there (or {instead})")
    return path.resolve()


def is_source(path: Path) -> bool:
    """Whether it is a file, or a folder with photos."""
    return is_file(path) or bool(_photos(path))


def _photos(path: Path) -> set[Path]:
    """The photos in a folder; none where it is no folder."""
    if not os.path.isdir(path):  # noqa: PTH112  (False for names that no folder can have)
        return set()
    return set(files_in(path, PHOTO_SUFFIXES))


def changed_sources(path: Path, sources: Iterable[tuple[Path, str]]) -> tuple[str, ...]:
    """A line for each of the sources, with their digests, that is not what it was when the face at `path` was made.

    :raises InputError: a source can't be read
    """
    return tuple(
        f"{source.name} changed since {path.name} was made" for source, old in sources if source_digest(source) != old
    )


def source_digest(path: Path) -> str:
    """The digest of a file with what it stands on: USD layers, buffers of a glTF; or of the photos in a folder.

    :raises InputError: a file can't be read
    """
    return digest(source_files(path))


def source_files(path: Path) -> set[Path]:
    """The files that `source_digest` reads."""
    if photos := _photos(path):
        return photos
    suffix = path.suffix.lower()
    if suffix in SUFFIXES:
        return {path.resolve(), *(one.resolve() for one in dependencies(path) if one.suffix.lower() in SUFFIXES)}
    if suffix != ".gltf":
        return {path}
    try:
        buffers = read_json_object(path, _MOST_GLTF_BYTES).get("buffers")
    except InputError:
        return {path}  # its reader says what is damaged
    uris = [buffer.get("uri") for buffer in buffers if isinstance(buffer, dict)] if isinstance(buffers, list) else []
    files = [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]
    return {path, *(path.parent / unquote(uri) for uri in files)}


def attribution_of(path: Path) -> str:
    """The copyright and license line on the default prim of a layer; empty where it holds none, as over another."""
    if path.suffix.lower() not in SUFFIXES:
        return ""
    with quiet_diagnostics():
        try:
            layer = open_layer(str(path))
            spec = layer.GetAttributeAtPath(f"/{layer.defaultPrim}.{tokens.ATTRIBUTION}") if layer else None
        except (*USD_ERRORS, RuntimeError, OSError, InputError):
            return ""
    return str(spec.default or "") if spec else ""


class LayerLinks(NamedTuple):
    """What one USD file itself says, not the layers below it."""

    layers: tuple[Path, ...]  # sublayers, references and payloads as files, there or lost
    has_recipe: bool


def layer_links(path: Path) -> LayerLinks:
    """The links of a USD file; what is open from it sees what the file holds now.

    :raises InputError: a damaged file, or one that is open with changes that are not saved
    """
    facepipe_schemas.register()
    with quiet_diagnostics(), usd_errors(path, RuntimeError):
        was_open = Sdf.Layer.Find(str(path)) is not None
        layer = open_layer(str(path))  # holds it; what Find gives can go while another thread closes its stage
        if layer is None:
            raise InputError(path, "can't be read as USD")
        if was_open and layer.dirty:
            raise InputError(path, "is open with changes that are not saved, expected them saved first")
        if was_open:
            layer.Reload()
        names = [Sdf.Layer.SplitIdentifier(asset)[0] for asset in layer.GetCompositionAssetDependencies()]
        layers = tuple(
            dict.fromkeys(
                Path(layer.ComputeAbsolutePath(name))
                for name in names
                if not (Ar.IsPackageRelativePath(name) or Path(name).suffix.lower() not in SUFFIXES)
            )
        )
        prim = layer.GetPrimAtPath(f"/{layer.defaultPrim}") if layer.defaultPrim else None
        verb = prim.attributes.get(tokens.RECIPE_VERB) if prim else None
        return LayerLinks(layers, verb is not None and isinstance(verb.default, str) and bool(verb.default))
