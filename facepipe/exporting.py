"""A face written for the engine: under other names, with learned sliders, or moved by a neural rig, if asked for."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean
from facepipe.core.reports import ExportReport, Watch, unwatched
from facepipe.parts import HeldFace, HeldLevels
from facepipe.registry import exporter, neural_rigs, outputs

if TYPE_CHECKING:
    from facepipe.importers.rename_table import Rename, Renamed
    from facepipe.parts import HasParts
    from facepipe.rig.neural_rig import NeuralEncoder
    from facepipe.stage import Face
    from facepipe.verbs.sliders import DistilReport


@dataclass(frozen=True, kw_only=True)
class NeuralExportReport(ExportReport):
    """What was written, and what shapes leave out."""

    dropped_mm: float  # by which points can be off for offsets that are left out
    clips_mm: float  # by which points of clips are off at most


@dataclass(frozen=True, kw_only=True)
class DistilledExportReport(ExportReport):
    """What was written, and how good the learned sliders in it are."""

    distilled: DistilReport


@dataclass(frozen=True)
class _EncodedFace(HeldFace):
    encoder: NeuralEncoder  # of a neural rig


def export(
    face: Face | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    rename: str | None = None,
    neural: str | os.PathLike[str] | None = None,
    distil: bool = False,
    lod: int = 0,
    watch: Watch = unwatched,
    **options: Any,
) -> ExportReport:
    """Write a face for the engine; the suffix of `out` gives the format.

    :param face: or its file
    :param rename: other names of shapes: a convention (arkit, vrm ...), or a table (.json, .csv)
    :param neural: a neural rig (.fpnr) whose controls are the sliders of the face; a .onnx is the graph of its controls
    :param distil: of a graph of the sliders, a small learned network in place of curves; needs torch
    :param lod: the level of detail to write, 0 the finest; `lods=True` writes all into one .glb or .gltf
    :param options: of the format, like ``engine="unity"``, of `neural`, of `distil`: those of `facepipe export --help`
    :returns: the report; of `neural` with `dropped_mm`, of `distil` with `distilled`
    :raises FacepipeError: a face or option that the format can't hold, or a file that can't be read or written
    """
    from facepipe.rig import implausible
    from facepipe.stage.face import open_face
    from facepipe.stage.files import SUFFIXES, check_output

    target, rig = Path(out), None if neural is None else Path(neural)
    module = exporter(target)
    source = None if not isinstance(face, str | os.PathLike) else Path(face)
    for one in outputs(target):
        check_output(one, [one for one in (source, rig) if one is not None], overwrite=overwrite)
    form, attach, learned = _options(module.Options, options, neural=rig is not None, distil=distil, lod=lod)
    naming = None
    if rename is not None:
        from facepipe.importers.rename_table import rename_of

        naming = rename_of(rename)
    with watch("export", 3 if distil else 2) as bar:
        whole: Any = face
        if source is not None and source.suffix.lower() in SUFFIXES:
            whole = open_face(source)
        elif source is not None:
            from facepipe.importers import read_face

            whole = read_face(source)
        whole = whole.at_level(lod) if lod else whole
        bar.update()
        made, attached, distilled, renamed = _made(whole, form, rig, attach, learned if distil else None, naming)
        if distil:
            bar.update()
        report = module.export(made, target, form)
        bar.update()
    more = (line for one in (renamed, attached, distilled) if one is not None for line in one.warnings)
    warnings = (*report.warnings, *more, *implausible(whole.parts()))
    report = replace(report, warnings=warnings, renamed=renamed.names if renamed else report.renamed)
    return _reported(report, attached, distilled)


def _reported(report: ExportReport, attached: Any, distilled: DistilReport | None) -> ExportReport:
    if attached is not None:
        return NeuralExportReport(**vars(report), dropped_mm=attached.dropped_mm, clips_mm=attached.clips_mm)
    if distilled is None:
        return report
    error = distilled.points_mm and distilled.points_mm.max + (report.error_mm or 0.0)  # of weights in fewer bytes
    return DistilledExportReport(**{**vars(report), "error_mm": error}, distilled=distilled)


def _options(
    kind: Any, options: Mapping[str, Any], *, neural: bool, distil: bool, lod: int
) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """The options of the format, an instance of `kind`, and those given of a neural rig and of learned sliders.

    :raises InputError: options that are unknown, out of range, or don't go together
    """
    known = {field.name for field in dataclasses.fields(kind)}
    attach, learned = dict[str, Any](), dict[str, Any]()
    if not options.keys() <= known:  # else what declares the others isn't loaded
        from facepipe.verbs.sliders.options import DISTIL, DistilOptions

        of_rig = {field.name for field in dataclasses.fields(neural_rigs().Options)}
        of_network = {f"{DISTIL}{field.name}" for field in dataclasses.fields(DistilOptions)}
        every = known | of_rig | of_network
        for name in options:
            if name not in every:
                near = did_you_mean(name, every) or f", expected some of {chr(32).join(known)}"
                raise InputError(f"option {name[:60]}", f"is unknown{near}")
            if (name in of_rig and not neural) or (name in of_network and not distil):
                needed = "--neural" if name in of_rig else "--distil"
                raise InputError(f"--{name.replace('_', '-')}", f"given without {needed}, expected both")
        attach = {name: value for name, value in options.items() if name in of_rig}
        learned = {name.removeprefix(DISTIL): value for name, value in options.items() if name in of_network}
    if neural and distil:
        raise InputError("--neural", "given with --distil, expected one of them")
    form = kind(**{name: value for name, value in options.items() if name in known})
    if lod and hasattr(form, "at_level"):
        form = form.at_level(lod)
    if getattr(form, "lods", False) and (neural or lod):
        raise InputError("--lods", f"given with {'--lod' if lod else '--neural'}, expected one of them")
    if distil and not getattr(form, "sliders", False):
        raise InputError("--distil", "is for the graph of the sliders, expected --sliders too, and a .onnx as OUT")
    if neural and hasattr(form, "sliders") and not form.encoder:
        form = replace(form, sliders=True)  # a graph is that of the controls, or from points back to them
    return form, attach, learned


def _made(
    face: Face,
    form: Any,
    rig: Path | None,
    attach: Mapping[str, Any],
    learned: Mapping[str, Any] | None,
    naming: Rename | None,
) -> tuple[HasParts, Any, DistilReport | None, Renamed | None]:
    """The face with learned sliders, or the neural rig, and under other names, if asked for, and reports of each.

    :raises InputError: as `DistilSliders`, a damaged rig or one without an encoder, or names that collide
    :raises TopologyError: other meshes, joints or skin than the rig was learned on
    """
    made: HasParts = face
    attached, distilled = None, None
    if learned is not None:
        from facepipe.verbs.sliders import DistilSliders

        parts, distilled = DistilSliders(**learned)(face.parts())
        made = HeldFace(parts)
    elif rig is not None and getattr(form, "encoder", False):
        from facepipe.verbs.whole_faces import Topology

        encoder = neural_rigs().encoder(rig)
        encoder.check(Topology.of(face.parts()).digest, face.where)
        made = _EncodedFace(face.parts(), encoder)
    elif rig is not None:
        attached = neural_rigs().attached(face.parts(), rig, neural_rigs().Options(**attach), face.where)
        made = HeldFace(attached.parts)
    elif getattr(form, "purpose", None) == "persons":
        from facepipe.heads.holds import held, held_level

        finest = held(face.parts())
        lower = face.lower_levels() if form.lods else ()
        made = HeldLevels(finest, tuple(held_level(one, finest) for one in lower))
    if naming is None:
        return made, attached, distilled, None
    renamed = naming(made.parts())
    if getattr(form, "lods", False):
        levels = made if isinstance(made, HeldLevels) else face
        lower = tuple(naming(lower_level).parts for lower_level in levels.lower_levels())
        made = HeldLevels(renamed.parts, lower)
    else:
        made = replace(made, held=renamed.parts) if isinstance(made, HeldFace) else HeldFace(renamed.parts)
    return made, attached, distilled, renamed
