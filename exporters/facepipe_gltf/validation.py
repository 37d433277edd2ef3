"""Checks of glTF files: our own, and the Khronos validator where it is installed."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from facepipe.core.reports import Finding
from facepipe_gltf import mesh_validation as mesh
from facepipe_gltf import skin_validation as skin
from facepipe_gltf.khronos import check_khronos
from facepipe_gltf.raw import RawDocument

# its name, the check (places and messages), how bad what it finds is
Check = tuple[str, Callable[[RawDocument], Iterable[tuple[str, str]]], Literal["error", "warning"]]

CHECKS: tuple[Check, ...] = (
    ("GltfAsset", mesh.asset, "error"),
    ("GltfReferences", mesh.references, "error"),
    ("GltfNodeTree", mesh.node_tree, "error"),
    ("GltfAccessors", mesh.accessors, "error"),
    ("GltfFinite", mesh.finite, "error"),
    ("GltfMinMax", mesh.bounds, "error"),
    ("GltfVertexCounts", mesh.vertex_counts, "error"),
    ("GltfTargetNames", mesh.target_names, "error"),
    ("GltfDistinctTargetNames", mesh.distinct_target_names, "warning"),
    ("GltfJointIndices", skin.joint_indices, "error"),
    ("GltfWeightsSum", skin.weights_sum, "error"),
    ("GltfInverseBinds", skin.inverse_binds, "error"),
    ("GltfJointOrder", skin.joint_order, "error"),
    ("GltfSkinnedNode", skin.skinned_nodes, "warning"),
)
_DATA = (mesh.accessors, mesh.finite, mesh.bounds)


def errors(document: RawDocument, *, data: bool = True) -> Iterator[tuple[str, str]]:
    """Where a document is wrong, and how.

    :param data: the data of all accessors is checked too, which takes most of the time
    """
    with np.errstate(all="ignore"):  # NaN and overflow are what some checks look for
        for _, check, severity in CHECKS:
            if severity == "error" and (data or check not in _DATA):
                yield from check(document)


def validate(path: str | os.PathLike[str], *, khronos: bool = True) -> tuple[Finding, ...]:
    """What is wrong with a .glb or .gltf.

    :param khronos: also run the Khronos validator; a note says so where it is not installed
    :raises InputError: no such file, or no glTF at all
    """
    return judged(RawDocument(Path(path)), CHECKS, khronos=khronos)


def judged(document: RawDocument, checks: Iterable[Check], *, khronos: bool) -> tuple[Finding, ...]:
    """What `checks` find in a document, and the Khronos validator in its file."""
    with np.errstate(all="ignore"):  # NaN and overflow are what some checks look for
        findings = [
            Finding(check=f"facepipe:{name}", severity=severity, where=f"{document.path.name} -> {at}", message=message)
            for name, check, severity in checks
            for at, message in check(document)
        ]
    return tuple(findings + (check_khronos(document.path) if khronos else []))
