"""Stages from files and to files: opened with one-line errors, saved whole or not at all, where results may be written.

Levels of detail are variants of the face prim, each with meshes of its own. The first is the face itself and holds
nothing. Any other turns the meshes of the layers below off and brings others in their place: a variant can't be
stronger than what these layers say of a mesh, and nothing that they say later can spoil another mesh. All else of the
face is shared.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path

import facepipe_schemas
from pxr import Sdf, Usd, UsdGeom, UsdUtils

from facepipe.core import tokens
from facepipe.core.atomic import collect, replacing, together, when_placed
from facepipe.core.errors import ExportError, InputError, SchemaError
from facepipe.core.policy.paths import check_written, is_below
from facepipe.stage.composition import check_counts, checked_layers, composable_layers
from facepipe.stage.values import USD_ERRORS, reason, usd_errors

_MIDNIGHT_1980 = struct.pack("<2H", 0, 1 << 5 | 1)  # DOS time and date
_METADATA = (
    *("metersPerUnit", "upAxis", "timeCodesPerSecond", "framesPerSecond", "defaultPrim"),
    *("startTimeCode", "endTimeCode"),
)
_LEAST, _LARGEST = 1e-9, 1e9  # metres in a unit
SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
_REPORT_FILE = "report.json"


@contextlib.contextmanager
def quiet_diagnostics() -> Iterator[UsdUtils.CoalescingDiagnosticDelegate]:
    """USD's warnings are collected in the block instead of printed."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield delegate
    finally:
        delegate.TakeUncoalescedDiagnostics()
        del delegate


def open_stage(path: str | os.PathLike[str], *, strict: bool = True, lacking: Sequence[str] = ()) -> Usd.Stage:
    """The stage of a file.

    :param strict: composition errors (unresolved or recursive references, missing sublayers) are errors
    :param lacking: suffixes of files whose absence is none all the same
    :raises InputError: no such file, no USD file, damaged, composed of too much, or (strict) with errors
    """
    facepipe_schemas.register()
    file = Path(path)
    check_stage_file(file)
    with quiet_diagnostics(), usd_errors(file, RuntimeError):
        # held until the stage has them: USD would read the files again, and what it reads then was not looked at
        held = composable_layers(file)
        stage = Usd.Stage.Open(str(file))
        problems = [str(error) for error in stage.GetCompositionErrors()] if strict else []
        ends = [f"{suffix}{end}" for suffix in lacking for end in "@:"]
        problems = [one for one in problems if not any(end in one for end in ends)]
        del held
        # USD maps times between layers by their rates, and never returns where one is zero or not finite
        layers = [layer for layer in stage.GetUsedLayers() if layer != stage.GetSessionLayer()]
        for layer in layers if len(layers) > 1 else ():
            rate = layer.timeCodesPerSecond
            if not (math.isfinite(rate) and rate > 0):
                where = file if layer == stage.GetRootLayer() else f"{file} -> {layer.identifier}"
                raise InputError(where, f"timeCodesPerSecond is {rate:g}, expected a finite number above 0")
        check_counts(file, stage)
    if problems:
        from facepipe.stage.array_files import check_arrays_there

        check_arrays_there(stage)
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise InputError(file, f"composition error: {problems[0]}{more}")
    return stage


def check_units(where: object, stage: Usd.Stage) -> None:
    """:raises SchemaError: a unit that is no length, or an up axis that is neither Y nor Z"""
    unit, up = float(UsdGeom.GetStageMetersPerUnit(stage)), str(UsdGeom.GetStageUpAxis(stage))
    if not (math.isfinite(unit) and _LEAST <= unit <= _LARGEST):
        raise SchemaError(where, f"metersPerUnit {unit:g}, expected a length above 0")
    if up not in ("Y", "Z"):
        raise SchemaError(where, f"upAxis '{up}', expected Y or Z")


def dependencies(path: Path) -> set[Path]:
    """Every file that a USD file needs, itself included: layers and textures.

    :raises InputError: it or a layer below it is damaged
    """
    with quiet_diagnostics(), usd_errors(path, RuntimeError):
        held = checked_layers(path)
        layers, assets, _ = UsdUtils.ComputeAllDependencies(Sdf.AssetPath(str(path)))
        del held
    return {Path(layer.realPath) for layer in layers if layer.realPath} | {Path(str(asset)) for asset in assets}


def named_in(path: Path) -> set[str]:
    """The layers and textures that a USD file itself names, as it names them.

    :raises InputError: it is damaged
    """
    with quiet_diagnostics(), usd_errors(path, RuntimeError):
        held = checked_layers(path)
        names = UsdUtils.ExtractExternalReferences(str(path))
        del held
    return {name.partition("[")[0] for kind in names for name in kind} - {""}


def check_stage_file(path: Path) -> None:
    """:raises InputError: `path` is no file, or has no USD suffix"""
    if not path.is_file():
        raise InputError(path, "no such file" if not path.exists() else "is no regular file, expected a USD file")
    check_suffix(path)


def check_suffix(path: Path) -> None:
    """:raises InputError: `path` has no USD suffix"""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(path, f"suffix '{path.suffix}', expected one of {' '.join(SUFFIXES)}")


def save_layer(layer: Sdf.Layer, path: str | os.PathLike[str], *, beside: Path | None = None) -> None:
    """Write a layer to `path` atomically; its asset paths are written as they are.

    The big arrays of a .usda go to a file beside it, as `split_arrays` says.

    :param beside: folder of the files that a .usdz takes in; none where not given
    :raises InputError: a suffix that is not USD, a folder that can't be written, or another file in the arrays' place
    :raises ExportError: a .usdz of a layer that refers to other layers
    """
    target = Path(path)
    check_suffix(target)
    if target.suffix.lower() == ".usda":
        from facepipe.stage.array_files import arrays_file, check_arrays_file, split_arrays

        layer, arrays = split_arrays(layer, target)
        if arrays is not None:
            check_arrays_file(target)
            with together(target):
                save_layer(arrays, arrays_file(target))
                save_layer(layer, target)
            return
    with replacing(target) as temporary, quiet_diagnostics():
        try:
            if target.suffix.lower() == ".usdz":
                # of the layer and of the files in `beside` that it names, and of no others
                for name in layer.GetCompositionAssetDependencies():
                    raise ExportError(target, f"a .usdz package can't hold the reference @{name}@; flatten first")
                named: dict[str, None] = {}
                UsdUtils.ModifyAssetPaths(layer, lambda name: named.setdefault(name) or name)
                root = temporary.with_name("root.usdc")
                try:
                    layer.Export(str(root))
                    with Sdf.ZipFileWriter.CreateNew(str(temporary)) as package:
                        package.AddFile(str(root), f"{target.stem}.usdc")
                        for name in named:
                            file = (beside or target) / name
                            if (
                                beside is not None
                                and name.startswith("./")
                                and is_below(file, [beside])
                                and file.is_file()
                            ):
                                package.AddFile(str(file), name.removeprefix("./"))
                finally:
                    root.unlink(missing_ok=True)
                # the same zip with every entry dated 1980-01-01: USD writes the files' times, in the local time zone
                data = bytearray(temporary.read_bytes())
                with zipfile.ZipFile(temporary) as archive:
                    entries, central = archive.infolist(), archive.start_dir
                for entry in entries:
                    data[entry.header_offset + 10 : entry.header_offset + 14] = _MIDNIGHT_1980
                    data[central + 12 : central + 16] = _MIDNIGHT_1980
                    central += 46 + sum(struct.unpack_from("<3H", data, central + 28))
                temporary.write_bytes(data)
            elif not layer.Export(str(temporary)):
                raise ExportError(target, "USD could not write the layer")
        except USD_ERRORS as error:
            raise ExportError(target, f"can't be written: {reason(error)}") from None

    def reload() -> None:
        """USD keeps layers by path: what is open from there sees the new content."""
        opened = Sdf.Layer.Find(str(target))
        if opened is not None:
            with quiet_diagnostics():
                opened.Reload(force=True)

    when_placed(reload)


def new_stage(meters_per_unit: float, up_axis: str, frames_per_second: float = 24.0) -> Usd.Stage:
    """An empty stage in memory with its units authored."""
    facepipe_schemas.register()
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z if up_axis == "Z" else UsdGeom.Tokens.y)
    stage.SetTimeCodesPerSecond(frames_per_second)
    stage.SetFramesPerSecond(frames_per_second)
    return stage


def over(base: Sdf.Layer, target: Path) -> Sdf.Layer:
    """A layer in memory that sublayers `base` and has its stage metadata.

    :raises InputError: `target`, which is to be written, is no USD file or the base itself
    """
    check_suffix(target)
    if base.realPath and Path(base.realPath) == target.resolve():
        raise InputError(target, "is the input itself, expected another output file")
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.subLayerPaths.append(base.identifier)
    for key in _METADATA:
        if base.pseudoRoot.HasInfo(key):
            layer.pseudoRoot.SetInfo(key, base.pseudoRoot.GetInfo(key))
    return layer


_name: ContextVar[Callable[[Path], str] | None] = ContextVar("facepipe_name_of_a_path", default=None)


@contextlib.contextmanager
def naming(name: Callable[[Path], str]) -> Iterator[None]:
    """Copies of files at URLs are named by these URLs in the block, where no relative path leads to them.

    :param name: the URL of a path, or the path where it has none
    """
    token = _name.set(name)
    try:
        yield
    finally:
        _name.reset(token)


def relative_path(path: str, folder: Path) -> str:
    """`path` as seen from `folder`, beginning with a dot; as it is where that can't be, or by the name of `naming`."""
    target, start, name = Path(path).resolve(), folder.resolve(), _name.get()
    if name is not None and ("://" in name(target)) != ("://" in name(start)):
        return name(target)
    try:
        relative = os.path.relpath(target, start)
    except ValueError:  # another drive on Windows
        return path
    text = Path(relative).as_posix()
    return text if text.startswith(".") else f"./{text}"


def check_output(output: Path, inputs: Sequence[Path], *, overwrite: bool) -> None:
    """Check a place before any work is done for it; what a killed run left beside it is cleaned up first.

    :raises InputError: no folder, an input or a layer or texture of one, a file that may not be overwritten, or a link
        that leads out of the roots
    """
    check_written(output)
    if not output.parent.is_dir():
        raise InputError(output, "the folder does not exist")
    collect(output.parent)
    if output.is_dir():
        raise InputError(output, "is a folder, expected a file")
    if output.suffix.lower() == ".usda":
        from facepipe.stage.array_files import arrays_file, check_arrays_file

        check_arrays_file(output)
        if arrays_file(output).exists() and not overwrite:  # of a text that was renamed, perhaps, and reads them still
            raise InputError(arrays_file(output), "exists, expected a new file (or --force)")
    if any(given.exists() and output.exists() and output.samefile(given) for given in inputs):
        raise InputError(output, "is an input, expected another output file")
    if output.exists() and not overwrite:
        raise InputError(output, "exists, expected a new file (or --force)")
    if output.exists():  # with --force a layer below an input would be lost, and the result with it
        for stage in inputs:
            if stage.is_file() and stage.suffix.lower() in SUFFIXES:
                for needed in dependencies(stage):
                    if needed.exists() and output.samefile(needed):
                        raise InputError(output, f"is needed by {stage}, expected another output file")


def check_report_folder(
    folder: Path, *, overwrite: bool, taken: Sequence[Path], known: re.Pattern[str], command: str
) -> None:
    """Check that a report may be written as `folder`: that it is new, or with `overwrite` a report from before.

    :param taken: files and folders that must not be in it: inputs and outputs
    :param known: names, with "/" below the folder, that a report of `command` has
    :raises InputError: it may not
    """
    check_written(folder)
    place = folder.resolve()
    if not place.parent.is_dir():
        raise InputError(folder, "the folder around it does not exist")
    if place.exists() and not place.is_dir():
        raise InputError(folder, "is a file, expected a folder to make")
    inside = next((path for path in taken if place in path.resolve().parents or place == path.resolve()), None)
    if inside is not None:
        raise InputError(folder, f"holds {inside.name}, which is read or written too, expected another folder")
    if not place.exists():
        return
    if not overwrite:
        raise InputError(folder, "exists, expected a new folder (or --force)")
    # --force replaces a whole folder: one that holds anything but a report may be of use to someone
    names = sorted(path.relative_to(place).as_posix() for path in place.rglob("*"))
    foreign = [name for name in names if not known.fullmatch(name)]
    if foreign or (names and _REPORT_FILE not in names):
        found = f"holds {foreign[0]}" if foreign else f"has no {_REPORT_FILE}"
        raise InputError(folder, f"{found}, expected an empty folder or a report of {command} to replace")


def level_names(prim: Usd.Prim) -> tuple[str, ...]:
    """The levels of a face, finest first; none for most faces."""
    return tuple(prim.GetVariantSet(tokens.LEVELS).GetVariantNames())


def lower_levels(stage: Usd.Stage) -> Iterator[Usd.Stage]:
    """A stage at each lower level of the face that is its default prim, good or damaged."""
    prim = stage.GetDefaultPrim()
    for name in level_names(prim)[1:] if prim else ():
        yield stage_at(stage, prim.GetPath(), name)


def stage_at(stage: Usd.Stage, path: Sdf.Path, name: str) -> Usd.Stage:
    """Another stage of the same layers, with the face prim at a level."""
    return next(at_variants(stage, path, tokens.LEVELS, [name]))


def at_variants(stage: Usd.Stage, path: Sdf.Path, variant_set: str, names: Iterable[str]) -> Iterator[Usd.Stage]:
    """Another stage of the same layers, with a prim at one of its variants after the other."""
    session = Sdf.Layer.CreateAnonymous(".usda")
    session.subLayerPaths.append(stage.GetSessionLayer().identifier)
    other = Usd.Stage.Open(stage.GetRootLayer(), session)
    other.SetEditTarget(session)
    for name in names:
        other.GetPrimAtPath(path).GetVariantSet(variant_set).SetVariantSelection(name)
        yield other
