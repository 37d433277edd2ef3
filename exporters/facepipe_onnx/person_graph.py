"""Persons as a graph: what a device reads of a payload in, all points and joints out."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np

from facepipe.core import __version__
from facepipe.core.arrays import IntArray
from facepipe.core.reports import ExportReport
from facepipe.onnx_graph import Nodes
from facepipe.payload.basis import FULL, BasisContent
from facepipe_onnx.metadata import FURTHER, PERSONS, operators
from facepipe_onnx.writer import outputs, write_model

_CONVENTIONS = {
    "points": "points of all meshes one after another, in their order",
    "lengths": "millimetres",
    "space": "right-handed, Y up",
    "identity_joints": "section 7 as rows and columns of M - 1 about the origin, 0 without it: x in points of the mean",
    "modes": "section 2 of a person's payload, 0 for modes that it does not have",
    "placement": "section 3 as rows: scale R transposed, then the move; without it the unit rows and none",
    "parts": "sections 4 and 5 in the same way, about the mean of the part's own points",
    "offsets": "section 6, 0 without it",
}


def export_persons(content: BasisContent, digest: str, path: str | os.PathLike[str]) -> ExportReport:
    """Write a basis as an ONNX graph, with its metadata also beside it as ``<path>.json``.

    :param digest: of the basis, hexadecimal, which persons name
    :raises InputError: another suffix than .onnx, or a folder that does not exist
    :raises ExportError: numbers beyond float32
    """
    start = time.perf_counter()
    target, beside = outputs(path)
    nodes, count, kept = Nodes(), len(content.places), len(content.modes)
    mean = nodes.constant("mean", content.mean)
    points = mean
    if kept:
        # steps are 16 bits in the file: as float32 they would be 32 MB
        steps = nodes.constant("steps", content.modes.transpose(0, 2, 1).reshape(kept, 3 * count), np.int16)
        wide = nodes.add("Mul", nodes.add("Cast", steps, to=1), nodes.constant("step", np.array(content.step)))
        points = nodes.add("Add", nodes.reshape(nodes.add("MatMul", "modes", wide), 1, count, 3), mean)
    points = _with_joints(nodes, points, content)
    points, still = (_placed(nodes, one, "placement") for one in (points, mean))
    points = _with_parts(nodes, points, still, content) if content.parts else points
    points = nodes.add("Add", points, "offsets", name="points")
    if content.joints:
        width = max(len(joint.points) for joint in content.joints)
        rows = np.zeros((len(content.joints), width), np.int64)
        shares = np.zeros((len(content.joints), 1, width))
        for i, joint in enumerate(content.joints):
            rows[i, : len(joint.points)], shares[i, 0, : len(joint.points)] = joint.points, joint.shares
        of_joints = nodes.reshape(nodes.gather(points, 1, rows.ravel()), len(rows), width, 3)
        placed = nodes.add("MatMul", nodes.constant("shares", shares), of_joints)
        nodes.reshape(placed, 1, len(rows), 3, name="joints")
    inputs: dict[str, tuple[int, ...]] = {"modes": (1, kept)} if kept else {}
    own = content.identity_joints
    inputs |= {} if own is None else {"identity_joints": (1, len(own.places), 3, 4)}
    inputs |= {"placement": (1, 4, 3)} | ({"parts": (1, len(content.parts), 4, 3)} if content.parts else {})
    inputs["offsets"] = (1, count, 3)
    ends = {"points": (1, count, 3)} | ({"joints": (1, len(content.joints), 3)} if content.joints else {})
    model = nodes.model("facepipe_persons", content.name, inputs, ends)
    size = write_model(model, _describe(content, digest, operators(model), inputs, ends), content.name, target)
    counts = {"points": count, "modes": kept, "joints": len(content.joints), "nodes": len(model.graph.node)}
    return ExportReport(
        path=target, files=(target, beside), counts=counts, bytes=size, seconds=time.perf_counter() - start
    )


def _with_joints(nodes: Nodes, points: str, content: BasisContent) -> str:
    """Points (1, n, 3) with what identity joints (1, j, 3, 4) add to those that have some."""
    own, count = content.identity_joints, len(content.places)
    if own is None:
        return points
    last, rows = own.first + len(own.indices), content.mean[own.first :][: len(own.indices)]
    blended = ""
    for indices, weights in zip(own.indices.T, own.weights.T, strict=True):
        each = nodes.constant("joint_weights", weights[None, :, None, None] / FULL)
        moved = nodes.add("Mul", nodes.gather("identity_joints", 1, indices), each)
        blended = nodes.add("Add", blended, moved) if blended else moved
    ends = nodes.constant("ends", np.column_stack([rows, np.ones(len(rows))])[None, :, :, None])
    moves = nodes.reshape(nodes.add("MatMul", blended, ends), 1, len(rows), 3)
    pieces = [nodes.add("Add", nodes.slice(points, 1, own.first, last), moves)]
    before = [nodes.slice(points, 1, 0, own.first)] if own.first else []
    after = [nodes.slice(points, 1, last, count)] if last < count else []
    return nodes.concat([*before, *pieces, *after], 1)


def _placed(nodes: Nodes, points: str, rows: str) -> str:
    """Points (1, n, 3) by rows (1, 4, 3)."""
    turned = nodes.add("MatMul", points, nodes.slice(rows, 1, 0, 3))
    return nodes.add("Add", turned, nodes.slice(rows, 1, 3, 4))


def _with_parts(nodes: Nodes, points: str, still: str, content: BasisContent) -> str:
    """Points (1, n, 3) with rigid parts where their rows (1, p, 4, 3) put them."""
    every = np.concatenate([part.rows for part in content.parts])
    others = np.setdiff1d(np.arange(len(content.places)), every)
    pieces = [nodes.gather(points, 1, others)]
    for i, part in enumerate(content.parts):
        own = nodes.gather(points if part.with_modes else still, 1, part.rows)
        middle = nodes.add("MatMul", nodes.constant("even", np.full((1, 1, len(part.rows)), 1 / len(part.rows))), own)
        rows = nodes.reshape(nodes.slice("parts", 1, i, i + 1), 1, 4, 3)
        pieces.append(nodes.add("Add", _placed(nodes, nodes.add("Sub", own, middle), rows), middle))
    order: IntArray = np.argsort(np.concatenate([others, every]))
    return nodes.gather(nodes.concat(pieces, 1), 1, order)


def _describe(
    content: BasisContent, digest: str, used: list[str], inputs: dict[str, Any], ends: dict[str, Any]
) -> dict[str, Any]:
    first, meshes = 0, []
    for mesh in content.meshes:
        meshes.append({"name": mesh.name, "first": first, "count": mesh.points})
        first += mesh.points

    def values(side: dict[str, Any]) -> list[dict[str, Any]]:
        return [{"name": name, "shape": list(shape), "type": "float32"} for name, shape in side.items()]

    return {
        "conventions": _CONVENTIONS,
        "face": {
            "meters_per_unit": 0.001,
            "name": content.name,
            "topology": f"sha256:{content.topology.hex()}",
            "up_axis": "Y",
            "basis": digest,
        },
        "format": PERSONS.format,
        "further_operators": [operator for operator in used if operator in FURTHER],
        "generator": f"facepipe {__version__}",
        "inputs": values(inputs),
        "joints": [{"path": joint.path} for joint in content.joints],
        "meshes": meshes,
        "operators": used,
        "outputs": values(ends),
    }
