"""What the tests of the glTF exporter share."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from facepipe_gltf import Options, export
from gltf_reader import Gltf, read
from node import validate

from facepipe.core.reports import ExportReport
from facepipe.parts import FaceParts, Mesh, Skin
from facepipe.rig import build, coefficient_matrices

Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # (x, y, z) -> (x, z, -y)
TOLERANCE = 1e-5  # of the head height
HARMLESS = {"UNUSED_OBJECT"}  # UV sets that no texture of the file reads yet


class Parts:
    """A face that is its parts."""

    def __init__(self, parts: FaceParts) -> None:
        self._parts = parts

    def parts(self) -> FaceParts:
        return self._parts


Writing = Callable[..., tuple[Gltf, ExportReport]]


@pytest.fixture(scope="module")
def written() -> Iterator[list[Path]]:
    """Paths of all files that the tests of a module write: at its end the Khronos validator judges them all."""
    files: list[Path] = []
    yield files
    if shutil.which("node") is None:
        return
    for path, report in validate(files).items():
        issues = report["issues"]
        harmful = [one for one in issues["messages"] if one["severity"] < 2 or one["code"] not in HARMLESS]
        assert issues["numErrors"] == issues["numWarnings"] == 0, f"{path.name}: {harmful}"
        assert not harmful, f"{path.name}: {harmful}"


@pytest.fixture
def writing(tmp_path: Path, written: list[Path]) -> Writing:
    """Exports parts and reads the file back."""

    def write(parts: FaceParts, name: str = "face.glb", **options: Any) -> tuple[Gltf, ExportReport]:
        path = tmp_path / name
        report = export(Parts(parts), path, Options(**options))
        written.append(path)
        return read(path), report

    return write


def reference(
    parts: FaceParts,
    weights: Mapping[str, float] | None = None,
    coefficients: np.ndarray | None = None,
    influences: int | None = None,
) -> dict[str, np.ndarray]:
    """Points in metres and Y up, by the rig; with only the largest `influences` of every point."""
    if influences is not None:
        parts = replace(parts, meshes=tuple(limited(mesh, influences) for mesh in parts.meshes))
    rig = build(parts)
    points = rig.evaluate(dict(weights or {}), coefficients=coefficients)
    return rig.split(points @ to_gltf(parts).T)


def to_gltf(parts: FaceParts) -> np.ndarray:
    """(3, 3) from stage directions to those of glTF."""
    return (Z_UP_TO_Y_UP if parts.up_axis == "Z" else np.eye(3)) * parts.meters_per_unit


def limited(mesh: Mesh, influences: int) -> Mesh:
    """The mesh with the largest skin weights of every point, renormalised, as dense rows."""
    if mesh.skin is None:
        return mesh
    count = len(mesh.points)
    dense = np.zeros((count, int(mesh.skin.joint_indices.max()) + 1))
    rows = np.repeat(np.arange(count), mesh.skin.joint_indices.shape[1])
    np.add.at(dense, (rows, mesh.skin.joint_indices.ravel()), np.asarray(mesh.skin.joint_weights, np.float64).ravel())
    ranks = np.argsort(np.argsort(-dense, axis=1, kind="stable"), axis=1, kind="stable")
    dense[ranks >= influences] = 0
    dense /= dense.sum(axis=1, keepdims=True)
    joints = np.tile(np.arange(dense.shape[1]), (count, 1))
    skin = Skin(joint_indices=joints, joint_weights=dense, geom_bind_transform=mesh.skin.geom_bind_transform)
    return replace(mesh, skin=skin)


def motion(parts: FaceParts, file: Gltf, coefficients: np.ndarray) -> dict[str, np.ndarray]:
    """Bone coefficients as matrices that glTF joint nodes get after their own."""
    skeleton_scale = np.cbrt(abs(np.linalg.det(parts.skeleton.transform[:3, :3])))
    axes = np.eye(4)
    axes[:3, :3] = to_gltf(parts) * skeleton_scale
    matrices = axes @ coefficient_matrices(coefficients) @ np.linalg.inv(axes)
    return dict(zip(file.joint_names(), matrices, strict=False))


def random_coefficients(parts: FaceParts, rng: np.random.Generator, reach: float) -> np.ndarray:
    """(j, 9) bone coefficients; translations up to `reach` stage units."""
    count = len(parts.skeleton.joints)
    ranges = ((-reach, reach), (-0.5, 0.5), (0.8, 1.25))
    return np.concatenate([rng.uniform(low, high, (count, 3)) for low, high in ranges], axis=1)


def random_weights(parts: FaceParts, rng: np.random.Generator) -> dict[str, float]:
    """Weights of all shapes, beyond 0..1 too."""
    names = dict.fromkeys(shape.name for mesh in parts.meshes for shape in mesh.blendshapes)
    return {name: float(rng.uniform(-0.2, 1.2)) for name in names}


def head_height(parts: FaceParts) -> float:
    """Height in metres of the neutral's bounding box over all meshes."""
    points = np.concatenate(list(reference(parts).values()))
    return float(np.ptp(points[:, 1]))


def difference(found: Mapping[str, np.ndarray], expected: Mapping[str, np.ndarray], parts: FaceParts) -> float:
    """Largest distance of any point that a face uses, in metres."""
    worst = 0.0
    for mesh in parts.meshes:
        used = np.unique(mesh.face_vertex_indices)
        distance = np.linalg.norm(found[mesh.name][used] - expected[mesh.name][used], axis=1)
        assert np.isfinite(distance).all(), f"{mesh.name}: points without a vertex"
        worst = max(worst, float(distance.max(initial=0.0)))
    return worst
