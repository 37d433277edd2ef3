"""ICT-FaceKit (USC ICT, MIT license): a real head with 53 expressions and 100 identity modes.

``points = neutral + sum_i w_i identity_i``, with w in standard deviations. The model states no unit; its numbers are
close to centimetres, and are taken as such. The eyeLook shapes of the model move lids and occlusion, not the eyeballs.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.policy.paths import check_found
from facepipe.core.reading import file_beside, read_json
from facepipe.declare import check_ranges
from facepipe.geometry.polygons import back_of_border
from facepipe.geometry.vectors import to_segment
from facepipe.importers.npz import Field, check_indices, read_arrays
from facepipe.importers.options import IctOptions
from facepipe.importers.wavefront import (
    Obj,
    compact_uvs,
    face_corners,
    read_obj,
    read_offsets,
    sparse_shapes,
    whole_region,
)
from facepipe.parts import FaceParts, Landmarks, Material, Mesh, material_faces
from facepipe.stage.recipes import Imported, import_recipe

POINT_COUNT = 26719
FACE_COUNT = 26384
IDENTITY_MODES = 100
NEUTRAL = "generic_neutral_mesh.obj"

_BASE = {
    "neutral": Field("float", ("V", 3)),
    "face_vertex_counts": Field("int", ("F",)),
    "face_vertex_indices": Field("int", ("C",)),
    "uv": Field("float", ("U", 2)),
    "face_uv_indices": Field("int", ("C",)),
    "face_material": Field("int", ("F",)),
    "material_names": Field("str", ("M",)),
}
Options = IctOptions


_MOST_BYTES = 1 << 20  # of a file of weights
_LARGEST_WEIGHT = 1e3  # standard deviations; far beyond any face, small enough for sums


class Part(NamedTuple):
    """A run of points and faces that becomes (a piece of) one mesh, with the region that a loose one belongs to."""

    title: str
    mesh: str
    region: str
    points: tuple[int, int]
    faces: tuple[int, int]


# Face to eye sockets are welded: their faces share points. Head takes its regions point by point (`ict`).
PARTS = (
    Part("Face", "Head", "", (0, 9409), (0, 9230)),
    Part("Head and Neck", "Head", "", (9409, 11248), (9230, 11144)),
    Part("Mouth socket", "Head", "mouth", (11248, 13294), (11144, 13226)),
    Part("Eye socket left", "Head", "eyes", (13294, 13678), (13226, 13630)),
    Part("Eye socket right", "Head", "eyes", (13678, 14062), (13630, 14034)),
    Part("Gums and tongue", "GumsAndTongue", "mouth", (14062, 17039), (14034, 17006)),
    Part("Teeth", "Teeth", "mouth", (17039, 21451), (17006, 21496)),
    Part("Eyeball left", "EyeballLeft", "eyes", (21451, 23021), (21496, 23094)),
    Part("Eyeball right", "EyeballRight", "eyes", (23021, 24591), (23094, 24692)),
    Part("Lacrimal fluid left", "LacrimalFluidLeft", "eyes", (24591, 24795), (24692, 24855)),
    Part("Lacrimal fluid right", "LacrimalFluidRight", "eyes", (24795, 24999), (24855, 25018)),
    Part("Eye blend left", "EyeBlendLeft", "eyes", (24999, 25023), (25018, 25033)),
    Part("Eye blend right", "EyeBlendRight", "eyes", (25023, 25047), (25033, 25048)),
    Part("Eye occlusion left", "EyeOcclusionLeft", "eyes", (25047, 25199), (25048, 25176)),
    Part("Eye occlusion right", "EyeOcclusionRight", "eyes", (25199, 25351), (25176, 25304)),
    Part("Eyelashes left", "EyelashesLeft", "eyes", (25351, 26035), (25304, 25844)),
    Part("Eyelashes right", "EyelashesRight", "eyes", (26035, 26719), (25844, 26384)),
)

# fmt: off
EXPRESSIONS = (
    "browDown_L", "browDown_R", "browInnerUp_L", "browInnerUp_R", "browOuterUp_L", "browOuterUp_R",
    "cheekPuff_L", "cheekPuff_R", "cheekSquint_L", "cheekSquint_R",
    "eyeBlink_L", "eyeBlink_R", "eyeLookDown_L", "eyeLookDown_R", "eyeLookIn_L", "eyeLookIn_R",
    "eyeLookOut_L", "eyeLookOut_R", "eyeLookUp_L", "eyeLookUp_R", "eyeSquint_L", "eyeSquint_R",
    "eyeWide_L", "eyeWide_R", "jawForward", "jawLeft", "jawOpen", "jawRight", "mouthClose",
    "mouthDimple_L", "mouthDimple_R", "mouthFrown_L", "mouthFrown_R", "mouthFunnel", "mouthLeft",
    "mouthLowerDown_L", "mouthLowerDown_R", "mouthPress_L", "mouthPress_R", "mouthPucker", "mouthRight",
    "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "mouthSmile_L", "mouthSmile_R",
    "mouthStretch_L", "mouthStretch_R", "mouthUpperUp_L", "mouthUpperUp_R", "noseSneer_L", "noseSneer_R",
)
EXTRAS = ("PupilDilate_L", "PupilDilate_R", "cheekRaiser_L", "cheekRaiser_R")

LANDMARKS = (  # multipie68
    1225, 1888, 1052, 367, 1719, 1722, 2199, 1447, 966, 3661, 4390, 3927, 3924, 2608, 3272, 4088, 3443,  # jaw line
    268, 493, 1914, 2044, 1401, 3615, 4240, 4114, 2734, 2509,  # brows
    978, 4527, 4942, 4857, 1140, 2075, 1147, 4269, 3360,  # nose
    1507, 1542, 1537, 1528, 1518, 1511, 3742, 3751, 3756, 3721, 3725, 3732,  # eyes
    5708, 5695, 2081, 0, 4275, 6200, 6213, 6346, 6461, 5518, 5957, 5841,  # outer lips
    5702, 5711, 5533, 6216, 6207, 6470, 5517, 5966,  # inner lips
)
# fmt: on

ATTRIBUTION = (
    "ICT-FaceKit, Copyright (c) 2020 USC Institute for Creative Technologies, MIT license. Please cite: Li et al., "
    "Learning Formation of Physically-Based Face Attributes, CVPR 2020."
)

_SKIN = (0.60, 0.37, 0.28)

MATERIALS = {
    material.name: material
    for material in (
        Material(name="M_Face", diffuse_color=_SKIN, roughness=0.5),
        Material(name="M_BackHead", diffuse_color=_SKIN, roughness=0.5),
        Material(name="M_GumsTongue", diffuse_color=(0.50, 0.16, 0.15), roughness=0.35),
        Material(name="M_Teeth", diffuse_color=(0.78, 0.73, 0.62), roughness=0.25),
        Material(name="M_ScleraLeft", diffuse_color=(0.80, 0.77, 0.74), roughness=0.15),
        Material(name="M_ScleraRight", diffuse_color=(0.80, 0.77, 0.74), roughness=0.15),
        Material(name="M_IrisLeft", diffuse_color=(0.13, 0.08, 0.05), roughness=0.1),
        Material(name="M_IrisRight", diffuse_color=(0.13, 0.08, 0.05), roughness=0.1),
        Material(name="M_LacrimalFluid", diffuse_color=(0.0, 0.0, 0.0), roughness=0.05, opacity=0.1),
        Material(name="M_EyeBlend", diffuse_color=(0.55, 0.30, 0.25), roughness=0.3, opacity=0.2),
        Material(name="M_EyeOcclusion", diffuse_color=(0.05, 0.02, 0.02), roughness=0.9, opacity=0.15),
        Material(name="M_EyeLashes", diffuse_color=(0.02, 0.015, 0.01), roughness=0.8, opacity=0.15),
        Material(name="Cornea", diffuse_color=(0.0, 0.0, 0.0), roughness=0.02, opacity=0.05),  # see `ict`
        Material(name="Pupil", diffuse_color=(0.005, 0.005, 0.005), roughness=0.1),
    )
}


@dataclass(frozen=True, kw_only=True)
class IctModel:
    """What was read: V = 26719 points, whole model in one index space."""

    neutral: Obj  # the generic one
    identity: FloatArray  # (V, 3) offsets of the weighted identity modes
    shapes: Mapping[str, FloatArray]  # name -> (V, 3) offsets
    files: tuple[Path, ...]  # that were read
    warnings: tuple[str, ...] = ()


def read_model(source: Path, identity: Mapping[str, float], shapes: Sequence[str]) -> IctModel:
    """Read the generic neutral, the identity modes with their weights, and the named shapes that are there.

    :param source: a FaceXModel folder, an ICT-FaceKit checkout, or the packed .npz
    :raises InputError: no neutral, a weighted mode that is missing, or a file that can't be used
    :raises TopologyError: not the ICT-FaceKit topology
    """
    if not source.is_dir():
        return _read_npz(source, identity, shapes)
    inner = source / "FaceXModel"
    check_found(inner, source)
    return _read_folder(inner if inner.is_dir() else source, identity, shapes)


def _read_npz(path: Path, identity: Mapping[str, float], shapes: Sequence[str]) -> IctModel:
    sizes = {"V": POINT_COUNT, "F": FACE_COUNT}
    arrays = read_arrays(path, _BASE, sizes)
    counts = arrays["face_vertex_counts"]
    corners = len(arrays["face_vertex_indices"])
    if counts.min() < 3 or counts.max() > corners or int(counts.sum(dtype=np.int64)) != corners:
        raise InputError(f"{path} -> face_vertex_counts", f"counts don't add up to the {corners} corners there are")
    check_indices(f"{path} -> face_vertex_indices", arrays["face_vertex_indices"], len(arrays["neutral"]))
    check_indices(f"{path} -> face_uv_indices", arrays["face_uv_indices"], len(arrays["uv"]))
    check_indices(f"{path} -> face_material", arrays["face_material"], len(arrays["material_names"]))
    offsets: dict[str, FloatArray] = {}
    for kind in ("expression", "extra"):
        if kind == "expression" or set(EXTRAS) & set(shapes):
            offsets |= _named_offsets(path, kind, sizes)
    modes = _named_offsets(path, "identity", sizes) if identity else {}
    _require(path, identity, modes)
    return IctModel(
        neutral=Obj(
            points=arrays["neutral"].astype(np.float64),
            face_vertex_counts=arrays["face_vertex_counts"].astype(np.int32),
            face_vertex_indices=arrays["face_vertex_indices"].astype(np.int32),
            uvs=arrays["uv"].astype(np.float64),
            uv_indices=arrays["face_uv_indices"].astype(np.int32),
            materials=tuple(arrays["material_names"].tolist()),
            face_material=arrays["face_material"].astype(np.int32),
        ),
        identity=_weighted({name: modes[name] for name in identity}, identity),
        shapes={name: offsets[name] for name in shapes if name in offsets},
        files=(path,),
        warnings=_missing([name for name in shapes if name not in offsets]),
    )


def _named_offsets(path: Path, kind: str, sizes: dict[str, int]) -> dict[str, FloatArray]:
    axis = f"{kind} names"
    fields = {f"{kind}_names": Field("str", (axis,)), f"{kind}_deltas": Field("float", (axis, "V", 3))}
    arrays = read_arrays(path, fields, sizes)
    names = arrays[f"{kind}_names"].tolist()
    if len(set(names)) != len(names):
        raise InputError(f"{path} -> {kind}_names", "a name occurs twice, expected each once")
    return dict(zip(names, arrays[f"{kind}_deltas"], strict=True))


def _read_folder(folder: Path, identity: Mapping[str, float], shapes: Sequence[str]) -> IctModel:
    neutral_file = file_beside(folder, NEUTRAL)
    if neutral_file is None:
        raise InputError(folder, f"no {NEUTRAL} there, expected the FaceXModel folder of ICT-FaceKit")
    neutral = read_obj(neutral_file)
    if (len(neutral.points), len(neutral.face_vertex_counts)) != (POINT_COUNT, FACE_COUNT):
        raise TopologyError(
            neutral_file,
            f"{len(neutral.points)} points and {len(neutral.face_vertex_counts)} faces, expected "
            f"{POINT_COUNT} and {FACE_COUNT}",
        )
    modes = [file for name in identity if (file := file_beside(folder, f"{name}.obj"))]
    _require(folder, identity, {path.stem: path for path in modes})
    shape_files = [file for name in shapes if (file := file_beside(folder, f"{name}.obj"))]
    return IctModel(
        neutral=replace(
            neutral,
            points=neutral.points.astype(np.float32).astype(np.float64),
            uvs=neutral.uvs.astype(np.float32).astype(np.float64),
        ),
        identity=_weighted({path.stem: _offsets(path, neutral) for path in modes}, identity),
        shapes={path.stem: _offsets(path, neutral) for path in shape_files},
        files=(neutral_file, *modes, *shape_files),
        warnings=_missing([name for name in shapes if folder / f"{name}.obj" not in shape_files]),
    )


def _offsets(path: Path, neutral: Obj) -> FloatArray:
    """Rounded to 7 decimals like the packed form: the OBJ files carry six digits."""
    return np.round(read_offsets(path, neutral), 7).astype(np.float32)


def _weighted(modes: Mapping[str, FloatArray], weights: Mapping[str, float]) -> FloatArray:
    total = np.zeros((POINT_COUNT, 3))
    for name in sorted(weights):
        total += weights[name] * modes[name].astype(np.float64)
    return total


def _require(where: Path, identity: Mapping[str, float], modes: Mapping[str, object]) -> None:
    for name in identity:
        if name not in modes:
            raise InputError(f"{where} -> {name}", "identity mode is missing")


def _missing(names: Sequence[str]) -> tuple[str, ...]:
    return (f"shapes not in the source, left out: {', '.join(names)}",) if names else ()


def read(source: Path, options: Options) -> Imported:
    """Read a FaceXModel folder, an ICT-FaceKit checkout or the packed .npz.

    :raises InputError: a file, array or option that can't be used
    :raises TopologyError: not the ICT-FaceKit topology
    """
    check_ranges(options)
    if options.identity is not None and options.identity_seed is not None:
        raise InputError("option identity_seed", "given together with identity, expected one of them")
    if options.identity is not None:
        path = options.identity
        content = read_json(path, _MOST_BYTES)
        if isinstance(content, list):
            content = {_mode(i): value for i, value in enumerate(content)}
        if not isinstance(content, Mapping):
            raise InputError(path, "expected a JSON object or list of identity weights")
        known = {_mode(i) for i in range(IDENTITY_MODES)}
        for name, value in content.items():
            if name not in known:
                raise InputError(f"{path} -> {name[:40]}", f"unknown mode, expected {_mode(0)}..{max(known)}")
            if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _LARGEST_WEIGHT:
                what = f"weight is {str(value)[:40]}, expected a number of at most {_LARGEST_WEIGHT:g} either way"
                raise InputError(f"{path} -> {name}", what)
        weights = {name: float(value) for name, value in content.items()}
    elif options.identity_seed is not None:
        draws = np.random.Generator(np.random.PCG64(options.identity_seed)).standard_normal(IDENTITY_MODES)
        weights = {_mode(i): float(draw) for i, draw in enumerate(draws)}
    else:
        weights = {}
    weights = {name: weight for name, weight in weights.items() if weight != 0}
    model = read_model(source, weights, EXPRESSIONS + (EXTRAS if options.extras else ()))
    materials = face_materials(model)
    sources = {source: model.files} | ({options.identity: (options.identity,)} if options.identity else {})
    parts = FaceParts(
        meters_per_unit=0.01,
        up_axis="Y",
        meshes=tuple(
            _mesh(source, name, model, materials, options) for name in dict.fromkeys(part.mesh for part in PARTS)
        ),
        materials=tuple(material for number, material in enumerate(MATERIALS.values()) if (materials == number).any()),
        attribution=ATTRIBUTION,
        recipe=import_recipe("ict", sources, options),
    )
    unknown = [ascii(name)[:40] for name in model.neutral.materials if name not in MATERIALS]
    return Imported(
        parts=parts,
        warnings=model.warnings + ((f"unknown materials, left out: {', '.join(unknown)}",) if unknown else ()),
    )


def shape_name(name: str) -> str:
    """ARKit's name of a model's shape: a side suffix ``_L`` / ``_R`` is written Left / Right."""
    return re.sub("_L$", "Left", re.sub("_R$", "Right", name))


def _mode(number: int) -> str:
    return f"identity{number:03d}"


def _mesh(source: Path, name: str, model: IctModel, materials: IntArray, options: Options) -> Mesh:
    neutral = model.neutral
    shapes = {shape_name(name) if options.arkit_names else name: offsets for name, offsets in model.shapes.items()}
    pieces = [part for part in PARTS if part.mesh == name]
    first, last = pieces[0].points[0], pieces[-1].points[1]
    faces = np.arange(pieces[0].faces[0], pieces[-1].faces[1])
    corners = face_corners(neutral.face_vertex_counts, faces)
    indices = neutral.face_vertex_indices[corners] - first
    if indices.size and (indices.min() < 0 or indices.max() >= last - first):
        raise TopologyError(f"{source} -> {name}", "its faces use points of other parts, expected a loose mesh")
    head = name == "Head"
    counts = neutral.face_vertex_counts[faces]
    return Mesh(
        name=name,
        points=(neutral.points + model.identity)[first:last],
        face_vertex_counts=counts,
        face_vertex_indices=indices,
        uv_sets=(compact_uvs(neutral.uvs, neutral.uv_indices[corners]),) if neutral.uv_indices is not None else (),
        blendshapes=sparse_shapes(shapes, slice(first, last), options.threshold),
        regions=head_regions(neutral.points) if head else whole_region(REGIONS, pieces[0].region, last - first),
        landmarks={"multipie68": Landmarks(indices=np.array(LANDMARKS, np.int32))} if head else {},
        anchor=back_of_border(neutral.points[first:last], counts, indices) if head else None,
        material_faces=material_faces(list(MATERIALS), materials[faces]),
    )


_IRIS_RADIUS = 0.6  # cm, across the axis of the eye, which looks along +Z
_PUPIL_RADIUS = 0.22  # cm

_CAP = 0.1  # cm of depth at the front of an eyeball, the middle of which is on the axis


def face_materials(model: IctModel) -> IntArray:
    """(F,) index of every face's material in `MATERIALS`, -1 for none or an unknown one."""
    names = list(MATERIALS)
    number = np.array([names.index(name) if name in names else -1 for name in model.neutral.materials] + [-1])
    materials = number[model.neutral.face_material]
    for part in PARTS:
        if part.title.startswith("Eyeball"):
            faces = np.arange(*part.faces)
            side = part.title.rpartition(" ")[2].capitalize()
            points = model.neutral.points[slice(*part.points)]
            # distance of every face's middle from the axis of the eye; infinite behind the eyeball's middle
            axis = points[points[:, 2] > points[:, 2].max() - _CAP, :2].mean(axis=0)
            corners = model.neutral.face_vertex_indices[face_corners(model.neutral.face_vertex_counts, faces)]
            starts = np.cumsum(model.neutral.face_vertex_counts[faces]) - model.neutral.face_vertex_counts[faces]
            middles = (
                np.add.reduceat(model.neutral.points[corners], starts)
                / model.neutral.face_vertex_counts[faces][:, None]
            )
            behind = middles[:, 2] < (points[:, 2].min() + points[:, 2].max()) / 2
            radius = np.where(behind, np.inf, np.linalg.norm(middles[:, :2] - axis, axis=1))
            shell = materials[faces] == names.index(f"M_Sclera{side}")
            inner = materials[faces] == names.index(f"M_Iris{side}")
            materials[faces[shell & (radius < _IRIS_RADIUS)]] = names.index("Cornea")
            materials[faces[inner & (radius < _PUPIL_RADIUS)]] = names.index("Pupil")
    return materials


_BLEND = 0.35  # cm

_Spot = int | tuple[float, float, float]  # a landmark's position in the list of 68, or a place in cm


# region -> radius in cm, and polylines
_BUNDLES: dict[str, tuple[float, tuple[tuple[_Spot, ...], ...]]] = {
    "forehead": (
        8.0,
        (((0.0, 7.6, 2.2), (0.0, 6.0, -1.0), (0.0, 4.0, -1.8)),),
    ),
    "eyebrows": (0.85, ((17, 18, 19, 20, 21), (26, 25, 24, 23, 22))),
    "eyes": (1.0, ((36, 37, 38, 39, 40, 41, 36), (42, 43, 44, 45, 46, 47, 42), (36, 39), (42, 45))),
    "nose": (1.0, ((27, 28, 29, 30, 33), (31, 30, 35), (31, 33, 35))),
    "mouth": (0.9, ((48, 49, 50, 51, 52, 53, 54, 55, 56, 57, 58, 59, 48), (60, 64))),
    "cheek": (
        1.9,
        (
            ((-4.4, -0.6, 9.0), (-4.6, -3.0, 8.4), (-5.0, -5.0, 6.5), (-6.2, -2.0, 4.6), (-6.4, 0.4, 4.6)),
            ((4.4, -0.6, 9.0), (4.6, -3.0, 8.4), (5.0, -5.0, 6.5), (6.2, -2.0, 4.6), (6.4, 0.4, 4.6)),
        ),
    ),
    "chin": (1.1, ((6, 7, 8, 9, 10), ((0.0, -6.0, 10.2), (0.0, -7.0, 9.8)))),
    "ears": (
        1.6,
        (((-8.0, 2.0, -0.6), (-7.8, -0.5, 0.4)), ((8.0, 2.0, -0.6), (7.8, -0.5, 0.4))),
    ),
    "neck": (
        6.2,
        (((0.0, -12.0, 0.0), (0.0, -20.0, 0.0)), ((0.0, -7.0, -3.0), (0.0, -14.0, -2.0))),
    ),
}

REGIONS = tuple(_BUNDLES)


def head_regions(neutral: FloatArray) -> dict[str, FloatArray]:
    """Masks (h,) of the points of Head, summing to 1 at each.

    :param neutral: (points, 3) of the generic neutral, whatever the identity, so that masks never depend on it
    """
    count = max(part.points[1] for part in PARTS if part.mesh == "Head")
    landmarks = neutral[list(LANDMARKS)]
    distances = np.empty((len(_BUNDLES), count))
    for own, (radius, lines) in zip(distances, _BUNDLES.values(), strict=True):
        places = [[landmarks[at] if isinstance(at, int) else np.array(at) for at in line] for line in lines]
        segments = [segment for line in places for segment in itertools.pairwise(line)]
        own[:] = np.min([to_segment(neutral[:count], *segment) for segment in segments], axis=0) - radius
    # exp(-d / blend) of the distance beyond that of the nearest region: half as much after 0.24 cm
    masks = np.exp(-(distances - distances.min(axis=0)) / _BLEND)
    masks[masks < 0.01] = 0.0  # far regions are exactly absent
    masks /= masks.sum(axis=0)
    for part in PARTS:
        if part.mesh == "Head" and part.region:
            masks[:, slice(*part.points)] = np.array([name == part.region for name in REGIONS])[:, None]
    return dict(zip(REGIONS, masks, strict=True))
