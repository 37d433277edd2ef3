"""Writes the graph of a face and its sidecar."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from facepipe.core.arrays import IntArray, require_finite
from facepipe.core.errors import ExportError, InputError
from facepipe.core.names import select
from facepipe.core.reports import ExportReport
from facepipe.geometry.polygons import point_triangles
from facepipe.parts import FaceParts, HasParts, Slider
from facepipe.rig import Rig, set_face
from facepipe.rig import build as build_rig
from facepipe.rig.linear_skinning import linear_skinning_notes
from facepipe_onnx import slider_graph
from facepipe_onnx.describe import describe
from facepipe_onnx.encoder import export_encoder
from facepipe_onnx.graph import build, select_shapes
from facepipe_onnx.metadata import operators
from facepipe_onnx.model_file import outputs, write_model
from facepipe_onnx.options import Options
from facepipe_onnx.packed_weights import packed_error


def export(face: HasParts, path: str | os.PathLike[str], options: Options | None = None) -> ExportReport:
    """Write a face as an ONNX deformer, with its metadata also beside it as ``<path>.json``.

    :raises ExportError: nothing that deforms, NaN or infinity, numbers beyond float32, or more than 2 GB
    :raises InputError: another suffix than .onnx, a folder that does not exist, or a bad option
    """
    if options is not None and options.encoder:
        encoder, parts = getattr(face, "encoder", None), face.parts()
        if encoder is None:
            raise InputError("option encoder", "without one, expected --neural with a rig that has an encoder")
        return export_encoder(encoder, path, {mesh.name: len(mesh.points) for mesh in parts.meshes}, parts.name)
    return export_parts(face.parts(), path, options)


def export_parts(parts: FaceParts, path: str | os.PathLike[str], options: Options | None = None) -> ExportReport:
    """`export` of a face given as arrays.

    :raises TopologyError: indices and counts that don't fit, or a singular bind transform
    """
    start = time.perf_counter()
    (target, beside), options = outputs(path), options or Options()
    require_finite(parts, parts.name, error=ExportError)
    delivered = set_face(parts, options.pose)
    parts = delivered.parts
    whole = replace(build_rig(parts), dual=None)  # graphs blend joints linearly, which the report says
    triangles = _triangles(parts, whole) if options.normals else None
    names = select(whole.shapes, options.shapes, "shapes")
    rig, sliders, network = select_shapes(whole, names), None, None
    if options.sliders:
        model = slider_graph.build(whole, parts.sliders, options, network=parts.slider_network, triangles=triangles)
        sliders, network = slider_graph.select_driven(whole, parts.sliders, parts.slider_network, names)
    else:
        model = build(whole, options, triangles=triangles)
    metadata = describe(parts, rig, options, operators(model), sliders, network)
    packed = None
    if options.weights != "float32":
        packed = _packed_error(model, whole, rig, parts, options)
        metadata["packed_weights"] = {"type": options.weights, **packed}
    size = write_model(model, metadata, parts.name, target)
    return ExportReport(
        path=target,
        files=(target, beside),
        counts=_counts(rig, options, sliders, model),
        bytes=size,
        seconds=time.perf_counter() - start,
        warnings=linear_skinning_notes(parts),
        dropped=_dropped(parts, options, sliders),
        error_mm=None if packed is None else packed["error_mm"],
        pose=delivered.pose,
        pose_error=None if delivered.error is None else asdict(delivered.error),
    )


def _packed_error(model: Any, whole: Rig, rig: Rig, parts: FaceParts, options: Options) -> dict[str, Any]:
    plain = replace(options, weights="float32", points=False, normals=False)
    exact = slider_graph.build(whole, parts.sliders, plain, network=parts.slider_network)
    return packed_error(model, exact, rig, parts.sliders, 1e3 * parts.meters_per_unit)


def _triangles(parts: FaceParts, rig: Rig) -> IntArray:
    """(t, 3) triangles of all meshes."""
    return np.concatenate(
        [
            point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices).reshape(-1, 3) + start
            for mesh, start in zip(parts.meshes, rig.mesh_offsets[:-1], strict=True)
        ]
        or [np.zeros((0, 3), dtype=np.int64)]
    )


def _counts(rig: Rig, options: Options, sliders: Sequence[Slider] | None, model: Any) -> dict[str, int]:
    counts = {} if sliders is None else {"sliders": len(sliders)}
    if sliders is None or options.points:
        counts["points"] = len(rig.points)
    return counts | {
        "shapes": len(rig.shapes),
        "sculpts": len(rig.targets),
        "joints": len(rig.joints),
        "nodes": len(model.graph.node),
    }


def _dropped(parts: FaceParts, options: Options, sliders: Sequence[Slider] | None) -> tuple[str, ...]:
    """Lines on what the graph leaves out."""
    sculpted = {shape.name for mesh in parts.meshes for shape in mesh.blendshapes if shape.normal_offsets is not None}
    driven = sum(len(slider.shapes) for slider in parts.sliders) if options.sliders else 0
    beside = parts.slider_network is not None and not options.sliders
    counts = (
        (driven - sum(len(one.shapes) for one in sliders or ()), "shapes of sliders"),
        (int(beside), "learned network of the sliders"),
        (len(parts.meshes) if options.sliders and not options.points else 0, "meshes"),
        (len(parts.animations), "animations"),
        (len(parts.materials), "materials"),
        (sum(len(mesh.uv_sets) for mesh in parts.meshes), "UV sets"),
        (sum(mesh.normals is not None for mesh in parts.meshes), "meshes with authored normals"),
        (len(sculpted), "blendshapes with normal offsets"),
        (sum(mesh.colors is not None for mesh in parts.meshes), "meshes with display colours"),
        (len({name for mesh in parts.meshes for name in (*mesh.regions, *mesh.point_subsets)}), "regions"),
        (len({scheme for mesh in parts.meshes for scheme in mesh.landmarks}), "landmark schemes"),
    )
    return tuple(f"{what}: {count}" for count, what in counts if count)
