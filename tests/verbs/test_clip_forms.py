"""Forms of captured clips: each is written here after what its tool writes, and must be read as what was captured."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import live_link
import numpy as np
import pytest
from boned_face import boned
from command_line import done
from faces import replace_mesh, tiny_face
from scipy.spatial.transform import Rotation

import facepipe
from facepipe.core.errors import InputError
from facepipe.parts import Animation
from facepipe.performing import perform
from facepipe.rig.bone_coefficients import rest_coefficients
from facepipe.rig.visemes import AZURE_VISEMES, OCULUS_VISEMES
from facepipe.stage import save_parts
from facepipe.verbs.animate import Animate, read_performance

Capsys = pytest.CaptureFixture[str]
SHAPES = [name[0].lower() + name[1:] for name in live_link.COLUMNS[:52]]
TURNS = list(live_link.ANGLES)
FRAMES = 41


def captured(frames: int = FRAMES, seed: int = 0) -> np.ndarray:
    """(frames, 61) weights and turns."""
    return live_link.performance(frames, seed)


def rows(
    path: Path, header: Sequence[str], clocks: Sequence[Sequence[object]], values: np.ndarray, delimiter: str = ","
) -> Path:
    """A table: `clocks` before, then values with 6 digits."""
    lines = [delimiter.join(header)]
    for clock, row in zip(clocks, values, strict=True):
        lines.append(delimiter.join([*map(str, clock), *(f"{value:.6f}" for value in row)]))
    path.write_text("\n".join(lines) + "\n")
    return path


def document(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def pascal(names: Sequence[str]) -> list[str]:
    return [name[0].upper() + name[1:] for name in names]


def live(
    folder: Path, values: np.ndarray, codes: Sequence[str], shapes: Sequence[str] = SHAPES, turns: Sequence[str] = TURNS
) -> Path:
    """A recording of Live Link Face with these timecodes and columns."""
    names = [*shapes, *turns]
    chosen = values[:, [[*SHAPES, *TURNS].index(name) for name in names]]
    header = ["Timecode", "BlendShapeCount", *pascal(names)]
    return rows(folder / "take.csv", header, [[code, len(names)] for code in codes], chosen)


def codes(fps: int, first: int = 0, count: int = FRAMES) -> list[str]:
    return [live_link.timecode(first + frame, fps, ".250") for frame in range(count)]


def drop_frame(frame: int) -> str:
    """The label of a frame of 29.97 a second: 2 are left out in each minute but every tenth (SMPTE ST 12-1)."""
    tens, left = divmod(frame, 17982)
    if left >= 1800:
        frame += 2 * (1 + (left - 1800) // 1798)
    frame += 18 * tens
    return f"{frame // 108000:02}:{frame // 1800 % 60:02}:{frame // 30 % 60:02};{frame % 30:02}"


def excel(folder: Path, values: np.ndarray) -> Path:
    """Decimal commas between semicolons, in UTF-16, as spreadsheets of half of Europe write it."""
    path = rows(
        folder / "take.csv", ["Time", *SHAPES, *TURNS], [[f"{i / 30:.6f}"] for i in range(len(values))], values, ";"
    )
    path.write_text("sep=;\n" + path.read_text().replace(".", ","), encoding="utf-16")
    return path


def categories(row: np.ndarray) -> list[dict[str, object]]:
    named = zip(["_neutral", *SHAPES], [1e-6, *row.tolist()], strict=True)
    return [
        {"index": i, "score": value, "categoryName": name, "displayName": ""} for i, (name, value) in enumerate(named)
    ]


def matrix(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """A head before the camera: it turns about its own Y to its right, nods down, and leans to its left."""
    placed = np.eye(4)
    placed[:3, :3] = Rotation.from_euler("YXZ", [-yaw, pitch, -roll]).as_matrix()
    placed[:3, 3] = (1.5, -2.0, -30.0)
    return placed


def media_pipe(folder: Path, values: np.ndarray, times: bool = True) -> Path:
    """What JSON.stringify makes of FaceLandmarkerResult; data by columns, as its task for the web has them."""
    frames = [
        {
            "faceLandmarks": [[]],
            "faceBlendshapes": [{"categories": categories(row[:52]), "headIndex": -1, "headName": ""}],
            "facialTransformationMatrixes": [{"rows": 4, "columns": 4, "data": matrix(*row[52:55]).T.ravel().tolist()}],
            **({"timestampMs": round(5000 + i * 1000 / 30)} if times else {}),
        }
        for i, row in enumerate(values)
    ]
    return document(folder / "take.json", frames)


def media_pipe_python(folder: Path, values: np.ndarray) -> Path:
    frames = [
        {
            "face_blendshapes": [
                [{"category_name": n, "score": v} for n, v in zip(SHAPES, row[:52].tolist(), strict=True)]
            ],
            "facial_transformation_matrixes": [matrix(*row[52:55]).tolist()],
            "timestamp_ms": i * 40,
        }
        for i, row in enumerate(values)
    ]
    (folder / "take.jsonl").write_text("\n".join(map(json.dumps, frames)))
    return folder / "take.jsonl"


# as Microsoft's page on visemes lists them
AZURE_ORDER = """
eyeBlinkLeft eyeLookDownLeft eyeLookInLeft eyeLookOutLeft eyeLookUpLeft eyeSquintLeft eyeWideLeft
eyeBlinkRight eyeLookDownRight eyeLookInRight eyeLookOutRight eyeLookUpRight eyeSquintRight eyeWideRight
jawForward jawLeft jawRight jawOpen mouthClose mouthFunnel mouthPucker mouthLeft mouthRight mouthSmileLeft
mouthSmileRight mouthFrownLeft mouthFrownRight mouthDimpleLeft mouthDimpleRight mouthStretchLeft mouthStretchRight
mouthRollLower mouthRollUpper mouthShrugLower mouthShrugUpper mouthPressLeft mouthPressRight mouthLowerDownLeft
mouthLowerDownRight mouthUpperUpLeft mouthUpperUpRight browDownLeft browDownRight browInnerUp browOuterUpLeft
browOuterUpRight cheekPuff cheekSquintLeft cheekSquintRight noseSneerLeft noseSneerRight tongueOut
HeadRoll LeftEyeRoll RightEyeRoll
"""
AZURE = AZURE_ORDER.split()


def azure(folder: Path, values: np.ndarray) -> Path:
    """Chunks as the events of the Speech SDK bring them, the second before the first."""
    order = [[*SHAPES, *TURNS].index(name) for name in AZURE]
    table = values[:, order]
    cuts = [(20, len(values)), (0, 20)]
    events = [
        {
            "audioOffset": 0,
            "visemeId": 0,
            "animation": json.dumps({"FrameIndex": a, "BlendShapes": table[a:b].tolist()}),
        }
        for a, b in cuts
    ]
    return document(folder / "take.json", events)


def stage(folder: Path, values: np.ndarray, suffix: str = ".usda") -> Path:
    """A SkelAnimation alone, as Audio2Face exports it."""
    samples = ",\n".join(f"        {i}: [{', '.join(f'{v:.6f}' for v in row[:52])}]" for i, row in enumerate(values))
    path = folder / f"take{suffix}"
    path.write_text(
        '#usda 1.0\n(\n    defaultPrim = "World"\n    timeCodesPerSecond = 30\n)\n'
        'def SkelAnimation "World"\n{\n'
        f"    uniform token[] blendShapes = {json.dumps(SHAPES)}\n"
        f"    float[] blendShapeWeights.timeSamples = {{\n{samples}\n    }}\n    uniform token[] joints = []\n}}\n"
    )
    return path


WEIGHTS, ALL, HEAD = SHAPES, [*SHAPES, *TURNS], [*SHAPES, *TURNS[:3]]
# name of the form as the line says it: (writer, frames per second, what it holds)
FORMS: dict[str, tuple[str, Callable[[Path, np.ndarray], Path], float, Sequence[str]]] = {
    "61 columns": ("Live Link Face", lambda f, v: live(f, v, codes(60)), 60, ALL),
    "52 columns": ("Live Link Face", lambda f, v: live(f, v, codes(60), turns=()), 60, WEIGHTS),
    "51 columns": ("Live Link Face", lambda f, v: live(f, v, codes(60), SHAPES[:-1], ()), 60, SHAPES[:-1]),
    "no eye columns": ("Live Link Face", lambda f, v: live(f, v, codes(60), turns=TURNS[:3]), 60, HEAD),
    "30 fps": ("Live Link Face", lambda f, v: live(f, v, codes(30)), 30, ALL),
    "24 fps": ("Live Link Face", lambda f, v: live(f, v, codes(24, 11)), 24, ALL),
    "drop frame": (
        "Live Link Face",
        lambda f, v: live(f, v, [drop_frame(1780 + i) for i in range(FRAMES)]),
        30000 / 1001,
        ALL,
    ),
    "milliseconds": (
        "Live Link Face",
        lambda f, v: live(f, v, [f"12:00:{i // 30:02}:{round(i % 30 * 1000 / 30):03}.{i:03}" for i in range(FRAMES)]),
        30,
        ALL,
    ),
    "times of day": (
        "Live Link Face",
        lambda f, v: live(f, v, [f"23:59:{59 + i // 60}.{i * 1000 // 60 % 1000:03}" for i in range(FRAMES)]),
        60,
        ALL,
    ),
    "audio2face csv": (
        "Audio2Face table",
        lambda f, v: rows(
            f / "take.csv",
            ["", "timeCode", *(f"blendShapes.{name}" for name in pascal(SHAPES))],
            [[i, i / 30] for i in range(len(v))],
            v[:, :52],
        ),
        30,
        [f"blendShapes.{name}" for name in pascal(SHAPES)],
    ),
    "audio2face json": (
        "Audio2Face",
        lambda f, v: document(
            f / "take.json",
            {"exportFps": 60.0, "numFrames": len(v), "facsNames": SHAPES, "weightMat": v[:, :52].tolist()},
        ),
        60,
        WEIGHTS,
    ),
    "audio2face usd": ("clip 'World' of a stage", stage, 30, WEIGHTS),
    "mediapipe csv": (
        "table of ARKit shapes",
        lambda f, v: rows(
            f / "take.csv",
            ["frame", "timestamp_ms", *SHAPES],
            [[i, round(i * 1000 / 30)] for i in range(len(v))],
            v[:, :52],
        ),
        30,
        WEIGHTS,
    ),
    "mediapipe json": ("MediaPipe face landmarker", media_pipe, 30, HEAD),
    "mediapipe json without times": (
        "MediaPipe face landmarker",
        lambda f, v: media_pipe(f, v, times=False),
        30,
        HEAD,
    ),
    "mediapipe json lines": ("MediaPipe face landmarker", media_pipe_python, 25, HEAD),
    "azure blendshapes": ("Azure blendshapes", azure, 60, AZURE),
    "talkinghead": (
        "TalkingHead",
        lambda f, v: document(
            f / "take.json", {"name": "x", "dt": [40] * len(v), "vs": dict(zip(SHAPES, v.T.tolist(), strict=False))}
        ),
        25,
        WEIGHTS,
    ),
    "unreal curves": (
        "table",
        lambda f, v: rows(
            f / "take.csv",
            ["Frame", *(f"CTRL_expressions_{name}" for name in SHAPES[:20])],
            [[i] for i in range(len(v))],
            v[:, :20],
        ),
        60,
        [f"CTRL_expressions_{name}" for name in SHAPES[:20]],
    ),
    "a spreadsheet": ("table of ARKit shapes", excel, 30, ALL),
    "bars": (
        "table of ARKit shapes",
        lambda f, v: rows(f / "take.txt", ["Seconds", *ALL], [[f"{i / 50:.3f}"] for i in range(len(v))], v, "|"),
        50,
        ALL,
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_form_is_found_out_and_read(form: str, tmp_path: Path) -> None:
    called, write, fps, names = FORMS[form]
    values = captured()
    found = read_performance(write(tmp_path, values))
    assert found.read_as.startswith(f"{called}: ")
    np.testing.assert_allclose(found.fps, fps, rtol=1e-9)
    assert (len(found.values), found.filled, found.warnings) == (FRAMES, 0, ())
    keys = {name.casefold(): i for i, name in enumerate([*SHAPES, *TURNS])}
    assert [name.casefold() for name in found.names] == [name.casefold() for name in names]
    order = [keys[name.casefold().rpartition(".")[2].removeprefix("ctrl_expressions_")] for name in names]
    np.testing.assert_allclose(found.values, values[:, order], atol=2e-6)


def test_drop_frame_over_many_minutes_keeps_the_time() -> None:
    """Ten minutes of drop frame are 17,982 frames, whose labels end at 00:10:00;00."""
    assert drop_frame(1799) == "00:00:59;29"
    assert drop_frame(1800) == "00:01:00;02"
    assert drop_frame(17982) == "00:10:00;00"


@pytest.mark.parametrize("first", [0, 1790, 17975, 107880])
def test_drop_frame_labels_follow_each_other(first: int, tmp_path: Path) -> None:
    found = read_performance(live(tmp_path, captured(), [drop_frame(first + i) for i in range(FRAMES)]))
    assert (len(found.values), found.filled) == (FRAMES, 0)


def test_lost_tracking_is_filled(tmp_path: Path) -> None:
    values = captured()
    path = live(tmp_path, values, codes(60))
    lines = path.read_text().splitlines()
    for number in (11, 12):  # frames 10 and 11
        head = lines[number].split(",")[:2]
        lines[number] = ",".join([*head, *[""] * 61])
    cells = lines[21].split(",")
    lines[21] = ",".join([*cells[:2], "", *cells[3:]])  # one value of frame 20
    path.write_text("\n".join(lines))
    found = read_performance(path)
    assert (found.filled, found.warnings) == (2, ())
    assert "1 frames with values that were not tracked" in found.read_as
    expected = values.copy()
    expected[10], expected[11] = values[9] + (values[12] - values[9]) / 3, values[9] + (values[12] - values[9]) * 2 / 3
    expected[20, 0] = (values[19, 0] + values[21, 0]) / 2
    np.testing.assert_allclose(found.values, expected, atol=1e-9)


def test_frames_in_which_media_pipe_saw_no_face(tmp_path: Path) -> None:
    path = media_pipe(tmp_path, captured())
    frames = json.loads(path.read_text())
    frames[7] |= {"faceBlendshapes": [], "facialTransformationMatrixes": []}
    found = read_performance(document(path, frames))
    assert (len(found.values), found.filled) == (FRAMES, 1)


def test_degrees_percent_and_clocks_are_found_out(tmp_path: Path) -> None:
    values = captured()
    turned = values.copy()
    turned[:, 52:] *= 180 / np.pi
    found = read_performance(live(tmp_path, turned, codes(60)))
    assert "turns in degrees" in found.read_as
    np.testing.assert_allclose(found.values, values, atol=1e-6)
    percent = values.copy()
    percent[:, :52] *= 100
    found = read_performance(live(tmp_path, percent, codes(60)))
    assert "weights in percent" in found.read_as
    np.testing.assert_allclose(found.values, values, atol=1e-6)
    for name, scale in (("Time", 1e3), ("timestamp", 1e6), ("time_us", 1e6), ("timestamp_ns", 1e9), ("Time", 1.0)):
        clock = [[f"{round((7 + i / 30) * scale, 6):.6f}"] for i in range(FRAMES)]
        found = read_performance(rows(tmp_path / "a.csv", [name, *SHAPES], clock, values[:, :52]))
        assert (found.fps, len(found.values)) == (30.0, FRAMES), name


def test_radians_stay_what_they_are(tmp_path: Path) -> None:
    values = captured()
    found = read_performance(live(tmp_path, values, codes(60)), angles="rad")
    assert np.array_equal(found.values, read_performance(tmp_path / "take.csv").values)
    turned = values.copy()
    turned[:, 52] = 15.0
    found = read_performance(live(tmp_path, turned, codes(60)), angles="rad")
    assert any("15 radians, 2.4 times round: --angles deg?" in line for line in found.warnings)


BAD: dict[str, tuple[Callable[[Path, np.ndarray], Path], str]] = {
    "weights up to 255": (
        lambda f, v: rows(f / "a.csv", SHAPES, [[]] * len(v), v[:, :52] * 255),
        "expected weights from 0 to 1, or percent",
    ),
    "one wild value": (
        lambda f, v: rows(f / "a.csv", SHAPES, [[]] * len(v), np.where(np.arange(52) == 3, 50.0, v[:, :52])),
        "up to 50, expected weights from 0 to 1, or percent",
    ),
    "percent of a faint clip": (
        lambda f, v: rows(f / "a.csv", SHAPES, [[]] * len(v), v[:, :52] * 9),
        "expected weights from 0 to 1, or percent",
    ),
    "a clock of no unit": (
        lambda f, v: rows(f / "a.csv", ["time", *SHAPES], [[i * 700] for i in range(len(v))], v[:, :52]),
        "'time' in steps of 700, expected seconds",
    ),
    "a viseme id of no sound": (
        lambda f, _: document(f / "a.json", [{"visemeId": 22, "audioOffset": 0}]),
        "expected 0 to 21",
    ),
    "54 numbers": (
        lambda f, _: document(f / "a.json", {"FrameIndex": 0, "BlendShapes": [[0.0] * 54]}),
        "54 numbers, expected 55",
    ),
    "keys of another count": (
        lambda f, _: document(f / "a.json", {"dt": [33, 33], "vs": {"jawOpen": [1]}}),
        "1 values, expected 2, as dt has",
    ),
    "a matrix of scale 0": (
        lambda f, _: document(
            f / "a.json", [{"faceBlendshapes": [{"categories": []}], "facialTransformationMatrixes": [[0] * 16]}]
        ),
        "no weights, expected names",
    ),
    "a rate that is no number": (lambda f, v: no_rate(stage(f, v)), "a time that is not finite"),
    "decimal commas between commas": (
        lambda f, _: written(f / "a.csv", "Time,jawOpen\n0,033,0,25\n0,066,0,50\n"),
        "line 2: 4 cells, expected 2, as the header has",
    ),
    "decimal commas of one column": (
        lambda f, _: written(f / "a.csv", "jawOpen\n0,25\n0,5\n"),
        "line 2: 2 cells, expected 1, as the header has",
    ),
    "a line after that of Excel": (
        lambda f, _: written(f / "a.csv", "sep=;\nTime;jawOpen\n0,0;0,5\n0,1;x\n"),
        "line 4: jawOpen 'x', expected a number",
    ),
    "fractions and frames": (
        lambda f, _: written(f / "a.csv", "Timecode,jawOpen\n00:00:00.000,0\n00:00:01:15,1\n"),
        "line 3: timecode '00:00:01:15', expected a fraction",
    ),
    "milliseconds of keys": (
        lambda f, _: written(f / "a.csv", "time,jawOpen\n0,0\n1000,1\n2000,0\n"),
        "'time' in steps of 1000, expected seconds",
    ),
    "half a surrogate pair in lines": (
        lambda f, _: written(f / "a.jsonl", '{"weights": {"\\ud800": 0.1}}\n'),
        "text with half a surrogate pair, expected Unicode",
    ),
    "cues that last for hours": (
        lambda f, _: document(
            f / "a.json", {"visemes": ["aa"] * 1000, "vtimes": [0] * 1000, "vdurations": [8e6] * 1000}
        ),
        "cues of 8e+06 s together, expected at most",
    ),
    "long keys of many names": (
        lambda f, _: document(f / "a.json", {"dt": [0, 8e6, 1], "vs": {f"s{i}": [0, 1, 0] for i in range(200)}}),
        "frames of 200 names, expected at most",
    ),
    "more names than a table": (
        lambda f, _: document(f / "a.json", [{f"s{i}": 0.5 for i in range(5000)}]),
        "5000 names, expected at most 4096",
    ),
    "a stage without clip": (lambda f, _: stage_without(f), "no animation, expected a clip"),
}


def no_rate(path: Path) -> Path:
    path.write_text(path.read_text().replace("timeCodesPerSecond = 30", "timeCodesPerSecond = nan"))
    return path


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def stage_without(folder: Path) -> Path:
    (folder / "a.usda").write_text('#usda 1.0\ndef Xform "a" {}\n')
    return folder / "a.usda"


@pytest.mark.parametrize("name", BAD)
def test_what_is_of_no_known_form_or_unit_is_refused(name: str, tmp_path: Path) -> None:
    write, expected = BAD[name]
    with pytest.raises(InputError) as refused:
        read_performance(write(tmp_path, captured()))
    assert expected in str(refused.value)


# ---- visemes


def test_azure_ids_become_mouths_of_shapes(tmp_path: Path) -> None:
    """A face without visemes opens its jaw for ids of open sounds and not for p, b, m; cues cross half way."""
    cues = [(500_000, 0), (1_500_000, 2), (4_500_000, 21), (7_500_000, 0)]  # a, then m
    path = document(tmp_path / "a.json", [{"audioOffset": at, "visemeId": kind} for at, kind in cues])
    found = read_performance(path)
    assert found.read_as.startswith("Azure viseme ids: ")
    columns = dict(zip(found.names, found.values.T, strict=True))
    at = {seconds: round(seconds * found.fps) for seconds in (0.3, 0.45, 0.6)}
    assert columns["viseme_aa"][at[0.3]] == 1.0
    assert columns["viseme_PP"][at[0.6]] == 1.0
    np.testing.assert_allclose([columns[name][at[0.45]] for name in ("viseme_aa", "viseme_PP")], 0.5, atol=0.01)
    save_parts(tiny_face(), tmp_path / "face.usda")
    report = perform(Animate(face=tmp_path / "face.usda", clip=path), tmp_path / "out.usda").report
    assert "jawOpen" in report.shapes
    face = facepipe.open(tmp_path / "out.usda")
    clip = next(one for one in face.animations if one.name == face.played)
    assert clip.shape_weights is not None
    jaw = np.asarray(clip.shape_weights)[:, clip.shapes.index("jawOpen")]
    np.testing.assert_allclose(jaw[at[0.3]], OCULUS_VISEMES["viseme_aa"]["jawOpen"], atol=1e-6)
    assert jaw[at[0.6]] == 0.0


def test_a_face_with_visemes_plays_them_as_they_are(tmp_path: Path) -> None:
    parts = tiny_face()
    mesh = parts.meshes[0]
    shapes = (mesh.blendshapes[0], *(type(mesh.blendshapes[1])(**{**vars(mesh.blendshapes[1]), "name": "viseme_aa"}),))
    save_parts(
        type(parts)(**{**vars(parts), "meshes": (replace_mesh(mesh, blendshapes=shapes),)}), tmp_path / "face.usda"
    )
    cues = {"visemes": ["aa", "O"], "vtimes": [0, 200], "vdurations": [200, 200]}
    clip = document(tmp_path / "a.json", cues)
    report = perform(Animate(face=tmp_path / "face.usda", clip=clip), tmp_path / "out.usda").report
    assert report.renamed == {"viseme_O": "jawOpen"}
    assert set(report.shapes) == {"viseme_aa", "jawOpen"}


def test_every_viseme_has_a_mouth() -> None:
    assert len(AZURE_VISEMES) == 22
    assert len(OCULUS_VISEMES) == 15
    assert {shape for mix in OCULUS_VISEMES.values() for shape in mix} <= set(SHAPES)
    assert {viseme for mix in AZURE_VISEMES for viseme in mix} <= {*OCULUS_VISEMES}


# ---- clips of other faces


@pytest.mark.parametrize("suffix", [".usda", ".glb"])
def test_the_clip_of_another_face(suffix: str, tmp_path: Path, capsys: Capsys) -> None:
    parts = tiny_face()
    weights = np.linspace(0, 1, 31)[:, None].astype(np.float32)
    clip = Animation(name="talk", times=np.arange(31) / 30, shapes=("jawOpen",), shape_weights=weights)
    other, source = tmp_path / "other.usda", tmp_path / f"other{suffix}"
    save_parts(type(parts)(**{**vars(parts), "animations": (clip,), "played": "talk"}), other)
    if suffix == ".glb":
        done(capsys, "export", other, "-o", source, "--animations")
    save_parts(parts, tmp_path / "face.usda")
    text = done(capsys, "animate", tmp_path / "face.usda", source, "-o", tmp_path / "out.usda", "--name", "said")
    assert "read as clip 'talk' of " in text
    face = facepipe.open(tmp_path / "out.usda")
    found = next(one for one in face.animations if one.name == "said")
    assert found.shape_weights is not None
    jaw = np.asarray(found.shape_weights)[:, found.shapes.index("jawOpen")]
    np.testing.assert_allclose(jaw, weights[:, 0], atol=1e-5)


@pytest.mark.parametrize("up", ["Y", "Z"])
@pytest.mark.parametrize("suffix", [".usda", ".glb"])
def test_head_and_eyes_of_another_face_turn_as_they_did(suffix: str, up: str, tmp_path: Path, capsys: Capsys) -> None:
    """What animate wrote for one face is read back as the angles that it was written from."""
    turns = captured(12)[:, 52:]
    first = tmp_path / "first.usda"
    save_parts(boned(up), first)
    perform(Animate(face=first, clip=rows(tmp_path / "a.csv", TURNS, [[]] * 12, turns)), tmp_path / "out.usda")
    clip = tmp_path / f"out{suffix}"
    if suffix == ".glb":
        done(capsys, "export", tmp_path / "out.usda", "-o", clip, "--animations", quiet=False)
    found = read_performance(clip)
    columns = dict(zip(found.names, found.values.T, strict=True))
    np.testing.assert_allclose(np.stack([columns[name] for name in TURNS], axis=1), turns, atol=2e-5)


def test_joints_beside_head_and_eyes_are_named(tmp_path: Path) -> None:
    parts = boned()
    frames = 5
    turning = np.tile(rest_coefficients(1), (frames, 1, 1))
    turning[:, :, 3] = np.linspace(0, 0.5, frames)[:, None]
    weights = np.linspace(0, 1, frames, dtype=np.float32)[:, None]
    for joint in ("spine", "spine/Head"):
        clip = Animation(
            name="talk",
            times=np.arange(frames) / 30,
            joints=(joint,),
            coefficients=turning,
            shapes=("jawOpen",),
            shape_weights=weights,
        )
        save_parts(replace(parts, animations=(clip,), played="talk"), tmp_path / f"{joint[-4:]}.usda")
    found = read_performance(tmp_path / "pine.usda")
    assert found.warnings == ("1 joints that move beside head and eyes (spine): left out",)
    assert not read_performance(tmp_path / "Head.usda").warnings


def test_first_frames_without_a_face_keep_their_time(tmp_path: Path) -> None:
    """Else the clip would begin late against its sound."""
    values = captured()
    path = live(tmp_path, values, codes(60))
    lines = path.read_text().split("\n")
    for number in (1, 2, 3, 4, 20):
        cells = lines[number].split(",")
        lines[number] = ",".join([cells[0], "0", *cells[2:]])
    path.write_text("\n".join(lines))
    read = read_performance(path)
    assert (len(read.values), read.filled) == (FRAMES, 5)
    np.testing.assert_allclose(read.values[4], values[4], atol=1e-6)
    np.testing.assert_allclose(read.values[:4], np.tile(values[4], (4, 1)), atol=1e-6)
    np.testing.assert_allclose(read.values[19, :52], (values[18, :52] + values[20, :52]) / 2, atol=1e-6)


def test_a_rate_shows_where_frames_are_missing_at_the_end_of_a_second(tmp_path: Path) -> None:
    kept = [i for i in range(150) if i not in (57, 58, 59)]
    values = captured(150)[kept]
    read = read_performance(live(tmp_path, values, [live_link.timecode(i, 30) for i in kept]))
    assert (read.fps, len(read.values), read.filled) == (30, 150, 3)


@pytest.mark.parametrize(("most", "said"), [(0.9, False), (2.3, True)])
def test_turns_that_no_tracker_follows_are_named(most: float, said: bool, tmp_path: Path) -> None:
    """Few degrees may be radians: which they are taken for is said."""
    values = np.column_stack([np.linspace(0, 1, FRAMES), np.linspace(0, most, FRAMES), np.linspace(0, 1.6, FRAMES)])
    path = rows(tmp_path / "take.csv", ["jawOpen", "HeadYaw", "HeadRoll"], [[] for _ in values], values)
    assert any("taken as radians" in line for line in read_performance(path).warnings) == said
    assert not read_performance(path, angles="rad").warnings


def test_what_frames_hold_beside_weights_is_named(tmp_path: Path) -> None:
    frames = [{"time": i / 30, "blendShapes": {"jawOpen": 0.1 * i}, "lookAtPoint": [0, 0, 1]} for i in range(5)]
    assert read_performance(document(tmp_path / "take.json", frames)).warnings == (
        "lookAtPoint of its frames: left out",
    )


def test_columns_that_are_no_weights_say_nothing_of_their_unit(tmp_path: Path) -> None:
    values = np.column_stack([captured()[:, :2], np.full(FRAMES, 25.0)])
    path = rows(tmp_path / "take.csv", [*SHAPES[:2], "fps"], [[] for _ in values], values)
    read = read_performance(path)
    np.testing.assert_allclose(read.values, values, atol=1e-6)
    assert read.read_as.endswith("60 fps taken, as it holds no times (--fps)")


@pytest.mark.parametrize("categories", [7, "jawOpen", None, {"jawOpen": 1}])
def test_categories_that_are_no_list_are_refused(categories: object, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected"):
        read_performance(document(tmp_path / "take.json", [{"faceBlendshapes": [{"categories": categories}]}]))


@pytest.mark.parametrize("fps", [15, 30, 240])
def test_timecodes_count_frames_of_the_rate_that_is_said(fps: int, tmp_path: Path) -> None:
    """In the file or by an option, which comes first; frames beyond 130 are no milliseconds then."""
    values = np.linspace(0, 1, 2 * fps)
    frames = [{"timecode": live_link.timecode(i, fps), "jawOpen": value} for i, value in enumerate(values.tolist())]
    for content, option in (({"fps": fps, "frames": frames}, None), ({"fps": 60, "frames": frames}, float(fps))):
        read = read_performance(document(tmp_path / "take.json", content), option)
        assert (read.fps, read.filled, read.warnings) == (fps, 0, ())
        np.testing.assert_allclose(read.values[:, 0], values, atol=1e-12)


def test_seconds_that_are_called_so_may_be_far_apart(tmp_path: Path) -> None:
    read = read_performance(written(tmp_path / "take.csv", "seconds,jawOpen\n0,0\n3,1\n6,0\n"))
    assert (read.seconds.tolist(), read.values[:, 0].tolist()) == ([0, 3, 6], [0, 1, 0])
    read = read_performance(written(tmp_path / "take.csv", "seconds,jawOpen\n0,0\n2.5,1\n"))
    assert (read.seconds.tolist(), read.values[:, 0].tolist(), read.warnings) == ([0, 2.5], [0, 1], ())


def test_a_key_track_without_values_is_left_out(tmp_path: Path) -> None:
    content = {"dt": [0, 30, 500], "vs": {"jawOpen": [0, None, 1], "mouthLeft": [None] * 3}}
    read = read_performance(document(tmp_path / "take.json", content))
    assert (read.names, read.warnings) == (("jawOpen",), ("no values of mouthLeft: left out",))
    np.testing.assert_allclose(read.values[:, 0], read.seconds / 0.53, atol=0.04)


def test_turns_beside_the_shapes_of_media_pipe_may_be_degrees(tmp_path: Path) -> None:
    """Those of its matrices are radians, whatever their size."""
    frames = [{"faceBlendshapes": {"jawOpen": 0.1}, "HeadYaw": yaw} for yaw in (10.0, 20.0)]
    read = read_performance(document(tmp_path / "take.json", frames))
    np.testing.assert_allclose(np.degrees(read.values[:, 1]), [10, 20])
    assert "30 fps taken" in read.read_as
    said = read_performance(document(tmp_path / "take.json", {"fps": 25, "frames": frames}))
    assert (said.fps, "30 fps" in said.read_as) == (25, False)


def test_known_shapes_at_rest_say_nothing_of_a_unit(tmp_path: Path) -> None:
    read = read_performance(written(tmp_path / "take.csv", "jawOpen,dimple\n0,50\n0,100\n"))
    assert read.values[:, 1].tolist() == [0.5, 1.0]


def test_sliders_of_a_face_may_go_beyond_their_maximum(tmp_path: Path) -> None:
    values = captured()[:, :5] + 1.5
    path = rows(tmp_path / "take.csv", [f"measure{name}" for name in "ABCDE"], [[] for _ in values], values)
    read = read_performance(path)
    np.testing.assert_allclose(read.values, values, atol=1e-6)
    assert read.warnings == (f"weights up to {values.max():g}, taken as they are: 1 is the whole shape",)
