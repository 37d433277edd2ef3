"""Writes the graph of an encoder and its sidecar."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping

from facepipe.core.errors import TopologyError
from facepipe.core.reports import ExportReport
from facepipe.rig.neural_encoder import NeuralEncoder
from facepipe_onnx import encoder_graph
from facepipe_onnx.describe_encoder import describe
from facepipe_onnx.metadata_checks import operators
from facepipe_onnx.model_file import outputs, write_model


def export_encoder(
    encoder: NeuralEncoder, path: str | os.PathLike[str], meshes: Mapping[str, int] | None = None, name: str = "face"
) -> ExportReport:
    """Write an encoder as an ONNX graph, points to controls, with its metadata also beside it as ``<path>.json``.

    :param meshes: name -> points of the face's meshes, in their order, for the metadata
    :param name: of the face
    :raises InputError: another suffix than .onnx, or a folder that does not exist
    :raises TopologyError: meshes of another number of points
    :raises ExportError: numbers beyond float32
    """
    start = time.perf_counter()
    target, beside = outputs(path)
    meshes = {name: encoder.point_count} if meshes is None else meshes
    if sum(meshes.values()) != encoder.point_count:
        what = f"{sum(meshes.values())} points, expected {encoder.point_count} that the encoder was learned on"
        raise TopologyError(f"{name} -> meshes", what)
    model = encoder_graph.build(encoder, name)
    metadata = describe(encoder, operators(model), meshes, name)
    size = write_model(model, metadata, name, target)
    return ExportReport(
        path=target,
        files=(target, beside),
        counts={
            "points": encoder.point_count,
            "chosen": len(encoder.chosen),
            "controls": len(encoder.controls),
            "nodes": len(model.graph.node),
        },
        bytes=size,
        seconds=time.perf_counter() - start,
    )
