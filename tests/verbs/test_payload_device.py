"""The device side as docs/files.md has it: a reader of .fpb with the standard library alone, then ONNX and glTF."""

from __future__ import annotations

import hashlib
import json
import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gltf_reader
import numpy as np
import onnxruntime
import pytest
from command_line import exit_code
from faces import tiny_face
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import difference, random_coefficients
from payloads import contents
from small_head import make

import facepipe
from facepipe.parts import FaceParts
from facepipe.payload import PayloadContent, encode
from facepipe.rig import rest_coefficients
from facepipe.stage import Face, save_parts

TOLERANCE = 1e-5  # head heights
REST = [0.0] * 6 + [1.0] * 3


class RefusedError(Exception):
    """Not a payload for these joints."""


def device_reads(data: bytes, joints: Sequence[str]) -> dict[str, Any]:
    """Unit, times and coefficients [T][m][9], row by row of the table."""
    if data[:4] != b"FPBC" or len(data) < 36:
        raise RefusedError
    version, flags, m, frames, stored, unit = struct.unpack_from("<HHIIIf", data, 4)
    if version != 1 or flags > 15:
        raise RefusedError
    width, code = (4, "f") if flags & 1 else (2, "e")
    at = {"times": 32}
    at["values"] = at["times"] + (4 * frames if flags & 4 else 0)
    at["mask"] = at["values"] + frames * stored * 9 * width
    at["crc"] = at["mask"] + (-(-m // 8) if flags & 8 else 0)
    if len(data) != at["crc"] + 4 or struct.unpack("<I", data[-4:])[0] != zlib.crc32(data[:-4]):
        raise RefusedError
    if m != len(joints) or data[24:32] != hashlib.sha256("\n".join(joints).encode("utf-8")).digest()[:8]:
        raise RefusedError
    times = struct.unpack_from(f"<{frames}f", data, at["times"]) if flags & 4 else None
    mask = data[at["mask"] : at["crc"]]
    places = [j for j in range(m) if mask[j // 8] >> j % 8 & 1] if flags & 8 else list(range(m))
    assert len(places) == stored
    values = struct.unpack_from(f"<{frames * stored * 9}{code}", data, at["values"])
    poses = [[list(REST) for _ in range(m)] for _ in range(frames)]
    for number, value in enumerate(values):
        frame, place, channel = number // (9 * stored), number // 9 % stored, number % 9
        poses[frame][places[place]][channel] = value + 1.0 if channel >= 6 else value
    assert bool(flags & 2) or frames == 1
    return {"unit": unit, "times": times, "poses": poses, "is_single": not flags & 2}


@settings(max_examples=80)
@given(contents("float32") | contents("float16"))
def test_a_reader_made_from_the_documentation_reads_every_payload(one: PayloadContent) -> None:
    found = device_reads(encode(one).data, one.joints)
    assert found["unit"] == np.float32(one.meters_per_unit)
    assert found["is_single"] == (np.ndim(one.coefficients) == 2)
    assert (found["times"] is None) == (one.times is None)
    assert one.times is None or list(found["times"]) == [float(np.float32(time)) for time in one.times]
    stored = one.frames - [0, 0, 0, 0, 0, 0, 1, 1, 1]
    bound = np.abs(stored) * (2.0**-24 if one.precision == "float32" else 2.0**-11) + 2.0**-25
    assert (np.abs(np.array(found["poses"]) - one.frames) <= bound).all()


@settings(max_examples=60)
@given(contents("float32") | contents("float16"), st.data())
def test_it_refuses_what_is_damaged_or_for_other_joints(one: PayloadContent, data: st.DataObject) -> None:
    payload = encode(one).data
    bit = data.draw(st.integers(0, 8 * len(payload) - 1))
    flipped = bytearray(payload)
    flipped[bit // 8] ^= 1 << bit % 8
    for wrong, joints in (
        (bytes(flipped), one.joints),
        (payload[: data.draw(st.integers(0, len(payload) - 1))], one.joints),
        (payload, (*one.joints[:-1], "other")),
        (payload, (*one.joints, "other")),
    ):
        with pytest.raises(RefusedError):
            device_reads(wrong, joints)


# --- what it does with the numbers


def placed(up_axis: str, unit: float, scale: float) -> FaceParts:
    """The small face on a stage with these axes and units, its Skeleton prim turned, moved and scaled."""
    parts = tiny_face()
    turn = np.array([[0.0, -scale, 0, 0.5], [scale, 0, 0, -1], [0, 0, scale, 2], [0, 0, 0, 1]])
    skeleton = replace(parts.skeleton, transform=turn)
    return replace(parts, up_axis=up_axis, meters_per_unit=unit, skeleton=skeleton)  # type: ignore[arg-type]


def payload_of(face: Face, path: Path) -> np.ndarray:
    """Half of the joints moved; (m, 9) as a device reads them."""
    values = rest_coefficients(len(face.skeleton.joints))
    moving = np.arange(0, len(values), 2)
    values[moving] = random_coefficients(np.random.default_rng(3), len(moving), 0.03 * face.head_height, 0.3)
    content = PayloadContent(
        joints=face.skeleton.joints, coefficients=values, meters_per_unit=face.meters_per_unit, precision="float16"
    )
    path.write_bytes(encode(content).data)
    return np.array(device_reads(path.read_bytes(), face.skeleton.joints)["poses"][0])


CASES = {
    "sample": lambda: make(0),
    "metres": lambda: placed("Y", 1.0, 1.0),
    "z up": lambda: placed("Z", 0.01, 1.0),
    "scaled skeleton": lambda: placed("Y", 0.01, 2.0),
    "all": lambda: placed("Z", 0.0254, 0.5),
}


@pytest.mark.parametrize("kind", CASES)
def test_onnx_and_gltf_are_driven_as_the_documentation_says(kind: str, tmp_path: Path) -> None:
    parts = CASES[kind]()
    save_parts(parts, tmp_path / "face.usdc")
    face = facepipe.open(tmp_path / "face.usdc")
    values = payload_of(face, tmp_path / "p.fpb")
    expected = face.evaluate(coefficients=values)
    assert difference(face, expected, face.evaluate()) > 0.01
    for name in ("face.onnx", "face.glb"):
        more = ["--influences", "8"] if name.endswith("glb") else []
        assert exit_code("export", tmp_path / "face.usdc", "-o", tmp_path / name, *more) == 0

    sidecar = json.loads((tmp_path / "face.onnx.json").read_text())
    (joints,) = (one["joints"] for one in sidecar["inputs"] if one["name"] == "coefficients")
    assert tuple(joints) == face.skeleton.joints
    session = onnxruntime.InferenceSession(str(tmp_path / "face.onnx"), providers=["CPUExecutionProvider"])
    feed = {"coefficients": values[None].astype(np.float32)}
    feed |= {
        one.name: np.zeros(one.shape, np.float32) for one in session.get_inputs() if one.name not in ("coefficients",)
    }
    points = session.run(["points"], feed)[0].reshape(-1, 3)
    assert difference(face, points, expected) < TOLERANCE

    glb = gltf_reader.read(tmp_path / "face.glb")
    into = frame_of(face)
    motion = {
        joint.rpartition("/")[2]: into @ by_hand(row) @ np.linalg.inv(into)
        for joint, row in zip(face.skeleton.joints, values.tolist(), strict=True)
    }
    by_mesh = glb.evaluate({}, motion)
    found = np.concatenate([by_mesh[mesh.name] for mesh in face.meshes])
    world = frame_of(face, skeleton=False)
    wanted = expected @ world[:3, :3].T
    used = np.isfinite(found[:, 0])
    assert used.mean() > 0.9
    assert difference(face, found[used] / face.meters_per_unit, wanted[used] / face.meters_per_unit) < TOLERANCE


def frame_of(face: Face, *, skeleton: bool = True) -> np.ndarray:
    """The matrix A of the documentation."""
    factor = face.meters_per_unit
    factor *= float(np.linalg.norm(face.skeleton.transform[:3, 0])) if skeleton else 1.0
    turn = [[1, 0, 0], [0, 0, 1], [0, -1, 0]] if face.up_axis == "Z" else np.eye(3).tolist()
    matrix = np.eye(4)
    matrix[:3, :3] = factor * np.array(turn)
    return matrix


def by_hand(row: Sequence[float]) -> np.ndarray:
    """M = T Rz Rx Ry S of column vectors."""
    tx, ty, tz, rx, ry, rz, sx, sy, sz = row
    move = np.array([[1, 0, 0, tx], [0, 1, 0, ty], [0, 0, 1, tz], [0, 0, 0, 1]])
    c, s = math.cos, math.sin
    about_z = np.array([[c(rz), -s(rz), 0, 0], [s(rz), c(rz), 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    about_x = np.array([[1, 0, 0, 0], [0, c(rx), -s(rx), 0], [0, s(rx), c(rx), 0], [0, 0, 0, 1]])
    about_y = np.array([[c(ry), 0, s(ry), 0], [0, 1, 0, 0], [-s(ry), 0, c(ry), 0], [0, 0, 0, 1]])
    return np.asarray(move @ about_z @ about_x @ about_y @ np.diag([sx, sy, sz, 1.0]))
