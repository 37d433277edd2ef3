"""Options of imports, kind by kind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from facepipe.core.errors import InputError
from facepipe.declare import option


@dataclass(frozen=True, kw_only=True)
class IctOptions:
    """How to read an ICT-FaceKit model."""

    identity: Path | None = option(
        None,
        'JSON file of identity weights: {"identity003": 1.2, ...} or a list of up to 100 numbers',
        unit="standard deviations",
    )
    identity_seed: int | None = option(None, "draw all 100 identity weights from N(0, 1) with this seed", 0, 2**63 - 1)
    arkit_names: bool = option(
        True,
        "sides in shape names as ARKit writes them: eyeBlink_L becomes eyeBlinkLeft. browInnerUp and "
        "cheekPuff, one shape each in ARKit, stay split in Left and Right",
    )
    extras: bool = option(False, "also read the shapes beyond the 53: PupilDilate and cheekRaiser, by side")
    threshold: float = option(
        2e-4,
        "point offsets up to this length are dropped from shapes: six-digit OBJ files hold coordinates "
        "over 10 to 1e-4, so that rounding alone gives offsets up to 1.7e-4",
        0.0,
        1.0,
        "cm",
    )


def parse_targets(text: str) -> dict[str, float]:
    """``name=value,...`` as a mapping.

    :raises InputError: not of that form
    """
    result: dict[str, float] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = item.partition("=")
        try:
            result[name.strip()] = float(value)
        except ValueError:
            raise InputError(f"option targets -> {name[:40]}", f"weight is {value[:40]!r}, expected a number") from None
    return result


@dataclass(frozen=True, kw_only=True)
class MakeHumanOptions:
    """How to read the MakeHuman head."""

    targets: Mapping[str, float] = option(
        dict,
        "targets to apply, name=value,...: full names (nose/nose-point-up) or their last part where only "
        "one target has it; values are usually 0..1",
        parse=parse_targets,
    )
    shapes: str = option(
        "",
        "targets to keep as blendshapes: patterns of full names, comma between "
        "(expression/caucasian/*); none by default, since the face moves by its joints",
    )
    sliders: Literal["units", "arkit"] = option(
        "units", "sliders over the joints: one of each pose unit, or of the ARKit shapes that pose units make"
    )
    meters_per_unit: float = option(0.1, "metres in a unit of the base mesh", 1e-6, 1e3, "m")


@dataclass(frozen=True, kw_only=True)
class ObjOptions:
    """How to read a folder of OBJ files."""

    neutral: str = option("neutral", "file of the neutral in the folder, .obj may be left out; any case")
    meters_per_unit: float = option(0.01, "metres in a unit of the files", 1e-6, 1e3, "m")
    up_axis: Literal["Y", "Z"] = option("Y", "axis that points up in the files")
    threshold: float = option(
        0.0, "point offsets up to this length are dropped from shapes", 0.0, 1e6, "units of the files"
    )


def parse_variants(text: str) -> dict[str, str]:
    """``SET=NAME,...`` as a mapping.

    :raises InputError: not of that form
    """
    result: dict[str, str] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, equals, variant = (part.strip() for part in item.partition("="))
        if not (name and equals and variant):
            raise InputError("option variant", f"{item[:40]!r}, expected SET=NAME,...")
        if name in result:
            raise InputError("option variant", f"the set {name[:40]!r} twice, expected each once")
        result[name] = variant
    return result


@dataclass(frozen=True, kw_only=True)
class UsdOptions:
    """Options of reading a stage."""

    prim: str | None = option(
        None, "path of the prim to read below (default: the default prim, or else the whole stage)"
    )
    skeleton: str | None = option(None, "path of the Skeleton of the face, where meshes are bound to several")
    variant: Mapping[str, str] = option(
        dict, "variants to read, SET=NAME,... (default: those that the file selects)", parse=parse_variants
    )
    strict: bool = option(False, "refuse a file with a texture that can't be read, in place of leaving that out")
    meters_per_unit: float | None = option(None, "metres in a unit, in place of what the file declares", 1e-6, 1e3, "m")
    up_axis: Literal["Y", "Z"] | None = option(None, "axis that points up, in place of what the file declares")


@dataclass(frozen=True, kw_only=True)
class FbxOptions:
    """Options of reading an FBX file."""

    fps: float | None = option(
        None,
        "frames per second that animations are sampled at; the file's frames and all keys where not given",
        1.0,
        1000.0,
    )
    strict: bool = option(False, "refuse a file with a texture that can't be read, in place of leaving that out")
    meters_per_unit: float | None = option(None, "metres in a unit, in place of what the file declares", 1e-6, 1e3, "m")
    up_axis: Literal["Y", "Z"] | None = option(None, "axis that points up, in place of what the file declares")


OPTIONS: dict[str, type] = {  # of the kinds in this folder
    "fbx": FbxOptions,
    "ict": IctOptions,
    "makehuman": MakeHumanOptions,
    "obj": ObjOptions,
    "usd": UsdOptions,
}
