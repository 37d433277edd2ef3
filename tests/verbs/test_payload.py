"""Bone coefficients as payloads: what comes back, what is refused, and faces rebuilt from them."""

from __future__ import annotations

import hashlib
import json
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gltf_reader
import numpy as np
import pytest
from agreement import limited
from command_line import done, exit_code, failed, run
from facepipe_onnx import Deformer
from faces import tiny_face
from hypothesis import given, settings
from hypothesis import strategies as st
from import_data import shared
from oracle import difference
from payloads import REST, contents, tiny_payload
from small_head import make

import facepipe
from facepipe.core.errors import InputError
from facepipe.importers import load
from facepipe.parts import FaceParts
from facepipe.payload import MAX_VALUES, PayloadContent, Precision, decode, encode, read_header
from facepipe.stage import Face, save_parts
from facepipe.verbs.apply_bones import apply_bones
from facepipe.verbs.bone_payload import write_payload

JOINTS = tuple(f"root/joint{i}" for i in range(11))
TOLERANCE = 1e-5  # of the head height


def content(
    frames: int | None = None, moving: int = 11, precision: Precision = "float32", **more: Any
) -> PayloadContent:
    """Random coefficients of the first joints."""
    rng = np.random.default_rng(5)
    values = np.tile(REST, (frames or 1, len(JOINTS), 1))
    values[:, :moving] += rng.uniform(-0.4, 0.4, (frames or 1, moving, 9))
    coefficients = values if frames else values[0]
    return PayloadContent(joints=JOINTS, coefficients=coefficients, meters_per_unit=0.01, precision=precision, **more)


SMALL = encode(content()).data
SPARSE = encode(content(3, 2, "float16", times=np.array([0.0, 0.25, 1.5]))).data


def returned(one: PayloadContent) -> PayloadContent:
    return decode(encode(one).data, one.joints, "there.fpb")


@settings(max_examples=80)
@given(contents("float32"))
def test_float32_comes_back_bit_for_bit(one: PayloadContent) -> None:
    """Scales are stored as s - 1: exact where that is, within its rounding elsewhere."""
    found = returned(one)
    exact = one.frames.copy()
    assert np.array_equal(found.frames[..., :6], exact[..., :6])
    scales = exact[..., 6:]
    near = (scales >= 0.5) & (scales <= 2.0)
    assert np.array_equal(found.frames[..., 6:][near], scales[near])
    assert np.array_equal(found.frames[..., 6:], 1 + (scales - 1).astype(np.float32).astype(float))
    assert np.shape(found.coefficients) == np.shape(one.coefficients)
    assert (found.times is None) == (one.times is None)
    assert found.times is None or np.array_equal(found.times, np.asarray(one.times))
    assert (found.joints, found.meters_per_unit, found.precision) == (one.joints, one.meters_per_unit, one.precision)


@settings(max_examples=80)
@given(contents("float16"))
def test_float16_errs_by_half_a_step_at_most_and_says_by_how_much(one: PayloadContent) -> None:
    encoded, found = encode(one), returned(one)
    error = np.abs(found.frames - one.frames)
    assert (error <= np.abs(one.frames - [0, 0, 0, 0, 0, 0, 1, 1, 1]) * 2.0**-11 + 2.0**-25).all()
    stated = (encoded.translation_error, encoded.rotation_error, encoded.scale_error)
    assert stated == tuple(error[..., i : i + 3].max() for i in (0, 3, 6))


@settings(max_examples=60)
@given(contents("float32") | contents("float16"))
def test_what_comes_back_is_the_same_payload_again(one: PayloadContent) -> None:
    data = encode(one).data
    assert encode(decode(data, one.joints, "there.fpb")).data == data


def test_joints_at_rest_are_left_out_where_that_is_smaller() -> None:
    for frames in (None, 4):
        for moving in range(12):
            one = content(frames, moving)
            encoded = encode(one)
            dense = 32 + 9 * 4 * (frames or 1) * 11 + 4
            assert len(encoded.data) == (dense if moving == 11 else 34 + 36 * (frames or 1) * max(moving, 1) + 4)
            assert len(encoded.data) <= dense
            assert read_header(encoded.data, "x").stored == encoded.stored == max(moving, 1)


def by_the_table(one: PayloadContent, mask: list[int] | None) -> bytes:
    """A payload as docs/files.md has it, by struct alone."""
    half, frames = one.precision == "float16", one.frames
    flags = (0 if half else 1) | (2 if np.ndim(one.coefficients) == 3 else 0) | (0 if one.times is None else 4)
    stored = list(range(len(one.joints))) if mask is None else mask
    data = b"FPBC" + struct.pack("<HH", 1, flags | (0 if mask is None else 8))
    data += struct.pack("<III", len(one.joints), len(frames), len(stored)) + struct.pack("<f", one.meters_per_unit)
    data += hashlib.sha256("\n".join(one.joints).encode("utf-8")).digest()[:8]
    for time in [] if one.times is None else one.times:
        data += struct.pack("<f", time)
    for frame in frames:
        for joint in stored:
            for i, value in enumerate(frame[joint]):
                data += struct.pack("<e" if half else "<f", value - 1 if i >= 6 else value)
    if mask is not None:
        bits = bytearray((len(one.joints) + 7) // 8)
        for joint in mask:
            bits[joint // 8] |= 1 << joint % 8
        data += bytes(bits)
    return data + struct.pack("<I", zlib.crc32(data))


@pytest.mark.parametrize("precision", ["float16", "float32"])
def test_the_table_of_the_documentation_is_the_format(precision: Precision) -> None:
    times = np.array([0.0, 0.5])
    for one, mask in (
        (content(None, 11, precision), None),
        (content(1, 3, precision), [0, 1, 2]),
        (content(2, 11, precision, times=times), None),
        (content(2, 9, precision, times=times), list(range(9))),
    ):
        data = by_the_table(one, mask)
        assert encode(one).data == data
        found = decode(data, JOINTS, "there.fpb")
        assert np.abs(found.frames - one.frames).max() <= (2e-4 if precision == "float16" else 3e-8)


def refusal(data: bytes, joints: tuple[str, ...] = JOINTS) -> str:
    with pytest.raises(InputError, match=r"^there\.fpb: ") as caught:
        decode(data, joints, "there.fpb")
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("data", [SMALL, SPARSE], ids=["small", "sparse"])
def test_every_truncation_and_every_flipped_bit_is_refused(data: bytes) -> None:
    decode(data, JOINTS, "there.fpb")
    for size in range(len(data)):
        refusal(data[:size])
    for bit in range(8 * len(data)):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        refusal(bytes(damaged))
    assert "bytes, expected" in refusal(data + b"\0")


def signed(body: bytes) -> bytes:
    return body + struct.pack("<I", zlib.crc32(body))


def with_field(data: bytes, offset: int, form: str, value: float) -> bytes:
    body = bytearray(data[:-4])
    struct.pack_into(form, body, offset, value)
    return signed(bytes(body))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (with_field(SMALL, 4, "<H", 2), "version 2, expected 1"),
        (with_field(SMALL, 4, "<H", 0), "version 0, expected 1"),
        (with_field(SMALL, 6, "<H", 17), "flags 0x0011"),
        (with_field(SMALL, 6, "<H", 1 + 4), "bytes, expected"),
        (with_field(SMALL, 12, "<I", 2**32 - 1), "bytes, expected"),
        (with_field(SMALL, 8, "<I", 2**32 - 1), "stored without a mask"),
        (with_field(SMALL, 8, "<I", 10), "11 among 10 joints"),
        (with_field(SMALL, 20, "<f", float("nan")), "metres a unit"),
        (with_field(SMALL, 20, "<f", -1.0), "metres a unit"),
        (with_field(SMALL, 24, "<B", SMALL[24] ^ 1), "made for other joints"),
        (with_field(SMALL, 32, "<f", float("nan")), "NaN, infinity"),
        (with_field(SMALL, 32, "<f", 1e38), "NaN, infinity"),
        (with_field(SPARSE, 44, "<e", float("inf")), "NaN, infinity"),
        (with_field(SPARSE, 36, "<f", 0.0), "times don't ascend"),
        (with_field(SPARSE, 40, "<f", float("inf")), "times don't ascend"),
        (with_field(SPARSE, len(SPARSE) - 6, "<B", 7), "joint mask of 3 joints"),
        (with_field(SPARSE, len(SPARSE) - 6, "<B", 0), "joint mask of 0 joints"),
        (with_field(SPARSE, len(SPARSE) - 6, "<H", 0x8001), "joint mask of 2 joints"),
        (signed(struct.pack("<4sHHIIIf8s", b"FPBC", 1, 3, 0, 1, 0, 1.0, b"")), "0 among 0 joints"),
        (signed(struct.pack("<4sHHIIIf8s", b"FPBC", 1, 3, 4, 0, 4, 1.0, b"")), "0 frames"),
        (signed(struct.pack("<4sHHIIIf8s", b"FPBC", 1, 3, 0, 2**32 - 1, 0, 1.0, b"")), "0 among 0 joints"),
        (signed(struct.pack("<4sHHIIIf8s", b"FPBC", 1, 11, 2**20, 1, 1, 1.0, b"") + bytes(36 + 2**17))[:-1], "bytes"),
        (b"", "FPBC"),
        (b"PK\3\4" + SMALL[4:], "FPBC"),
    ],
)
def test_payloads_that_are_sound_but_wrong_are_refused(data: bytes, message: str) -> None:
    assert message in refusal(data)


def test_a_payload_that_unfolds_to_more_than_a_reader_allocates_is_refused() -> None:
    """One joint of many moves: what is stored is small, what comes of it is not."""
    frames, joints = 1 << 14, 1 << 10
    header = struct.pack("<4sHHIIIf8s", b"FPBC", 1, 2 + 8, joints, frames, 1, 1.0, b"")
    data = signed(header + bytes(18 * frames) + b"\1" + bytes(joints // 8 - 1))
    assert 9 * frames * joints > MAX_VALUES
    with pytest.raises(InputError, match=r"frames of 1024 joints, expected 13107200 numbers at most"):
        read_header(data, "there.fpb")


def test_other_joints_are_reported_apart() -> None:
    assert "made for other joints (11, hash" in refusal(SMALL, JOINTS[:-1])
    assert "made for other joints" in refusal(SMALL, (JOINTS[1], JOINTS[0], *JOINTS[2:]))
    assert "made for other joints" in refusal(SMALL, (*JOINTS[:-1], "root/jaw"))


@settings(max_examples=150)
@given(
    st.tuples(st.integers(0, 31), *[st.sampled_from([0, 1, 2, 11, 12, 2**16, 2**31, 2**32 - 1])] * 3),
    st.binary(max_size=120),
)
def test_no_header_makes_a_reader_allocate_more_than_its_file_can_fill(
    counts: tuple[int, int, int, int], rest: bytes
) -> None:
    """Counts at will, the rest filled up to the size that they promise where that is small."""
    flags, joints, frames, stored = counts
    header = struct.pack("<4sHHIIIf", b"FPBC", 1, flags, joints, frames, stored, 1.0) + bytes.fromhex(
        read_header(SMALL, "x").joints_hash
    )
    promised = 4 * frames * bool(flags & 4) + 9 * frames * stored * (4 if flags & 1 else 2)
    promised += (joints + 7) // 8 * bool(flags & 8)
    data = signed(header + (rest * (promised // max(len(rest), 1) + 1))[:promised] if promised < 1e5 else header + rest)
    tracemalloc.start()
    try:
        decode(data, JOINTS, "there.fpb")
    except InputError:
        pass  # most are refused
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 200_000 + 100 * len(data)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coefficients": np.tile(REST, (10, 1))}, "array of shape"),
        ({"coefficients": np.zeros((0, 11, 9))}, "array of shape"),
        ({"joints": (), "coefficients": np.zeros((0, 9))}, "array of shape"),
        ({"coefficients": np.full((11, 9), np.nan)}, "root/joint0 -> translation x: nan"),
        ({"coefficients": np.full((11, 9), 1e300)}, "translation x: 1e[+]300"),
        ({"coefficients": np.full((11, 9), 7e4), "precision": "float16"}, "70000, expected one that float16 holds"),
        ({"precision": "float64"}, "precision 'float64'"),
        ({"meters_per_unit": 0.0}, "metres a unit"),
        ({"meters_per_unit": float("nan")}, "metres a unit"),
        ({"times": np.zeros(1)}, "times"),
        ({"coefficients": np.tile(REST, (2, 11, 1)), "times": np.zeros(3)}, "expected one per frame"),
        ({"coefficients": np.tile(REST, (2, 11, 1)), "times": np.array([1.0, 1.0 + 1e-9])}, "times don't ascend"),
        ({"coefficients": np.tile(REST, (2, 11, 1)), "times": np.array([1.0, 1e300])}, "times don't ascend"),
        ({"coefficients": np.broadcast_to(REST, (MAX_VALUES // 99 + 1, 11, 9))}, "expected at most"),
    ],
)
def test_content_that_no_payload_holds_is_refused(change: dict[str, Any], message: str) -> None:
    fields = {"joints": JOINTS, "coefficients": np.tile(REST, (11, 1)), "meters_per_unit": 0.01, **change}
    with pytest.raises(InputError, match=message):
        encode(PayloadContent(**fields))


# ---- faces ----


def makehuman_parts() -> FaceParts:
    return load("makehuman", shared("makehuman/makehuman_head.npz"), None).parts


FACES: dict[str, Callable[[], FaceParts]] = {"sample": lambda: make(0), "makehuman": makehuman_parts}


@pytest.fixture(scope="module", params=FACES)
def face(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Face:
    """Limited to the influences that a GLB holds."""
    path = tmp_path_factory.mktemp(request.param) / "face.usdc"
    save_parts(limited(FACES[request.param](), 8), path)
    return facepipe.open(path)


def weighted(one: Face) -> np.ndarray:
    return np.flatnonzero(np.asarray(one.rig().influences[:, :-1].sum(axis=0)) > 0)


def random_content(one: Face, frames: int | None, precision: Precision = "float32") -> PayloadContent:
    """Joints that hold points moved by 10 mm, 0.3 rad and 0.8 to 1.25; a clip where `frames` are given."""
    rng, moving = np.random.default_rng(9), weighted(one)[::2]
    values = np.tile(REST, (frames or 1, len(one.skeleton.joints), 1))
    reach = [10 / one.mm_per_unit] * 3 + [0.3] * 3 + [0.2] * 3
    values[:, moving] += rng.uniform(-1, 1, (len(values), len(moving), 9)) * reach
    return PayloadContent(
        joints=one.skeleton.joints,
        coefficients=values if frames else values[0],
        times=np.arange(frames) / 24 if frames else None,
        meters_per_unit=one.meters_per_unit,
        precision=precision,
    )


def beyond(one: Face, values: PayloadContent) -> bool:
    """Whether some coefficient is beyond the face's limits."""
    limits = one.parts().bone_limits
    return limits is not None and bool(((values.frames < limits.lower) | (values.frames > limits.upper)).any())


def test_a_face_is_rebuilt_on_the_stage_in_the_glb_and_by_the_deformer(face: Face, tmp_path: Path) -> None:
    source = Path(face.stage.GetRootLayer().realPath)
    poses = {"person": random_content(face, None), "clip": random_content(face, 3)}
    stage = source
    for name, one in poses.items():
        write_payload(tmp_path / f"{name}.fpb", one, face.rig())
        stage, base = tmp_path / f"{name}.usda", stage
        for words in ((base, stage), (source, tmp_path / f"{name}.npz")):
            assert exit_code("apply-bones", words[0], tmp_path / f"{name}.fpb", "-o", words[1]) == beyond(face, one)
    assert exit_code("validate", stage) == 0
    options = ("--animations", "--influences", 8, "--pose", "rest")
    assert exit_code("export", stage, "-o", tmp_path / "face.glb", *options) == 0
    assert exit_code("export", source, "-o", tmp_path / "face.onnx") == 0
    rebuilt, glb = facepipe.open(stage), gltf_reader.read(tmp_path / "face.glb")
    deformer = Deformer(tmp_path / "face.onnx")
    assert np.array_equal(rebuilt.evaluate(), face.evaluate())
    for name, one in poses.items():
        expected = np.stack([face.evaluate(coefficients=pose) for pose in one.frames])
        assert difference(face, expected, face.evaluate()) > 0.01
        points = np.load(tmp_path / f"{name}.npz")["points"].reshape(expected.shape)
        assert difference(face, points, expected) < 1e-6
        for i, pose in enumerate(one.frames):
            transforms, _ = rebuilt.sample(name, i)
            assert difference(face, rebuilt.evaluate(joint_transforms=transforms), expected[i]) < 1e-6
            assert difference(face, deformer.evaluate(coefficients=pose)["points"], expected[i]) < TOLERANCE
            found = glb.pose(name, 0.0 if one.times is None else float(one.times[i]))
            in_glb = np.concatenate([found[mesh.name] for mesh in face.meshes]) / face.meters_per_unit
            used = np.isfinite(in_glb[:, 0])  # points of no face have no vertex
            assert used.mean() > 0.9
            assert difference(face, in_glb[used], expected[i][used]) < TOLERANCE


def test_the_writer_states_what_rounding_does_to_the_face(face: Face, tmp_path: Path) -> None:
    for precision, most in (("float16", 0.5), ("float32", 1e-4)):
        one = random_content(face, 2, precision)  # type: ignore[arg-type]
        report = write_payload(tmp_path / "x.fpb", one, face.rig())
        back = decode((tmp_path / "x.fpb").read_bytes(), one.joints, "x.fpb")
        moved = [
            np.linalg.norm(face.evaluate(coefficients=a) - face.evaluate(coefficients=b), axis=1).max()
            for a, b in zip(one.frames, back.frames, strict=True)
        ]
        assert report.error_mm == pytest.approx(max(moved) * face.mm_per_unit, rel=1e-9)
        assert 0 < report.error_mm < most
        assert report.bytes == (tmp_path / "x.fpb").stat().st_size
        again = write_payload(tmp_path / "y.fpb", one, face.rig())
        assert (tmp_path / "y.fpb").read_bytes() == (tmp_path / "x.fpb").read_bytes()
        assert again.error_mm == report.error_mm


def test_bytes_of_a_face_against_its_blendshape_data(tmp_path: Path) -> None:
    """MakeHuman's joints from the neck up that hold points, moved at random: a payload and deltas of the same shape."""
    one = Face.from_parts(makehuman_parts())
    joints = one.skeleton.joints
    moving = [i for i in weighted(one) if "/neck0" in joints[i]]
    assert (len(joints), len(moving)) == (77, 35)
    rng = np.random.default_rng(1)
    values = np.tile(REST, (len(joints), 1))
    values[moving] += rng.uniform(-1, 1, (len(moving), 9)) * ([10 / one.mm_per_unit] * 3 + [0.6] * 3 + [0.3] * 3)
    deltas = one.evaluate(coefficients=values) - one.evaluate()
    touched = int((np.linalg.norm(deltas, axis=1) * one.mm_per_unit > 1e-3).sum())
    dense, sparse = 12 * len(deltas), (4 + 12) * touched  # float32 x y z; with a uint32 point index each
    for precision in ("float16", "float32"):
        own = PayloadContent(
            joints=joints,
            coefficients=values,
            meters_per_unit=one.meters_per_unit,
            precision=precision,  # type: ignore[arg-type]
        )
        report = write_payload(tmp_path / "x.fpb", own, one.rig())
        print(
            f"{precision}: {report.bytes} bytes, {report.stored} of {report.joints} joints, {report.error_mm:.4f} mm; "
            f"deltas {dense} ({dense / report.bytes:.0f}x), sparse {sparse} of {touched} points "
            f"({sparse / report.bytes:.0f}x)"
        )
        assert min(dense, sparse) > 40 * report.bytes


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    save_parts(tiny_face(), tmp_path / "tiny.usda")
    return tmp_path / "tiny.usda"


def test_frames_without_times_are_poses(tiny: Path, tmp_path: Path) -> None:
    one = tiny_payload(tmp_path / "set.fpb", 3)
    assert exit_code("apply-bones", tiny, tmp_path / "set.fpb", "-o", tmp_path / "out.usda", "--name", "mine") == 0
    found = facepipe.open(tmp_path / "out.usda")
    assert [animation.name for animation in found.animations] == ["mine_1", "mine_2", "mine_3"]
    for animation, pose in zip(found.animations, one.frames, strict=True):
        assert animation.joints == ("root/jaw",)
        assert np.array_equal(animation.coefficients, pose[None, 1:2])


def test_the_result_is_a_layer_with_a_recipe_or_standalone(tiny: Path, tmp_path: Path) -> None:
    tiny_payload(tmp_path / "pose.fpb")
    before = tiny.read_bytes()
    assert exit_code("apply-bones", tiny, tmp_path / "pose.fpb", "-o", tmp_path / "over.usda") == 0
    assert exit_code("apply-bones", tiny, tmp_path / "pose.fpb", "-o", tmp_path / "alone.usda", "--flatten") == 0
    assert tiny.read_bytes() == before
    assert "@./tiny.usda@" in (tmp_path / "over.usda").read_text()
    assert "tiny.usda@" not in (tmp_path / "alone.usda").read_text()
    for name in ("over", "alone"):
        recipe = facepipe.open(tmp_path / f"{name}.usda").parts().recipe
        assert recipe is not None
        assert (recipe.verb, recipe.sources, recipe.options) == (
            "apply-bones",
            ("./tiny.usda", "./pose.fpb"),
            {"face": "./tiny.usda", "coefficients": "./pose.fpb", "name": None, "clamp": False},
        )
    assert exit_code("apply-bones", tiny, tmp_path / "pose.fpb", "-o", tmp_path / "twice.usda") == 0
    assert (tmp_path / "twice.usda").read_bytes() == (tmp_path / "over.usda").read_bytes()


def test_info_shows_what_a_payload_holds(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "clip.fpb"
    tiny_payload(path, 2, times=np.array([0.5, 2.0]), precision="float16")
    found = json.loads(done(capsys, "apply-bones", tiny, "--info", path, "--json"))
    assert (
        found
        | {
            "fits": True,
            "bytes": path.stat().st_size,
            "frames": 2,
            "joints": 3,
            "stored": 1,
            "precision": "float16",
            "meters_per_unit": 0.01,
            "rotation": 0.25,
            "scale": [1.0, 1.0],
            "times": [0.5, 2.0],
        }
        == found
    )
    assert "1 of 3 joints in float16" in done(capsys, "apply-bones", tiny, path, "--info")
    path.write_bytes(SMALL)
    code, out, _ = run(capsys, "apply-bones", tiny, path, "--info")
    assert (code, "is not for" in out) == (1, True)


def test_wrong_use_is_one_line_and_writes_nothing(
    tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, out = tmp_path / "good.fpb", tmp_path / "out.usda"
    tiny_payload(good)
    (tmp_path / "other.fpb").write_bytes(SMALL)
    (tmp_path / "cut.fpb").write_bytes(SMALL[:50])
    (tmp_path / "good.bin").write_bytes(good.read_bytes())
    tiny_payload(tmp_path / "metres.fpb", meters_per_unit=1.0)
    tiny_payload(tmp_path / "huge.fpb", scale=1e5)
    tiny_payload(tmp_path / "many.fpb", 5000)
    done(capsys, "apply-bones", tiny, good, "-o", tmp_path / "had.usda", quiet=False)
    for words, message in (
        ((tiny, tmp_path / "other.fpb", "-o", out), "made for other joints"),
        ((tiny, tmp_path / "cut.fpb", "-o", out), "bytes, expected"),
        ((tiny, tmp_path / "good.bin", "-o", out), "expected .fpb"),
        ((tiny, tmp_path / "none.fpb", "-o", out), "can't be read"),
        ((tiny, tmp_path / "metres.fpb", "-o", out), "translations in units of 1 m, expected 0.01 m"),
        ((tiny, tmp_path / "huge.fpb", "-o", out), "half precision"),
        ((tiny, tmp_path / "many.fpb", "-o", out), "5000 poses without times"),
        ((tmp_path / "had.usda", good, "-o", out), "has an animation 'good' already"),
        ((tiny, good, "-o", out, "--name", "a b"), "expected one like a_b"),
        ((tiny, good), "no output file"),
        ((tiny, good, "-o", good), "is an input"),
        ((tiny, good, "-o", tmp_path / "out.txt"), "suffix '.txt'"),
        ((tiny, good, "-o", tmp_path / "out.npz", "--name", "x"), "given with -o out.npz"),
        ((tiny, good, "--info", "-o", out), "given with --info"),
    ):
        assert message in failed(capsys, "apply-bones", *words, folder=tmp_path)
    assert exit_code("apply-bones", tiny, tmp_path / "huge.fpb", "-o", tmp_path / "huge.npz") == 0


def test_only_a_rigs_own_joints_are_written(tmp_path: Path) -> None:
    one = Face.from_parts(tiny_face())
    with pytest.raises(InputError, match="coefficients of other joints"):
        write_payload(tmp_path / "x.fpb", content(), one.rig())
    wrong = replace(tiny_payload(tmp_path / "y.fpb", scale=1e5), precision="float16")
    with pytest.raises(InputError, match=r"x\.fpb -> bone coefficients -> root/jaw -> scale y"):
        write_payload(tmp_path / "x.fpb", wrong, one.rig())
    with pytest.raises(InputError, match=r"expected \.fpb"):
        write_payload(tmp_path / "x.bin", wrong, one.rig())
    assert not list(tmp_path.glob("*x.*"))
    with pytest.raises(InputError, match="expected the 11 of the coefficients"):
        apply_bones(one, content(), "x")
