"""Performances on faces: what files hold, what becomes of it on a face, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import live_link
import numpy as np
import pytest
from boned_face import boned
from command_line import done, exit_code, failed, run
from facepipe_gltf.read.options import Options as GltfOptions
from faces import replace_mesh, tiny_face
from gltf_reader import read as read_gltf
from import_data import shared
from node import node_packages, three_play
from oracle import difference, played
from small_head import make as make_sample

import facepipe
from facepipe.importers import load
from facepipe.importers.ict import Options as IctOptions
from facepipe.parts import Animation, FaceParts, Slider
from facepipe.performing import perform
from facepipe.stage import save_parts
from facepipe.verbs.animate import Animate, Performance, read_performance

Capsys = pytest.CaptureFixture[str]
DEGREES = 180 / np.pi


@pytest.fixture(scope="session")
def head(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample head on disk; not to be changed."""
    path = tmp_path_factory.mktemp("sample") / "head.usda"
    save_parts(make_sample(0), path)
    return path


def table(path: Path, header: str, rows: np.ndarray, clock: Callable[[int], str] | None = None) -> Path:
    """A CSV of numbers, with a first column `clock` of each row."""
    cells = [[*([clock(i)] if clock else []), *(f"{value:.6f}" for value in row)] for i, row in enumerate(rows)]
    path.write_text("\n".join([header, *(",".join(cell) for cell in cells)]))
    return path


# ---- files


VALUES = live_link.performance(5, seed=3)
NAMES = list(live_link.COLUMNS)


def test_a_recording_in_any_order_and_case(tmp_path: Path) -> None:
    plain = read_performance(live_link.write(tmp_path / "a.csv", VALUES))
    assert plain.names == live_link.COLUMNS
    assert plain.fps == 60.0
    np.testing.assert_allclose(plain.values, VALUES, atol=1e-9)
    order = np.random.default_rng(1).permutation(len(NAMES))
    mixed = [NAMES[i].upper() if i % 2 else NAMES[i].lower() for i in order]
    other = read_performance(live_link.write(tmp_path / "b.csv", VALUES[:, order], columns=mixed))
    assert [name.lower() for name in other.names] == [NAMES[i].lower() for i in order]
    np.testing.assert_allclose(other.values, VALUES[:, order], atol=1e-9)


FORMS: dict[str, Callable[[Path, np.ndarray], Path]] = {
    "a row a frame": lambda folder, rows: table(folder / "a.csv", "jawOpen,browInnerUp,HeadYaw", rows),
    "timecode": lambda folder, rows: table(
        folder / "b.csv", "Timecode,jawOpen,browInnerUp,HeadYaw", rows, lambda i: live_link.timecode(i + 58, 60)
    ),
    "frames": lambda folder, rows: table(
        folder / "c.csv", "frame,jawOpen,browInnerUp,HeadYaw", rows, lambda i: str(100 + i)
    ),
    "seconds": lambda folder, rows: table(
        folder / "d.csv", "Time,jawOpen,browInnerUp,HeadYaw", rows, lambda i: f"{7 + i / 60:.6f}"
    ),
    "tabs": lambda folder, rows: _tabs(table(folder / "e.csv", "jawOpen,browInnerUp,HeadYaw", rows)),
    "json frames": lambda folder, rows: _json(
        folder / "a.json",
        [
            {"time": i / 60, "blendShapes": {"jawOpen": a, "browInnerUp": b}, "HeadYaw": c}
            for i, (a, b, c) in rows_of(rows)
        ],
    ),
    "json categories": lambda folder, rows: _json(
        folder / "b.json",
        {
            "fps": 60,
            "frames": [
                {"blendshapes": [{"categoryName": n, "score": v} for n, v in zip(SMALL, row, strict=True)]}
                for row in rows.tolist()
            ],
        },
    ),
    "json flat": lambda folder, rows: _json(
        folder / "c.json", [dict(zip(SMALL, row, strict=True)) for row in rows.tolist()]
    ),
    "json matrix": lambda folder, rows: _json(
        folder / "d.json", {"exportFps": 60.0, "facsNames": SMALL, "weightMat": rows.tolist(), "numFrames": len(rows)}
    ),
}
SMALL = ["jawOpen", "browInnerUp", "HeadYaw"]


def rows_of(rows: np.ndarray) -> list[tuple[int, list[float]]]:
    return list(enumerate(rows.tolist()))


def _tabs(path: Path) -> Path:
    path.write_text(path.read_text().replace(",", "\t"))
    return path


def _json(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("form", FORMS)
def test_every_form_says_the_same(form: str, tmp_path: Path) -> None:
    rows = np.round(np.random.default_rng(5).random((7, 3)), 6)
    found = read_performance(FORMS[form](tmp_path, rows))
    assert (found.names, found.fps, found.filled) == (tuple(SMALL), 60.0, 0)
    np.testing.assert_allclose(found.values, rows, atol=1e-9)
    turned = read_performance(FORMS[form](tmp_path, rows), angles="deg")
    np.testing.assert_allclose(turned.values, rows / [1, 1, DEGREES], atol=1e-9)


def test_missing_frames_lie_straight_between_others(tmp_path: Path) -> None:
    frames = [0, 1, 4, 5, 130, 131]  # over a full minute too: 11:59:58 and on
    values = live_link.performance(len(frames))
    found = read_performance(live_link.write(tmp_path / "take.csv", values, frames=frames))
    assert (len(found.values), found.filled, found.fps) == (132, 126, 60.0)
    np.testing.assert_allclose(found.values[frames], values, atol=1e-9)
    np.testing.assert_allclose(found.values[2], values[1] + (values[2] - values[1]) / 3, atol=1e-9)


def test_frames_without_a_face_are_missing_ones(tmp_path: Path) -> None:
    values = live_link.performance(4)
    lost = {4: f"{live_link.timecode(2, 60)},0"}
    found = read_performance(live_link.write(tmp_path / "take.csv", values, replaced=lost, sub=""))
    assert found.filled == 1
    np.testing.assert_allclose(found.values[2], (values[1] + values[3]) / 2, atol=1e-9)


def test_a_clock_that_counts_faster_than_frames_come(tmp_path: Path) -> None:
    """Recordings at 30 fps have a timecode of 60, of which they use every other frame."""
    values = live_link.performance(90)
    found = read_performance(live_link.write(tmp_path / "take.csv", values, frames=range(0, 180, 2)))
    assert (len(found.values), found.filled, found.fps) == (90, 0, 30.0)
    np.testing.assert_allclose(found.values, values, atol=1e-9)


def test_frames_beside_whole_ones_are_interpolated(tmp_path: Path) -> None:
    rows = np.arange(5.0)[:, None]
    clock = ["0", "1.25", "2.25", "3", "3"]
    path = table(tmp_path / "a.csv", "frame,jawOpen", rows, clock.__getitem__)
    found = read_performance(path)
    np.testing.assert_allclose(found.values[:, 0], [0, 0.8, 1.75, 4])  # of two rows at one time the last
    assert any("up to 0.25 of a frame" in line for line in found.warnings)
    assert any("1 frames have the time of the frame before" in line for line in found.warnings)


def test_midnight(tmp_path: Path) -> None:
    clock = ["23:59:59:58.5", "23:59:59:59.5", "00:00:00:00.5", "00:00:00:01.5"]
    path = table(tmp_path / "a.csv", "timecode,jawOpen", np.arange(4.0)[:, None], clock.__getitem__)
    assert read_performance(path).values[:, 0].tolist() == [0, 1, 2, 3]


def test_angles_do_not_turn_the_long_way_round(tmp_path: Path) -> None:
    rows = np.array([[3.1], [3.12], [-3.12], [-3.1]])
    path = table(tmp_path / "a.csv", "frame,HeadYaw", rows, ["0", "1", "3", "4"].__getitem__)
    np.testing.assert_allclose(
        read_performance(path).values[:, 0], [3.1, 3.12, np.pi, 2 * np.pi - 3.12, 2 * np.pi - 3.1], atol=1e-9
    )


def test_cut_and_resampled() -> None:
    whole = Performance(where="take", fps=60.0, names=("a",), values=np.arange(61.0)[:, None])
    part = whole.cut(0.5, 0.75)
    assert part.values[:, 0].tolist() == list(range(30, 46))
    assert part.seconds[0] == 0
    assert whole.at_rate(30.0).values[:, 0].tolist() == list(range(0, 61, 2))
    np.testing.assert_allclose(whole.at_rate(24.0).values[:, 0], np.arange(25) * 2.5)
    np.testing.assert_allclose(whole.at_rate(120.0).values[:, 0], np.arange(121) / 2)


# ---- faces


def test_the_clip_is_what_usdskel_plays(head: Path, tmp_path: Path) -> None:
    values = live_link.performance(12)
    out = tmp_path / "take.usda"
    report = perform(Animate(face=head, clip=live_link.write(tmp_path / "take 1.csv", values)), out).report
    assert (report.animation, report.frames, len(report.shapes)) == ("take_1", 12, 52)
    root = "root/neck/head"
    assert report.joints == {"Head": root, "LeftEye": f"{root}/eyeLeft", "RightEye": f"{root}/eyeRight"}
    assert not report.no_target
    face = facepipe.open(out)
    assert face.played == "take_1"
    clip = next(animation for animation in face.animations if animation.name == "take_1")
    assert clip.times is not None
    np.testing.assert_allclose(clip.times, np.arange(12) / 60, atol=1e-12)
    for index, points in enumerate(played(out, clip.times)):
        local, weights = face.sample("take_1", index)
        assert {name.lower(): weight for name, weight in weights.items()} == {
            name.lower(): np.float32(value) for name, value in zip(NAMES[:52], values[index, :52], strict=True)
        }
        assert difference(face, points, face.evaluate(weights, joint_transforms=local)) < 1e-5


def moved(parts: FaceParts, angles: dict[str, float], folder: Path, **options: str) -> dict[str, np.ndarray]:
    """Mean motion, Y up, of the points of head and eyes when a performance turns by `angles`."""
    path, out = folder / "face.usda", folder / "out.usda"
    save_parts(parts, path)
    clip = table(folder / "a.csv", ",".join(["jawOpen", *angles]), np.array([[0.0, *angles.values()]] * 2))
    perform(Animate(face=path, clip=clip, **options), out)  # type: ignore[arg-type]
    face = facepipe.open(out)
    local, weights = face.sample("a", 1)
    motion = face.evaluate(weights, joint_transforms=local) - face.evaluate()
    if parts.up_axis == "Z":
        motion = motion @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    owner = parts.meshes[0].skin.joint_indices[:, 0]  # type: ignore[union-attr]
    return {name: motion[owner == i].mean(axis=0) for i, name in ((1, "Head"), (2, "LeftEye"), (3, "RightEye"))}


@pytest.mark.parametrize("up", ["Y", "Z"])
@pytest.mark.parametrize("part", ["Head", "LeftEye", "RightEye"])
def test_turns_go_where_the_person_looked(part: str, up: str, tmp_path: Path) -> None:
    """Yaw to the own right (-X), pitch down: as the eyes of recordings look where their shapes say."""
    yaw, pitch = (moved(boned(up), {f"{part}{angle}": 0.2}, tmp_path)[part] for angle in ("Yaw", "Pitch"))
    assert yaw[0] < -0.1
    assert abs(yaw[1]) < 0.05
    assert pitch[1] < -0.1
    assert abs(pitch[0]) < 0.05


def test_roll_leans_to_the_left_shoulder(tmp_path: Path) -> None:
    assert moved(boned(), {"HeadRoll": 0.2}, tmp_path)["LeftEye"][0] > 0.1  # above the joint, to +X


def test_yaw_and_pitch_together_are_those_of_a_look_without_roll(tmp_path: Path) -> None:
    """Recorded eyes roll by yaw times pitch: they turn by the yaw within what the pitch turns."""
    parts = boned()
    one = moved(parts, {"LeftEyeYaw": 0.2, "LeftEyePitch": 0.15, "LeftEyeRoll": 0.03}, tmp_path)["LeftEye"]
    owner = parts.meshes[0].skin.joint_indices[:, 0]  # type: ignore[union-attr]
    x, y, z = parts.meshes[0].points[owner == 2].mean(axis=0) - (2, 8, 4)
    x, z = x * np.cos(0.2) - z * np.sin(0.2), x * np.sin(0.2) + z * np.cos(0.2)
    y, z = y * np.cos(0.15) - z * np.sin(0.15), y * np.sin(0.15) + z * np.cos(0.15)
    still = parts.meshes[0].points[owner == 2].mean(axis=0) - (2, 8, 4)
    np.testing.assert_allclose(one, np.array([x, y, z]) - still, atol=1e-2)  # 0.03 without the roll


def test_eyes_turn_once(tmp_path: Path) -> None:
    """Where a shape of the clip moves the eye the joint stays, unless it is asked for."""
    parts, angles = boned(eye_shapes=True), {"LeftEyeYaw": 0.2, "RightEyeYaw": 0.2, "eyeLookUpLeft": 0.0}
    motion = moved(parts, angles, tmp_path)
    assert np.abs(motion["LeftEye"]).max() < 1e-6
    assert motion["RightEye"][0] < -0.1
    assert moved(parts, angles, tmp_path, left_eye="EYE_L", right_eye="none")["LeftEye"][0] < -0.1


def test_names_of_another_convention_and_of_both_sides(tmp_path: Path) -> None:
    parts = tiny_face()
    head = parts.meshes[0]
    names = ("jaw_open", "mouthSmile_L")
    shapes = tuple(replace(one, name=name) for one, name in zip(head.blendshapes, names, strict=True))
    right = replace(shapes[1], name="mouthSmile_R")
    path, out = tmp_path / "face.usda", tmp_path / "out.usda"
    save_parts(replace(parts, meshes=(replace_mesh(head, blendshapes=(*shapes, right)),)), path)
    clip = table(tmp_path / "a.csv", "JawOpen,mouthSmile,tongueOut", np.array([[0.25, 0.5, 1.0]] * 2))
    report = perform(Animate(face=path, clip=clip), out).report
    assert facepipe.open(out).sample("a", 1)[1] == {"jaw_open": 0.25, "mouthSmile_L": 0.5, "mouthSmile_R": 0.5}
    assert report.renamed == {"JawOpen": "jaw_open", "mouthSmile": "mouthSmile_L, mouthSmile_R"}
    assert report.no_target == {"tongueOut": "no such shape"}


def slid() -> FaceParts:
    """A face whose sliders nod its head and smile, and turn its left eye."""
    nod = Slider(
        name="jaw_drop",
        channels=(("spine/Head", "rx", 0.4), ("spine/Head", "sy", 0.2)),
        channel_curves=(((0.0, 0.0), (0.5, 0.8), (1.0, 1.0)), None),
        shapes=(("mouthSmileLeft", 0.5),),
    )
    look = Slider(name="eyeLookUp_L", minimum=-1.0, maximum=2.0, channels=(("spine/Head/eye_L", "ry", 0.3),))
    return replace(boned(), sliders=(nod, look, Slider(name="other", value=0.5)))


def test_what_no_shape_means_moves_sliders(tmp_path: Path) -> None:
    path, out = tmp_path / "face.usda", tmp_path / "out.usda"
    save_parts(slid(), path)
    rows = np.random.default_rng(2).random((4, 3))
    named = np.column_stack([rows, rows[:, 0]])
    clip = table(tmp_path / "a.csv", "JawDrop,eyeLookUpLeft,mouthSmileLeft,tongueOut", named)
    report = perform(Animate(face=path, clip=clip), out).report
    assert report.no_target == {"tongueOut": "no such shape or slider"}
    assert (report.sliders, report.shapes) == (("jaw_drop", "eyeLookUp_L"), ("mouthSmileLeft",))
    face = facepipe.open(out)
    for index, (drop, look, smile) in enumerate(rows):
        local, weights = face.sample("a", index)
        values = {"jaw_drop": drop, "eyeLookUp_L": 2 * look, "other": 0.0}
        expected = face.evaluate({"mouthSmileLeft": smile}, sliders=values)
        assert difference(face, face.evaluate(weights, joint_transforms=local), expected) < 1e-6


def test_a_joint_that_a_slider_moves_turns_with_the_head_and_an_eye_not_twice(tmp_path: Path) -> None:
    path = tmp_path / "face.usda"
    save_parts(slid(), path)
    local = {}
    for name, header in (
        ("turn", "HeadYaw"),
        ("nod", "jaw_drop"),
        ("both", "HeadYaw,jaw_drop,eyeLookUpLeft,LeftEyeYaw"),
    ):
        rows = np.array([[0.3, 1.0, 0.0, 0.2] if name == "both" else [0.3 if name == "turn" else 1.0]] * 2)
        clip, out = table(tmp_path / f"{name}.csv", header, rows), tmp_path / f"{name}.usda"
        report = perform(Animate(face=path, clip=clip), out).report
        local[name] = facepipe.open(out).sample(name, 1)[0][1]
    assert report.no_target == {"LeftEyeYaw": "eyeLookUp_L and its like turn this eye"}
    rest = boned().skeleton.rest_transforms[1]
    expected = local["turn"] @ np.linalg.inv(rest) @ local["nod"]
    np.testing.assert_allclose(local["both"], expected, atol=1e-6)


def test_trim_resample_and_offset(tmp_path: Path) -> None:
    path, out = tmp_path / "face.usda", tmp_path / "out.usda"
    save_parts(tiny_face(), path)
    clip = table(tmp_path / "a.csv", "jawOpen", np.arange(121.0)[:, None] / 120)
    animate = Animate(face=path, clip=clip, name="part", start=0.5, end=1.5, resample=24.0, offset=2.0)
    report = perform(animate, out).report
    assert (report.frames, report.start, report.end, report.frames_per_second) == (25, 2.0, 3.0, 24.0)
    face = facepipe.open(out)
    assert face.animations[-1].name == "part"
    assert face.animations[-1].times is not None
    np.testing.assert_allclose(face.animations[-1].times, 2 + np.arange(25) / 24)
    assert face.animations[-1].shape_weights is not None
    np.testing.assert_allclose(face.animations[-1].shape_weights[:, 0], 0.25 + np.arange(25) / 48, atol=1e-6)


# ---- the command


def test_the_command(tmp_path: Path, capsys: Capsys) -> None:
    clip, out = live_link.write(tmp_path / "take.csv", live_link.performance(3)), tmp_path / "out.usda"
    head = tmp_path / "face.usda"
    save_parts(boned(eye_shapes=True), head)
    text = done(capsys, "animate", head, clip, "-o", out)
    assert "take: 3 frames, 0 to 0.0333333 s at 60 fps: 3 shapes, Head by Head, RightEye by eye_R" in text
    assert "no target: LeftEyeYaw, LeftEyePitch, LeftEyeRoll (eyeLookUpLeft and its like turn this eye)" in text
    text = done(capsys, "animate", head, clip, "-o", out, "--force", "--json", "--left-eye", "eye_l")
    eyes = {"LeftEye": "spine/Head/eye_L", "RightEye": "spine/Head/eye_R"}
    assert json.loads(text)["joints"] == {"Head": "spine/Head", **eyes}
    assert run(capsys, "animate", head, clip, "-o", out)[0] == 2  # exists


def drop(*names: str) -> Callable[[Path], Path]:
    def put(folder: Path) -> Path:
        kept = [i for i, name in enumerate(NAMES) if name not in names]
        return live_link.write(folder / "a.csv", VALUES[:, kept], columns=[NAMES[i] for i in kept])

    return put


def text(content: str, name: str = "a.csv") -> Callable[[Path], Path]:
    def put(folder: Path) -> Path:
        (folder / name).write_text(content)
        return folder / name

    return put


def long(fps: int) -> Callable[[Path], Path]:
    return lambda folder: live_link.write(folder / "a.csv", live_link.performance(4 * fps), fps=fps)


BAD: dict[str, tuple[Callable[[Path], Path], tuple[str, ...], str]] = {
    "NaN": (text("jawOpen,browUp\n0.5,0.1\nnan,0.1\n"), (), "line 3: jawOpen 'nan', expected a number"),
    "infinity": (text("jawOpen\n0.5\n1e999\n"), (), "line 3: jawOpen '1e999', expected a number"),
    "huge": (text("jawOpen\n0.5\n1e30\n"), (), "line 3: jawOpen '1e30', expected a number"),
    "huge in json": (text('{"fps": 1' + "0" * 400 + ', "frames": []}', "a.json"), (), "a.json -> fps: 1000000"),
    "text": (text("jawOpen\n0.5\nopen\n"), (), "line 3: jawOpen 'open', expected a number"),
    "short line": (text("jawOpen,a\n0.5,1\n0.5\n"), (), "line 3: 1 cells, expected 2"),
    "no header": (text("0.5,0.1\n0.6,0.2\n"), (), "line 1: '0.5', expected a header of names"),
    "no frames": (text("jawOpen\n"), (), "1 lines, expected a header and frames"),
    "empty": (text(""), (), "0 lines, expected a header and frames"),
    "not text": (lambda f: (f / "a.csv").write_bytes(b"\xff\xfe\x00") and f / "a.csv", (), "is not UTF-8"),
    "a name twice": (text("jawOpen,jawOpen\n0,1\n0,1\n"), (), "'jawOpen' twice, expected each name once"),
    "30 fps at 60": (
        long(30),
        ("--fps", "60"),
        "frames 0 to 29 in every second, expected up to 59 at 60 fps (--fps 30?)",
    ),
    "60 fps at 30": (long(60), ("--fps", "30"), "frame 30 of a second, expected 0 to 29 at 30 fps"),
    "backwards": (text("frame,jawOpen\n5,0\n4,0\n"), (), "line 3: is before the frame above it"),
    "timecode": (text("timecode,jawOpen\n12:00,0\n"), (), "line 2: timecode '12:00', expected HH:MM:SS:FF"),
    "too long": (text("frame,jawOpen\n0,0\n1,0\n99999999,0\n"), (), "100000000 frames with those that are missing"),
    "another face": (
        text("browFlash,earLeft\n0,1\n0,1\n"),
        (),
        "none of its shapes and sliders is among the 2 names ('browFlash'",
    ),
    "nothing left": (text("jawOpen\n0\n1\n"), ("--start", "5"), "nothing from 5 s on, expected some of its 0.0166"),
    "no such joint": (text("jawOpen,HeadYaw\n0,1\n1,1\n"), ("--head", "haed"), "did you mean 'Head'?"),
    "out of range": (text("jawOpen\n0\n1\n"), ("--resample", "0"), "option resample"),
    "bad name": (text("jawOpen\n0\n1\n"), ("--name", "a b"), "no name of a prim, expected one like a_b"),
    "suffix": (text("jawOpen\n0\n1\n", "a.bvh"), (), "suffix '.bvh', expected one of .csv .tsv .txt .json"),
    "json": (text("{", "a.json"), (), "is not JSON"),
    "json form": (text('{"clip": 1}', "a.json"), (), "another form, expected a list of frames"),
    "json value": (text('[{"jawOpen": "x"}]', "a.json"), (), "frame 1 -> jawOpen: x, expected a number"),
    "json names": (text('[{"jawOpen": 1}, {"jaw": 1}]', "a.json"), (), "frame 1: no 'jaw', expected the 2 names"),
    "json row": (text('{"names": ["a", "b"], "values": [[1]]}', "a.json"), (), "frame 1: 1 weights, expected 2"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line_and_nothing_is_written(name: str, tmp_path: Path, capsys: Capsys) -> None:
    put, options, expected = BAD[name]
    save_parts(boned(), tmp_path / "face.usda")
    clip = put(tmp_path)
    error = failed(
        capsys, "animate", tmp_path / "face.usda", clip, "-o", tmp_path / "out.usda", *options, folder=tmp_path
    )
    assert expected in error


def test_a_clip_is_not_overwritten_by_what_is_written_with_a_result(tmp_path: Path, capsys: Capsys) -> None:
    clip, face = text('[{"jawOpen": 1}, {"jawOpen": 0}]', "take.onnx.json")(tmp_path), tmp_path / "face.usda"
    save_parts(boned(), face)
    error = failed(capsys, "animate", face, clip, "-o", tmp_path / "take.onnx", "--force", folder=tmp_path)
    assert "take.onnx.json: is an input, expected another output file" in error


def test_a_name_that_is_taken(tmp_path: Path, capsys: Capsys) -> None:
    clip, face = text("jawOpen\n0\n1\n")(tmp_path), tmp_path / "face.usda"
    save_parts(
        replace(tiny_face(), animations=(Animation(name="talk", shapes=("jawOpen",), shape_weights=[[1]]),)), face
    )
    error = failed(capsys, "animate", face, clip, "-o", tmp_path / "out.usda", "--name", "talk", folder=tmp_path)
    assert "has an animation 'talk' already" in error


# ---- in the engine


def three_agrees(path: Path, frames: list[int], folder: Path) -> float:
    """Largest distance of what three.js shows of the GLB from `Face.evaluate`, in head heights."""
    face = facepipe.open(path)
    assert face.played is not None
    glb = folder / "take.glb"
    assert exit_code("export", path, "-o", glb, "--animations") == 0
    clip = next(animation for animation in face.animations if animation.name == face.played)
    assert clip.times is not None
    answer, shown = three_play(glb, face.played, [float(clip.times[i]) for i in frames], folder / "shown.bin")
    document = read_gltf(glb).json
    order = [mesh["name"] for mesh in document["meshes"] for _ in mesh["primitives"]]
    worst = 0.0
    for frame, row in zip(frames, shown, strict=True):
        local, weights = face.sample(face.played, frame)
        points = face.split(face.evaluate(weights, joint_transforms=local) * face.meters_per_unit)
        pairs = zip(order, answer["meshes"], strict=True)
        expected = np.concatenate([points[name][np.array(mesh["points"], int)] for name, mesh in pairs])
        worst = max(worst, float(np.linalg.norm(row - expected, axis=1).max()))
    return worst / (face.head_height * face.meters_per_unit)


def test_a_short_recording_plays_in_three_js(head: Path, tmp_path: Path) -> None:
    node_packages()
    clip, out = live_link.write(tmp_path / "take.csv", live_link.performance(90)), tmp_path / "out.usda"
    perform(Animate(face=head, clip=clip), out)
    assert three_agrees(out, [0, 1, 41, 89], tmp_path) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sample", "ict"])
def test_a_minute_plays_in_three_js(name: str, head: Path, tmp_path: Path) -> None:
    node_packages()
    face, out = tmp_path / "ict.usdc", tmp_path / "out.usdc"
    if name == "ict":
        save_parts(load("ict", shared("ict_facekit/ict_facekit.npz"), IctOptions()).parts, face)
    clip = live_link.write(tmp_path / "take.csv", live_link.performance(3600))
    report = perform(Animate(face=face if name == "ict" else head, clip=clip), out).report
    assert (report.frames, report.end) == (3600, 3599 / 60)
    assert len(report.shapes) == (53 if name == "ict" else 52)
    assert three_agrees(out, [*range(0, 3600, 97), 3599], tmp_path) < 1e-5


def test_a_long_clip_in_our_glb_comes_back_exactly(head: Path, tmp_path: Path) -> None:
    """Inbetweens put keys of their own beside those of frames; far from 0 these are near in float32."""
    clip, out = live_link.write(tmp_path / "take.csv", live_link.performance(240)), tmp_path / "out.usda"
    perform(Animate(face=head, clip=clip, offset=60.0), out)
    assert exit_code("export", out, "-o", tmp_path / "take.glb", "--animations") == 0
    imported = load("gltf", tmp_path / "take.glb", GltfOptions())
    assert not any("differently" in line for line in imported.warnings)
    assert imported.parts.played == "take"
    before = next(animation for animation in facepipe.open(out).animations if animation.name == "take")
    after = next(animation for animation in imported.parts.animations if animation.name == "take")
    assert after.times is not None
    assert after.shape_weights is not None
    assert before.times is not None
    np.testing.assert_allclose(after.times, before.times, atol=1e-9)
    assert np.array_equal(after.shape_weights, before.shape_weights)


def test_of_many_names_without_target_the_first_are_likened(tmp_path: Path) -> None:
    save_parts(tiny_face(), tmp_path / "face.usda")
    names = ["jawOpen", *(f"mouthSmileLef{i}" for i in range(300))]
    (tmp_path / "take.csv").write_text(",".join(names) + "\n" + ",".join(["0.5"] * len(names)) + "\n")
    report = perform(Animate(face=tmp_path / "face.usda", clip=tmp_path / "take.csv"), tmp_path / "out.usda").report
    reasons = [*report.no_target.values()]
    assert (reasons[99], reasons[100]) == ("no such shape, did you mean 'mouthSmileLeft'?", "no such shape")
    assert len(reasons) == 300
