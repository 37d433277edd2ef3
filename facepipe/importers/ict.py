"""ICT-FaceKit (USC ICT, MIT license): a real head with 53 expressions and 100 identity modes.

``points = neutral + sum_i w_i identity_i``, with w in standard deviations. The model states no unit; its numbers are
close to centimetres, and are taken as such. The eyeLook shapes of the model move lids and occlusion, not the eyeballs.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.reading import read_json
from facepipe.declare import check_ranges
from facepipe.geometry.polygons import back_of_border
from facepipe.geometry.vectors import to_segment
from facepipe.importers import ict_topology as topology
from facepipe.importers.ict_model import IctModel, read_model
from facepipe.importers.ict_topology import LANDMARKS, MATERIALS, PARTS
from facepipe.importers.mesh_pieces import (
    compact_uvs,
    face_corners,
    material_faces,
    sparse_shapes,
    whole_region,
)
from facepipe.importers.options import IctOptions
from facepipe.parts import FaceParts, Landmarks, Mesh
from facepipe.stage.imported import Imported, import_recipe

Options = IctOptions


_MOST_BYTES = 1 << 20  # of a file of weights
_LARGEST_WEIGHT = 1e3  # standard deviations; far beyond any face, small enough for sums


def read(source: Path, options: Options) -> Imported:
    """Read a FaceXModel folder, an ICT-FaceKit checkout or the packed .npz.

    :raises InputError: a file, array or option that can't be used
    :raises TopologyError: not the ICT-FaceKit topology
    """
    check_ranges(options)
    weights = identity_weights(options)
    model = read_model(source, weights, topology.EXPRESSIONS + (topology.EXTRAS if options.extras else ()))
    materials = face_materials(model)
    sources = {source: model.files} | ({options.identity: (options.identity,)} if options.identity else {})
    parts = FaceParts(
        meters_per_unit=0.01,
        up_axis="Y",
        meshes=tuple(
            _mesh(source, name, model, materials, options) for name in dict.fromkeys(part.mesh for part in PARTS)
        ),
        materials=tuple(
            material for number, material in enumerate(topology.MATERIALS.values()) if (materials == number).any()
        ),
        attribution=topology.ATTRIBUTION,
        recipe=import_recipe("ict", sources, options),
    )
    return Imported(parts=parts, warnings=model.warnings + _unknown_materials(model))


def identity_weights(options: Options) -> dict[str, float]:
    """Mode name -> weight in standard deviations, zeros left out.

    :raises InputError: both a file and a seed, or a file that can't be used
    """
    if options.identity is not None and options.identity_seed is not None:
        raise InputError("option identity_seed", "given together with identity, expected one of them")
    if options.identity is not None:
        weights = _weights_of_file(options.identity)
    elif options.identity_seed is not None:
        draws = np.random.Generator(np.random.PCG64(options.identity_seed)).standard_normal(topology.IDENTITY_MODES)
        weights = {_mode(i): float(draw) for i, draw in enumerate(draws)}
    else:
        weights = {}
    return {name: weight for name, weight in weights.items() if weight != 0}


def shape_name(name: str, arkit_names: bool) -> str:
    """The face's name of a model's shape: with `arkit_names` a side suffix ``_L`` / ``_R`` is written Left / Right."""
    if arkit_names and name.endswith(("_L", "_R")):
        return name[:-2] + ("Left" if name.endswith("_L") else "Right")
    return name


def _mode(number: int) -> str:
    return f"identity{number:03d}"


def _weights_of_file(path: Path) -> dict[str, float]:
    content = read_json(path, _MOST_BYTES)
    if isinstance(content, list):
        content = {_mode(i): value for i, value in enumerate(content)}
    if not isinstance(content, Mapping):
        raise InputError(path, "expected a JSON object or list of identity weights")
    known = {_mode(i) for i in range(topology.IDENTITY_MODES)}
    for name, value in content.items():
        if name not in known:
            raise InputError(f"{path} -> {name[:40]}", f"unknown mode, expected {_mode(0)}..{max(known)}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _LARGEST_WEIGHT:
            what = f"weight is {str(value)[:40]}, expected a number of at most {_LARGEST_WEIGHT:g} either way"
            raise InputError(f"{path} -> {name}", what)
    return {name: float(value) for name, value in content.items()}


def _unknown_materials(model: IctModel) -> tuple[str, ...]:
    unknown = [ascii(name)[:40] for name in model.neutral.materials if name not in topology.MATERIALS]
    return (f"unknown materials, left out: {', '.join(unknown)}",) if unknown else ()


def _mesh(source: Path, name: str, model: IctModel, materials: IntArray, options: Options) -> Mesh:
    neutral = model.neutral
    shapes = {shape_name(shape, options.arkit_names): offsets for shape, offsets in model.shapes.items()}
    pieces = [part for part in topology.PARTS if part.mesh == name]
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
        landmarks={"multipie68": Landmarks(indices=np.array(topology.LANDMARKS, np.int32))} if head else {},
        anchor=back_of_border(neutral.points[first:last], counts, indices) if head else None,
        material_faces=material_faces(list(topology.MATERIALS), materials[faces]),
    )


_IRIS_RADIUS = 0.6  # cm, across the axis of the eye, which looks along +Z
_PUPIL_RADIUS = 0.22  # cm

_CAP = 0.1  # cm of depth at the front of an eyeball, the middle of which is on the axis


def face_materials(model: IctModel) -> IntArray:
    """(F,) index of every face's material in `ict_topology.MATERIALS`, -1 for none or an unknown one."""
    names = list(MATERIALS)
    number = np.array([names.index(name) if name in names else -1 for name in model.neutral.materials] + [-1])
    materials = number[model.neutral.face_material]
    for part in PARTS:
        if part.title.startswith("Eyeball"):
            faces = np.arange(*part.faces)
            side = part.title.rpartition(" ")[2].capitalize()
            radius = _off_axis(model, faces, model.neutral.points[slice(*part.points)])
            shell = materials[faces] == names.index(f"M_Sclera{side}")
            inner = materials[faces] == names.index(f"M_Iris{side}")
            materials[faces[shell & (radius < _IRIS_RADIUS)]] = names.index("Cornea")
            materials[faces[inner & (radius < _PUPIL_RADIUS)]] = names.index("Pupil")
    return materials


def _off_axis(model: IctModel, faces: IntArray, points: FloatArray) -> FloatArray:
    """Distance of every face's middle from the axis of the eye; infinite behind the eyeball's middle."""
    axis = points[points[:, 2] > points[:, 2].max() - _CAP, :2].mean(axis=0)
    corners = model.neutral.face_vertex_indices[face_corners(model.neutral.face_vertex_counts, faces)]
    starts = np.cumsum(model.neutral.face_vertex_counts[faces]) - model.neutral.face_vertex_counts[faces]
    middles = np.add.reduceat(model.neutral.points[corners], starts) / model.neutral.face_vertex_counts[faces][:, None]
    behind = middles[:, 2] < (points[:, 2].min() + points[:, 2].max()) / 2
    return np.where(behind, np.inf, np.linalg.norm(middles[:, :2] - axis, axis=1))


_BLEND = 0.35  # cm

_Spot = int | tuple[float, float, float]  # a landmark's position in the list of 68, or a place in cm


class _Bundle(NamedTuple):
    """Polylines and their radius in centimetres."""

    radius: float
    lines: tuple[tuple[_Spot, ...], ...]


_BUNDLES: dict[str, _Bundle] = {
    "forehead": _Bundle(
        8.0,
        (((0.0, 7.6, 2.2), (0.0, 6.0, -1.0), (0.0, 4.0, -1.8)),),
    ),
    "eyebrows": _Bundle(0.85, ((17, 18, 19, 20, 21), (26, 25, 24, 23, 22))),
    "eyes": _Bundle(1.0, ((36, 37, 38, 39, 40, 41, 36), (42, 43, 44, 45, 46, 47, 42), (36, 39), (42, 45))),
    "nose": _Bundle(1.0, ((27, 28, 29, 30, 33), (31, 30, 35), (31, 33, 35))),
    "mouth": _Bundle(0.9, ((48, 49, 50, 51, 52, 53, 54, 55, 56, 57, 58, 59, 48), (60, 64))),
    "cheek": _Bundle(
        1.9,
        (
            ((-4.4, -0.6, 9.0), (-4.6, -3.0, 8.4), (-5.0, -5.0, 6.5), (-6.2, -2.0, 4.6), (-6.4, 0.4, 4.6)),
            ((4.4, -0.6, 9.0), (4.6, -3.0, 8.4), (5.0, -5.0, 6.5), (6.2, -2.0, 4.6), (6.4, 0.4, 4.6)),
        ),
    ),
    "chin": _Bundle(1.1, ((6, 7, 8, 9, 10), ((0.0, -6.0, 10.2), (0.0, -7.0, 9.8)))),
    "ears": _Bundle(
        1.6,
        (((-8.0, 2.0, -0.6), (-7.8, -0.5, 0.4)), ((8.0, 2.0, -0.6), (7.8, -0.5, 0.4))),
    ),
    "neck": _Bundle(
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
    distances = np.stack([_distance(neutral[:count], landmarks, bundle) for bundle in _BUNDLES.values()])
    masks = np.exp(-(distances - distances.min(axis=0)) / _BLEND)
    masks[masks < 0.01] = 0.0  # far regions are exactly absent
    masks /= masks.sum(axis=0)
    for part in PARTS:
        if part.mesh == "Head" and part.region:
            masks[:, slice(*part.points)] = np.array([name == part.region for name in REGIONS])[:, None]
    return dict(zip(REGIONS, masks, strict=True))


def _distance(points: FloatArray, landmarks: FloatArray, bundle: _Bundle) -> FloatArray:
    places = [[landmarks[spot] if isinstance(spot, int) else np.array(spot) for spot in line] for line in bundle.lines]
    segments = [(a, b) for line in places for a, b in itertools.pairwise(line)]
    return np.asarray(np.min([to_segment(points, a, b) for a, b in segments], axis=0) - bundle.radius)
