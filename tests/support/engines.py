"""Real engines and importers that load GLBs and pose them: three.js, Babylon.js, Blender, Godot 3 and assimp.

The first three deform vertices themselves. Godot's server draws nothing and assimp only reads: there the glTF formula
goes over what they hold, with the joint matrices that Godot computes, or those of assimp's node tree.
"""

from __future__ import annotations

import ctypes.util
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from blender_python import PYTHON, blender
from facepipe_gltf.options import ENGINES, renamed
from gltf_reader import Gltf, read, trs_matrix
from node import run_node

HERE = Path(__file__).parent
_PATIENCE = 600  # seconds


class Pose(NamedTuple):
    """Activations of targets by mesh, and what each joint's node is set to: translation, rotation x y z w and scale."""

    weights: dict[str, dict[str, float]]
    joints: dict[str, list[float]]


class Piece(NamedTuple):
    """A primitive of a file, as an engine deforms it: metres, Y up."""

    mesh: str
    points: np.ndarray  # (n,) of the face's mesh, that the vertices stand for
    positions: np.ndarray  # (poses, n, 3)


class Held(NamedTuple):
    """A primitive of a file, as an engine holds it."""

    mesh: str
    positions: np.ndarray  # (n, 3)
    targets: Mapping[str, np.ndarray]  # (n, 3) positions, not offsets, by name
    bones: Sequence[str]
    weights: np.ndarray  # (n, bones)
    binds: np.ndarray  # (bones, 4, 4) inverse bind matrices
    place: np.ndarray  # (4, 4) of what is not skinned


class File(NamedTuple):
    """A GLB, and the poses that it is to take, the neutral first."""

    path: Path
    poses: Sequence[Pose]

    def primitives(self) -> list[tuple[str, np.ndarray]]:
        """Mesh and points of each primitive, in the file's order."""
        document: Gltf = read(self.path)
        return [
            (mesh["name"], document.decoded(primitive["attributes"]["_FACEPIPE_POINT"]).astype(int))
            for mesh in document.list("meshes")
            for primitive in mesh["primitives"]
        ]

    def request(self, engine: str, **more: str) -> dict[str, Any]:
        """What the programs in tests/support/js, blender and godot are asked, in the engine's names."""
        poses = [
            {
                "weights": pose.weights,
                "joints": {renamed(ENGINES[engine], key, True): x for key, x in pose.joints.items()},
            }
            for pose in self.poses
        ]
        return {"path": str(self.path), "poses": poses, **more}


def three(files: Sequence[File], folder: Path) -> list[list[Piece]]:
    """three.js deforms its vertices itself, and keeps the points they stand for."""
    return _in_node("three", files, folder)


def babylon(files: Sequence[File], folder: Path) -> list[list[Piece]]:
    """Babylon.js deforms its vertices itself; it keeps the order of the file's."""
    return _in_node("babylon", files, folder)


def _in_node(engine: str, files: Sequence[File], folder: Path) -> list[list[Piece]]:
    outs = [folder / f"{engine}.{i}.bin" for i in range(len(files))]
    request = [file.request(engine, out=str(out)) for file, out in zip(files, outs, strict=True)]
    answers = run_node(f"{engine}_poses.mjs", [], json.dumps(request))
    found = []
    for file, out, answer in zip(files, outs, answers, strict=True):
        positions = np.fromfile(out, "<f4").reshape(len(file.poses), -1, 3)
        primitives = file.primitives()
        ends = np.cumsum([len(points) for _, points in primitives])
        assert positions.shape[1] == ends[-1], f"{file.path.name}: {positions.shape[1]} vertices in {engine}"
        parts = np.split(positions, ends[:-1], axis=1)
        own = [(name, points if one is None else np.array(one, int))
               for (name, points), one in zip(primitives, answer["points"], strict=True)]  # fmt: skip
        found.append([Piece(*one, part) for one, part in zip(own, parts, strict=True)])
    return found


def in_blender(files: Sequence[File], folder: Path) -> list[list[Piece]]:
    """Blender's importer at its defaults; its armatures and shape keys, with the points it keeps as an attribute."""
    if not os.environ.get(PYTHON):
        pytest.skip(f"{PYTHON} names no Python with bpy (.ci/run makes one)")
    asked = folder / "blender.json"
    asked.write_text(json.dumps([file.request("blender") for file in files]))
    found, _ = blender("gltf_poses.py", asked, answer=folder / "blender.npz")
    return [
        [Piece(name, found[f"points {i} {j}"].astype(int), found[f"positions {i} {j}"]) for j, name in enumerate(names)]
        for i, names in ((i, found[f"names {i}"].tolist()) for i in range(len(files)))
    ]


def godot(files: Sequence[File], folder: Path) -> list[list[Piece]]:
    """Godot 3 imports the files into a project, without its lossy compression of meshes, and poses its skeletons."""
    project = godot_project(folder / "godot", {f"{i}.glb": file.path.read_bytes() for i, file in enumerate(files)})
    asked = [file.request("godot") | {"path": f"{i}.glb", "out": f"{i}.bin"} for i, file in enumerate(files)]
    return [_of_godot(file, *found) for file, found in zip(files, run_godot(project, asked), strict=True)]


def godot_project(folder: Path, glbs: Mapping[str, bytes]) -> Path:
    """A copy of tests/support/godot that has imported GLBs."""
    shutil.copytree(HERE / "godot", folder)
    for name, glb in glbs.items():
        (folder / name).write_bytes(glb)
    import_in_godot(folder, len(glbs))
    return folder


def run_godot(project: Path, request: Sequence[Mapping[str, Any]]) -> list[tuple[dict[str, Any], np.ndarray]]:
    """What poses.gd writes for each file of a request: its JSON and numbers."""
    (project / "request.json").write_text(json.dumps(request))
    command = [godot_server(), "--path", str(project), "-s", "poses.gd"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE)
    assert done.returncode == 0, done.stderr[-2000:]
    parts = [(project / one["out"]).read_bytes().partition(b"\n") for one in request]
    return [(json.loads(head), np.frombuffer(rest, "<f4").astype(np.float64)) for head, _, rest in parts]


def godot_server() -> str:
    """The program; skips the test where it is not there."""
    found = shutil.which("godot3-server")
    if found is None:
        pytest.skip("needs godot3-server on the PATH (Debian: godot3-server)")
    return found


def import_in_godot(project: Path, count: int) -> None:
    """Let the editor import a project's GLBs; it never ends by itself, and is ended when all are there."""
    with (project / "import.log").open("w") as log:
        editor = subprocess.Popen([godot_server(), "--path", str(project), "--editor"], stdout=log, stderr=log)
        try:
            for _ in range(10 * _PATIENCE):
                if len([*project.glob(".import/*.md5")]) == count:
                    return
                assert editor.poll() is None, f"Godot's editor ended: {(project / 'import.log').read_text()[-2000:]}"
                time.sleep(0.1)
            pytest.fail(f"Godot imported fewer than {count} files in {_PATIENCE} s")
        finally:
            editor.kill()
            editor.wait()


def _of_godot(file: File, head: Mapping[str, Any], numbers: np.ndarray) -> list[Piece]:
    position = 0

    def take(*shape: int) -> np.ndarray:
        nonlocal position
        position += int(np.prod(shape))
        return numbers[position - int(np.prod(shape)) : position].reshape(shape)

    worlds = [dict(zip(head["bones"], take(len(head["bones"]), 4, 4), strict=True)) for _ in file.poses]
    held = []
    for mesh in head["meshes"]:
        place, binds = take(4, 4), take(len(mesh["binds"]), 4, 4)
        for count in mesh["surfaces"]:
            points, targets = take(count, 3), take(len(mesh["targets"]), count, 3)
            weights = np.zeros((count, len(binds)))
            if len(binds):
                joints, values = take(count, 4).astype(int), take(count, 4)
                np.add.at(weights, (np.arange(count)[:, None], joints), values)
            named = dict(zip(mesh["targets"], targets, strict=True))
            held.append(Held(mesh["name"], points, named, mesh["binds"], weights, binds, place))
    assert position == len(numbers)
    return _deformed(file, held, worlds)


def assimp(files: Sequence[File], folder: Path) -> list[list[Piece]]:
    """assimp without post-processing; joints are the nodes that its bones name."""
    if ctypes.util.find_library("assimp") is None:
        pytest.skip("needs assimp (Debian: assimp-utils)")
    return [_in_assimp(file, folder / "assimp.npz") for file in files]


def _in_assimp(file: File, out: Path) -> list[Piece]:
    command = [sys.executable, str(HERE / "assimp_scene.py"), str(file.path), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE)
    if done.returncode < 0:  # a signal ended it: it read past the end of its memory
        return [
            Piece(*primitive, np.full((len(file.poses), len(primitive[1]), 3), np.inf))
            for primitive in file.primitives()
        ]
    assert done.returncode == 0, done.stderr[-2000:]
    with np.load(out) as arrays:
        return _of_assimp(file, arrays)


def _of_assimp(file: File, arrays: Mapping[str, np.ndarray]) -> list[Piece]:
    names, parents, rest = (arrays[key].tolist() for key in ("nodes", "parents", "local"))
    worlds: list[dict[str, np.ndarray]] = []
    for pose in file.poses:
        found: list[np.ndarray] = []
        for name, parent, local in zip(names, parents, rest, strict=True):
            own = to_matrix(pose.joints[name]) if name in pose.joints else np.array(local)
            found.append(found[parent] @ own if parent >= 0 else own)
        worlds.append(dict(zip(names, found, strict=True)))
    held = []
    for j, _ in enumerate(file.primitives()):
        mesh, positions, named, targets, bones, weights, binds = (
            arrays[f"{j} {key}"] for key in ("node", "positions", "names", "targets", "bones", "weights", "binds")
        )
        of_name = dict(zip(named.tolist(), targets.astype(np.float64), strict=True))
        place = np.eye(4) if len(bones) else worlds[0][str(mesh)]
        held.append(Held(str(mesh), positions.astype(np.float64), of_name, bones.tolist(), weights, binds, place))
    return _deformed(file, held, worlds)


def _deformed(file: File, every: Sequence[Held], worlds: Sequence[Mapping[str, np.ndarray]]) -> list[Piece]:
    """Pieces by the glTF formula; vertices in the file's order."""
    result = []
    for held, (mesh, points) in zip(every, file.primitives(), strict=True):
        assert (held.mesh, len(held.positions)) == (mesh, len(points))
        posed = [_deform(held, pose.weights[mesh], world) for pose, world in zip(file.poses, worlds, strict=True)]
        result.append(Piece(mesh, points, np.array(posed)))
    return result


def _deform(held: Held, weights: Mapping[str, float], worlds: Mapping[str, np.ndarray]) -> np.ndarray:
    assert {*held.targets} == {*weights}
    points = held.positions
    for name, weight in weights.items():
        if weight:
            points = points + weight * (held.targets[name] - held.positions)
    if len(held.bones):
        matrices = np.array([worlds[bone] for bone in held.bones]) @ held.binds
        blended = np.einsum("nb,bij->nij", held.weights, matrices)
        points = np.einsum("nij,nj->ni", blended[:, :3, :3], points) + blended[:, :3, 3]
    return np.einsum("ij,nj->ni", held.place[:3, :3], points) + held.place[:3, 3]


def to_matrix(numbers: Sequence[float]) -> np.ndarray:
    """(4, 4) of a joint's ten numbers."""
    return trs_matrix(*np.split(np.array(numbers), [3, 7]))


def versions() -> dict[str, str]:
    """What the runners run."""
    packages = json.loads((HERE / "js" / "package.json").read_text())["dependencies"]
    ask = [os.environ.get(PYTHON, sys.executable), "-c", "import bpy; print(bpy.app.version_string)"]
    commands = {"blender": ask, "godot": [godot_server(), "--version"], "assimp": ["assimp", "version"]}
    said = {name: subprocess.run(one, capture_output=True, text=True).stdout for name, one in commands.items()}
    numbers = {name: re.search(r"\d+(\.\d+)+", text) for name, text in said.items()}
    return {
        "three": packages["three"],
        "babylon": packages["@babylonjs/core"],
        **{name: found[0] if found else "?" for name, found in numbers.items()},
    }


RUNNERS: Mapping[str, Callable[[Sequence[File], Path], list[list[Piece]]]] = {
    "three": three,
    "babylon": babylon,
    "blender": in_blender,
    "godot": godot,
    "assimp": assimp,
}
