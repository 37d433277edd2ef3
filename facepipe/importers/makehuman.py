"""MakeHuman head (CC0): hm08 base mesh with 534 targets, a 77-joint skeleton, skin weights and 60 pose units.

``points = base + sum_t w_t target_t``; joints are means of points, and follow.
"""

from __future__ import annotations

import fnmatch
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean, identifier
from facepipe.declare import check_ranges
from facepipe.geometry.polygons import back_of_border
from facepipe.importers.makehuman_rig import (
    MakeHumanData,
    arkit_sliders,
    pose_units,
    read_data,
    read_skeleton,
    unit_sliders,
)
from facepipe.importers.npz import LARGEST
from facepipe.importers.options import MakeHumanOptions
from facepipe.importers.wavefront import compact_uvs, sparse_shapes, whole_region
from facepipe.parts import FaceParts, Landmarks, Material, Mesh, Skin
from facepipe.stage.recipes import Imported, import_recipe

Options = MakeHumanOptions


ATTRIBUTION = (
    "MakeHuman base mesh, targets, rig and pose units, CC0 1.0. MakeHuman team; Data Collection AB, Joel Palmius, "
    "Jonas Hauquier; original targets by Manuel Bastioni."
)

MESHES = {  # kind of the archive -> mesh, material, region (skin: by target strength)
    "skin": ("Head", "Skin", ""),
    "eye_left": ("EyeLeft", "Eye", "eyes"),
    "eye_right": ("EyeRight", "Eye", "eyes"),
    "teeth_upper": ("TeethUpper", "Teeth", "mouth"),
    "teeth_lower": ("TeethLower", "Teeth", "mouth"),
    "tongue": ("Tongue", "Tongue", "mouth"),
    "eyelashes_left_1": ("EyelashesLeft1", "Eyelashes", "eyes"),
    "eyelashes_left_2": ("EyelashesLeft2", "Eyelashes", "eyes"),
    "eyelashes_right_1": ("EyelashesRight1", "Eyelashes", "eyes"),
    "eyelashes_right_2": ("EyelashesRight2", "Eyelashes", "eyes"),
}

MATERIALS = (
    Material(name="Skin", diffuse_color=(0.60, 0.37, 0.28), roughness=0.5),
    Material(name="Eye", diffuse_color=(0.75, 0.72, 0.69), roughness=0.1),
    Material(name="Teeth", diffuse_color=(0.78, 0.73, 0.62), roughness=0.25),
    Material(name="Tongue", diffuse_color=(0.50, 0.16, 0.15), roughness=0.35),
    Material(name="Eyelashes", diffuse_color=(0.02, 0.015, 0.01), roughness=0.8, opacity=0.15),
)

SLIDERS = {"units": unit_sliders, "arkit": arkit_sliders}


def read(source: Path, options: Options) -> Imported:
    """Read the packed head.

    :raises InputError: a file, array, target name or weight that can't be used
    :raises TopologyError: a face that joins vertices of two kinds
    """
    check_ranges(options)
    data = read_data(source)
    points = data["vertices"].astype(np.float64)
    for number, weight in _target_weights(data, options.targets).items():
        points = points + weight * data.target(number)
    if not (np.abs(points) <= LARGEST).all():
        raise InputError(source, "points overflow, expected smaller vertices, or smaller weights of targets")
    skeleton = read_skeleton(data, points)
    # shape name -> (V, 3) deltas of the targets that fit one of `patterns`
    names = data.names("target_names")
    chosen: dict[int, None] = {}
    for pattern in filter(None, (part.strip() for part in options.shapes.split(","))):
        fitting = [i for i, name in enumerate(names) if fnmatch.fnmatchcase(name, pattern)]
        if not fitting:
            raise InputError(f"option shapes -> {pattern[:60]}", "fits no target")
        chosen |= dict.fromkeys(fitting)
    short = Counter(names[i].rpartition("/")[2] for i in chosen)
    last = {i: names[i].rpartition("/")[2] for i in sorted(chosen)}
    shapes = {
        identifier(part if short[part] == 1 else names[i]): data.target(i).astype(np.float32)
        for i, part in last.items()
    }
    kinds = [kind for kind in data.names("vertex_kind_names") if kind in MESHES]
    meshes = tuple(_mesh(data, kind, points, shapes) for kind in kinds)
    parts = FaceParts(
        meters_per_unit=options.meters_per_unit,
        up_axis="Y",
        meshes=meshes,
        skeleton=skeleton,
        animations=pose_units(data, skeleton),
        sliders=SLIDERS[options.sliders](data, skeleton),
        materials=tuple(material for material in MATERIALS if any(mesh.material == material.name for mesh in meshes)),
        attribution=ATTRIBUTION,
        recipe=import_recipe("makehuman", {source: (source,)}, options),
    )
    return Imported(parts=parts)


def _target_weights(data: MakeHumanData, weights: Mapping[str, float]) -> dict[int, float]:
    """Target number -> weight, in the order of the archive."""
    names = data.names("target_names")
    numbers: dict[int, float] = {}
    for name, weight in weights.items():
        matches = [i for i, full in enumerate(names) if name == full] or [
            i for i, full in enumerate(names) if name == full.rpartition("/")[2]
        ]
        if len(matches) != 1:
            near = did_you_mean(name, [*names, *(full.rpartition("/")[2] for full in names)])
            what = f"fits {len(matches)} targets, expected a full name" if matches else f"is no target{near}"
            raise InputError(f"option targets -> {name[:60]}", what)
        if not math.isfinite(weight):
            raise InputError(f"option targets -> {name}", f"weight is {weight}, expected a finite number")
        numbers[matches[0]] = float(weight)
    return dict(sorted(numbers.items()))


def _mesh(data: MakeHumanData, kind: str, points: FloatArray, shapes: Mapping[str, FloatArray]) -> Mesh:
    name, material, region = MESHES[kind]
    chosen = data.points_of(kind)
    place = np.full(len(points), -1, dtype=np.int32)
    place[chosen] = np.arange(len(chosen))
    faces = np.flatnonzero(data["face_kind"] == data.names("vertex_kind_names").index(kind))
    counts = np.full(len(faces), 4, dtype=np.int32)
    indices = place[data["faces"][faces]].ravel()
    head = kind == "skin"
    # influences by descending weight, as many as the point with most has
    dense = data["skin_weights"][chosen]
    influences = max(int((dense > 0).sum(axis=1).max(initial=1)), 1)
    joints = np.argsort(-dense, axis=1, kind="stable")[:, :influences]
    weights = np.take_along_axis(dense, joints, axis=1).astype(np.float64)
    weights /= weights.sum(axis=1, keepdims=True)
    return Mesh(
        name=name,
        points=points[chosen],
        face_vertex_counts=counts,
        face_vertex_indices=indices,
        uv_sets=(compact_uvs(data["uv"].astype(np.float64), data["face_uv"][faces].ravel()),),
        skin=Skin(joint_indices=np.where(weights > 0, joints, 0).astype(np.int32), joint_weights=weights),
        blendshapes=sparse_shapes(shapes, chosen, threshold=0.0),
        regions=_skin_regions(data) if head else whole_region(_REGIONS, region, len(chosen)),
        landmarks={"multipie68": Landmarks(indices=landmark_points(data))} if head else {},
        anchor=back_of_border(data["vertices"][chosen], counts, indices) if head else None,
        material=material,
        double_sided=material == "Eyelashes",
    )


# fmt: off
BASE_VERTICES = (  # vertex numbers of base.obj, 0-based
    # jaw line, from the subject's right ear to the left
    5237, 269, 270, 5241, 893, 3697, 922, 5292, 5296,
    11898, 7624, 10365, 7595, 11850, 7039, 7038, 11846,
    261, 225, 222, 223, 208, 6983, 6997, 6996, 6999, 7030,  # brows
    132, 131, 201, 297, 333, 314, 317, 7077, 7095,  # nose: bridge, tip, then nostrils
    21, 0, 54, 67, 47, 41, 6851, 6838, 6784, 6805, 6825, 6831,  # eyes: outer corner of the right one first
    422, 447, 460, 466, 7219, 7207, 7182, 7130, 11939, 492, 5335, 370,  # outer lips
    428, 470, 474, 7226, 7188, 7236, 493, 481,  # inner lips
)
# fmt: on


def landmark_points(data: MakeHumanData) -> IntArray:
    """(68,) int32 indices into the skin points.

    :raises InputError: a vertex of the table is not in the skin
    """
    numbers = data["source_vertex_index"][data.points_of("skin")]
    order = np.argsort(numbers, kind="stable")
    place = np.searchsorted(numbers, BASE_VERTICES, sorter=order)
    places = order[np.minimum(place, len(order) - 1)]
    missing = numbers[places] != np.array(BASE_VERTICES)
    if missing.any():
        number = BASE_VERTICES[int(np.argmax(missing))]
        raise InputError(f"{data.path} -> source_vertex_index", f"vertex {number} of base.obj is not in the skin")
    return places.astype(np.int32)


_REGIONS = ("forehead", "eyebrows", "eyes", "nose", "mouth", "cheek", "chin", "ears", "neck")

_WEAK = 0.1  # strength (0..1) that the region of last resort has everywhere


def _skin_regions(data: MakeHumanData) -> dict[str, FloatArray]:
    """Masks of the skin points, summing to 1 at each.

    :raises InputError: a region is missing
    """
    skin = data.points_of("skin")
    names = data.names("region_names")
    if set(names) != set(_REGIONS):
        raise InputError(f"{data.path} -> region_names", f"are {', '.join(names)}, expected {', '.join(_REGIONS)}")
    strength = data["region_strength"][[names.index(name) for name in _REGIONS]][:, skin].astype(np.float64)
    # the neck is what follows bones that are not below the head
    bones = data.names("bone_names")
    if "head" not in bones:
        raise InputError(f"{data.path} -> bone_names", "no bone head there")
    in_head = np.zeros(len(bones), dtype=bool)
    for bone, parent in enumerate(data["bone_parent"].tolist()):
        in_head[bone] = bones[bone] == "head" or (parent >= 0 and in_head[parent])
    neck = np.clip(data["skin_weights"][:, ~in_head].astype(np.float64).sum(axis=1), 0.0, 1.0)[skin]
    strength[_REGIONS.index("neck")] = 0.0
    points = data["vertices"][skin]
    # raise eyes (where the nearest point that targets shape is one of eyes) or forehead to `_WEAK`, in place
    from scipy.spatial import cKDTree

    strong = np.flatnonzero(strength.max(axis=0) >= _WEAK)
    resort = np.full(len(points), _REGIONS.index("forehead"))
    if len(strong):
        nearest = strong[cKDTree(points[strong]).query(points)[1]]
        inside = strength.argmax(axis=0)[nearest] == _REGIONS.index("eyes")
        resort[inside & (strength.max(axis=0) < _WEAK)] = _REGIONS.index("eyes")
    everyone = np.arange(len(points))
    strength[resort, everyone] = np.maximum(strength[resort, everyone], _WEAK)
    masks = strength**2
    masks *= (1.0 - neck) / masks.sum(axis=0)
    masks[_REGIONS.index("neck")] = neck
    return dict(zip(_REGIONS, masks, strict=True))
