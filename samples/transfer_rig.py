"""A face without bones gets those of another, and runs as an engine runs it: in onnxruntime, with numpy alone.

usage: python samples/transfer_rig.py FACE RIGGED FOLDER

FACE and RIGGED are faces of any two topologies with landmarks `multipie68`. FOLDER gets FACE_rigged.usda, and .onnx
with its sidecar .json.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime

import facepipe


def transfer(face: Path, rigged: Path, folder: Path) -> Path:
    """The graph of the face with the bones of the other."""
    stage = folder / f"{face.stem}_rigged.usda"
    facepipe.skin(face, source=rigged, out=stage, overwrite=True)
    graph = stage.with_suffix(".onnx")
    facepipe.export(stage, graph, overwrite=True)
    return graph


def pose(graph: Path, joint: str, radians: float) -> np.ndarray:
    """The points (n, 3) in mm with a joint turned about its x axis. What an engine does: no facepipe from here on."""
    about = json.loads(graph.with_name(f"{graph.name}.json").read_text(encoding="utf-8"))
    feeds = {one["name"]: np.full(one["shape"], one["default"], np.float32) for one in about["inputs"]}
    number = [one["name"] for one in about["joints"]].index(joint)
    feeds["coefficients"][0, number, 3] = radians  # of tx ty tz rx ry rz sx sy sz, relative to rest
    session = onnxruntime.InferenceSession(str(graph), providers=["CPUExecutionProvider"])
    (points,) = session.run(["points"], feeds)
    return points[0] * about["face"]["meters_per_unit"] * 1000.0


def main(words: list[str]) -> int:
    """The exit code."""
    if len(words) != 3:
        print(__doc__, file=sys.stderr)
        return 2
    graph = transfer(*map(Path, words))
    moved = np.linalg.norm(pose(graph, "jaw", 0.3) - pose(graph, "jaw", 0.0), axis=1)
    print(
        f"{graph}: jaw turned by 0.3 rad: {np.count_nonzero(moved > 0.1)} points move, by {moved.max():.1f} mm at most"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
