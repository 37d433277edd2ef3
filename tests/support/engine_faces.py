"""What the engine matrix asks: faces, layouts of their GLBs, poses, and where `Face.evaluate` puts every vertex."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import facepipe_gltf
import numpy as np
from agreement import OPTIONS, SOURCES, limited, saved
from engines import File, Piece, Pose
from facepipe_gltf import Options
from gltf_export import Parts, motion, random_coefficients, to_gltf
from gltf_reader import Gltf, activate, local_matrix, read
from import_data import SHARED, shared
from small_head import make

import facepipe
from facepipe.importers import load
from facepipe.parts import FaceParts
from facepipe.rig import rest_coefficients
from facepipe.rig.trs import decompose
from facepipe.stage import Face
from facepipe.verbs.skin import SkinFace, SkinOptions

LAYOUTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "quantised": {"quantize": True},
    "8 influences": {"influences": 8, "dense": True},  # dense: an engine that reads four joints is seen to
    "dense": {"dense": True},
}
FACES = {"sample": "sample", "ict": "ICT-FaceKit", "makehuman": "MakeHuman"}
LIMITS = {  # what an engine can't read, and why
    ("three", "8 influences"): "reads four joints a vertex",
    ("godot", "8 influences"): "reads four joints a vertex",
    ("godot", "plain"): "misplaces points that sparse targets leave out",
    ("godot", "quantised"): "reads integers as they are stored",
    ("assimp", "quantised"): "reads integers as floats, past the ends of arrays",
}
_ALONE, _TOGETHER = 3, 3  # poses: shapes by themselves, and many of them with all joints
_REACH = 5.0  # mm that joints move; they turn by 0.5 rad and scale by 0.8 to 1.25 on each axis


class Case(NamedTuple):
    """A file, and what engines are to make of it."""

    file: File
    expected: Sequence[Mapping[str, np.ndarray]]  # (points, 3) of each mesh, metres, Y up, pose by pose
    height: float  # of the head, metres
    error: float  # in head heights, as the report of the export states it
    four: Sequence[Mapping[str, np.ndarray]] | None = None  # expected of an engine that reads four joints of more

    def limit(self, engine: str, layout: str) -> str | None:
        """Why an engine can't read the file, None where it can."""
        return LIMITS.get((engine, layout)) if "8" not in layout or self.four is not None else None

    def worst(self, pieces: Sequence[Piece], poses: slice = slice(None)) -> float:
        """Largest distance of a vertex from where it should be, in head heights."""
        assert sum(len(piece.points) for piece in pieces) == sum(len(points) for _, points in self.file.primitives())
        with np.errstate(invalid="ignore", over="ignore"):  # what an engine reads wrong may be any number
            found = [
                np.linalg.norm(
                    piece.positions[i].astype(np.float64) - self.expected[i][piece.mesh][piece.points], axis=1
                )
                for piece in pieces
                for i in range(len(self.expected))[poses]
            ]
        return float(np.nan_to_num(np.concatenate(found), nan=np.inf).max()) / self.height


class Posed(NamedTuple):
    """A face with at most so many influences a point, its poses, and its points in them."""

    face: Face
    parts: FaceParts
    poses: Sequence[tuple[dict[str, float], np.ndarray]]
    points: Sequence[Mapping[str, np.ndarray]]  # as in Case

    @classmethod
    def of(cls, parts: FaceParts, path: Path) -> Posed:
        """A face, saved to a stage."""
        face = saved(parts, path)
        parts, poses = face.parts(), poses_of(parts)
        turned = [face.evaluate(weights, coefficients=moves) @ to_gltf(parts).T for weights, moves in poses]
        return cls(face, parts, poses, [face.split(points) for points in turned])


def cases(name: str, folder: Path) -> dict[str, Case]:
    """A face in all layouts. For 8 influences ICT-FaceKit, which has no joints, gets those of MakeHuman's head."""
    parts = source(name)
    four = Posed.of(limited(parts, 4), folder / f"{name} 4.usdc")
    whole = limited(skinned(parts, folder) if name == "ict" else parts, 8)
    result = {layout: _case(four, layout, folder) for layout in LAYOUTS if "8" not in layout}
    eight = _case(Posed.of(whole, folder / f"{name} 8.usdc"), "8 influences", folder)
    if "JOINTS_1" in read(eight.file.path).list("meshes")[0]["primitives"][0]["attributes"]:
        eight = eight._replace(four=Posed.of(limited(whole, 4), folder / f"{name} 8 as 4.usdc").points)
    return {layout: result.get(layout, eight) for layout in LAYOUTS}


def source(name: str) -> FaceParts:
    """A face with all the influences it has; skips the test where its data is not there."""
    if name not in SOURCES:
        return make(0)
    return load(name, shared(str(SOURCES[name].relative_to(SHARED))), OPTIONS.get(name)).parts


def skinned(parts: FaceParts, folder: Path) -> FaceParts:
    """A face with MakeHuman's joints, 8 of them at most to a point."""
    face, other = saved(parts, folder / "bare.usdc"), saved(source("makehuman"), folder / "skin.usdc")
    SkinFace(source=other, options=SkinOptions(influences=8))(face)
    return facepipe.open(folder / "bare.usdc").parts()


def poses_of(parts: FaceParts) -> list[tuple[dict[str, float], np.ndarray]]:
    """Shape weights and bone coefficients: the neutral, some shapes alone, then many shapes and all joints at once."""
    rng = np.random.default_rng(17)
    rest = rest_coefficients(len(parts.skeleton.joints))
    shapes = [shape for mesh in parts.meshes for shape in mesh.blendshapes]
    names = list(dict.fromkeys(shape.name for shape in shapes))
    alone = [*[shape.name for shape in shapes if shape.inbetweens][:1], *map(str, rng.permutation(names)[:_ALONE])]
    reach = _REACH / 1000 / parts.meters_per_unit
    together = [
        (dict(zip(names, rng.random(len(names)).tolist(), strict=True)), random_coefficients(parts, rng, reach))
        for _ in range(_TOGETHER)
    ]
    return [({}, rest), *(({name: 0.7}, rest) for name in alone), *together]


def _case(posed: Posed, layout: str, folder: Path) -> Case:
    path = folder / f"{posed.parts.name} {layout}.glb"
    report = facepipe_gltf.export(Parts(posed.parts), path, Options(**LAYOUTS[layout]))
    document = read(path)
    poses = [pose_in(posed.parts, document, *pose) for pose in posed.poses]
    height = posed.face.head_height * posed.face.meters_per_unit
    return Case(File(path, poses), posed.points, height, (report.error_mm or 0.0) / 1000 / height)


def pose_in(parts: FaceParts, document: Gltf, weights: dict[str, float], coefficients: np.ndarray) -> Pose:
    nodes = {node["name"]: node for node in document.list("nodes")}
    moves = motion(parts, document, coefficients)
    local = np.array([local_matrix(nodes[name]) @ matrix for name, matrix in moves.items()]).reshape(-1, 4, 4)
    trs = decompose(local)
    assert not trs.sheared.any()
    numbers = np.concatenate([trs.translation, trs.rotation, trs.scale], axis=1).tolist()
    of_mesh = {
        mesh["name"]: dict(zip(document.targets(mesh["name"]), activate(mesh, weights).tolist(), strict=True))
        for mesh in document.list("meshes")
    }
    return Pose(of_mesh, dict(zip(moves, numbers, strict=True)))
