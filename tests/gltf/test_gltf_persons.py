"""The head that devices put persons on: each vertex says which point it is of, or what it lies on."""

from __future__ import annotations

from pathlib import Path

import gltf_reader
import numpy as np
import pytest

import facepipe
from facepipe.heads import make
from facepipe.parts import FaceParts
from facepipe.stage import save_parts
from facepipe.verbs.apply_person import apply_person
from facepipe.verbs.person_basis import head_basis
from facepipe.verbs.whole_faces import whole_points

_MM = 1e3


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a level of detail."""
    folder = tmp_path_factory.mktemp("head")
    save_parts(make(0, textures=32), folder / "head.usdc")
    facepipe.lod(folder / "head.usdc", out=folder / "lod.usdc", triangles=(8000,))
    return folder / "lod.usdc"


@pytest.fixture(scope="module")
def glb(head: Path) -> gltf_reader.Gltf:
    out = head.with_name("head.glb")
    facepipe.export(head, out, purpose="persons", engine="unreal", lods=True)
    return gltf_reader.read(out)


@pytest.fixture(scope="module")
def person(head: Path) -> FaceParts:
    """Somebody with the head's hair, as `apply-bones` makes them."""
    face = facepipe.open(head)
    apply_person(face, whole_points(make(4)), head_basis())
    return face.parts()


def test_vertices_follow_a_person(glb: gltf_reader.Gltf, person: FaceParts) -> None:
    points = {mesh.name: 0.01 * np.asarray(mesh.points) for mesh in person.meshes}
    seen = set()
    for mesh in glb.list("meshes")[: len(points)]:
        for primitive in mesh["primitives"]:
            own = {name: glb.decoded(number) for name, number in primitive["attributes"].items()}
            rows = own["_FACEPIPE_POINT"].astype(int)
            if "_FACEPIPE_CORNERS" in own:
                assert mesh["extras"]["facepipe"]["holds"] == "Head"
                placed = lying(own, points["Head"])
            else:
                placed = points[mesh["name"]][rows]
            away = _MM * np.linalg.norm(placed - points[mesh["name"]][rows], axis=1)
            assert away.max() < 1e-3, mesh["name"]
            seen.add((mesh["name"], "_FACEPIPE_CORNERS" in own))
    assert {("Head", False), ("EyeballLeft", False), ("Brows", True), ("Lashes", True), ("Hair", True)} <= seen


def test_levels_follow_the_finest(glb: gltf_reader.Gltf, person: FaceParts) -> None:
    """Of the head itself each vertex is a point of the finest; hair keeps its way off the skin."""
    head = next(mesh for mesh in person.meshes if mesh.name == "Head")
    before = 0.01 * np.asarray(make(0).meshes[0].points)
    coarse = [mesh for mesh in glb.list("meshes")[len(person.meshes) :] if mesh["name"].startswith("Head")]
    assert coarse
    for mesh in coarse:
        for primitive in mesh["primitives"]:
            own = {name: glb.decoded(number) for name, number in primitive["attributes"].items()}
            assert _MM * np.abs(lying(own, before) - own["POSITION"]).max() < 1e-3
            moved = lying(own, 0.01 * np.asarray(head.points))
            assert np.isin(np.round(1e6 * moved), np.round(1e4 * np.asarray(head.points))).mean() > 0.9


def lying(own: dict[str, np.ndarray], points: np.ndarray) -> np.ndarray:
    """(v, 3) metres where vertices lie, as docs/files.md says."""
    shares = own["_FACEPIPE_SHARES"]
    shares = np.column_stack([shares, 1.0 - shares.sum(axis=1)])
    return np.asarray(
        np.einsum("vk,vkc->vc", shares, points[own["_FACEPIPE_CORNERS"].astype(int)]) + own["_FACEPIPE_OFFSET"]
    )


def test_the_file_is_small_and_has_no_shapes_of_who_it_is(glb: gltf_reader.Gltf) -> None:
    names = {name for mesh in glb.list("meshes") for name in mesh.get("extras", {}).get("targetNames", [])}
    assert "jawOpen" in names
    assert not names & {"noseWidth", "noseWidthLeft", "noseWidthRight", "age"}
