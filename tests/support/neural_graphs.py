"""What engines make of neural rigs: their graphs, and the GLBs beside them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from facepipe_onnx import Deformer
from gltf_export import motion
from gltf_reader import Gltf, local_matrix

from facepipe.parts import FaceParts
from facepipe.rig import build
from facepipe.rig.neural_rig import NeuralRig

TOLERANCE = 1e-5


class Made(NamedTuple):
    parts: FaceParts
    rig: NeuralRig
    matrices: Deformer  # form (a)
    points: Deformer  # form (b)

    @property
    def height(self) -> float:
        """Of the head, millimetres."""
        return float(np.ptp(self.rig.points(self.rig.values({})[None])[0, :, 1]))

    def fed(self, row: np.ndarray) -> dict[str, float]:
        """Values by name."""
        return dict(zip([control.name for control in self.rig.controls], row.tolist(), strict=True))


def asked(
    parts: FaceParts, glb: Gltf, graph: Deformer, found: Mapping[str, np.ndarray]
) -> tuple[dict[str, float], dict[str, list[float]]]:
    """Target weights and local joint matrices of what the graph gives, as three.js takes them."""
    outputs, weights = {one["name"]: one for one in graph.metadata["outputs"]}, {}
    if "morph_weights" in found:  # bones may leave nothing for shapes
        names = [target["name"] for target in outputs["morph_weights"]["targets"]]
        weights = dict(zip(names, found["morph_weights"].tolist(), strict=True))
    if "coefficients" not in found:
        return weights, {}
    nodes = {node["name"]: node for node in glb.list("nodes")}
    moves = motion(parts, glb, found["coefficients"])
    joints = {name: (local_matrix(nodes[name]) @ move).T.ravel().tolist() for name, move in moves.items()}
    return weights, {re.sub(r"[\[\].:/]", "", name): matrix for name, matrix in joints.items()}  # as three.js has names


def skinned(one: Made, glb: Gltf, found: dict[str, np.ndarray]) -> np.ndarray:
    """(n, 3) metres, Y up: what an engine makes of the GLB under skinning matrices and morph weights."""
    outputs = {entry["name"]: entry for entry in one.matrices.metadata["outputs"]}
    names = [target["name"] for target in outputs["morph_weights"]["targets"]]
    weights = {}
    for mesh in one.matrices.metadata["meshes"]:
        assert [names[number] for number in mesh["targets"]] == glb.targets(mesh["name"])
        weights[mesh["name"]] = found["morph_weights"][mesh["targets"]]
    worlds = glb.worlds()
    if "skinning_matrices" in found:
        described, skin = outputs["skinning_matrices"], glb.list("skins")[0]
        assert described["joints"] == list(one.parts.skeleton.joints)
        assert list(one.parts.skeleton.names) == glb.joint_names()
        matrices = np.array(described["gltf_from_world"]) @ found["skinning_matrices"]
        matrices = matrices @ np.array(described["skeleton_from_gltf"])
        joints = skin["joints"][: len(matrices)]
        worlds[joints] = matrices @ np.linalg.inv(glb.decoded(skin["inverseBindMatrices"])[: len(matrices)])
    points = glb.evaluate(worlds=worlds, target_weights=weights)
    return np.concatenate([points[name] for name in build(one.parts).mesh_names])
