"""Landmarks of a photo: every way to write them says the same, and what can't be a face's is one line."""

from __future__ import annotations

import importlib.util
import io
import json
import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small_head as sample
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from import_data import refused, shared
from scipy.spatial.transform import Rotation

from facepipe.core.errors import InputError
from facepipe.importers.ict import LANDMARKS
from facepipe.photo.fit import (
    Landmarks68,
    Photo,
    mediapipe_landmarks,
    own_landmarks,
    read_landmarks,
    read_photo,
    write_landmarks,
)
from facepipe.photo.fit.photo_landmarks import MULTIPIE68_OF_MEDIAPIPE, one_face

Array = np.ndarray[Any, Any]

WIDTH, HEIGHT = 400, 300


def blank(width: int = WIDTH, height: int = HEIGHT, scale: float = 1.0) -> Photo:
    """A photo of nothing, reduced by `scale`."""
    pixels = np.full((int(height * scale), int(width * scale), 3), 0.5, np.float32)
    return Photo(pixels=pixels, path=Path("me.jpg"), size=(width, height), scale=scale)


@cache
def sample_marks() -> Array:
    """(68, 3) landmarks of the sample about their middle, y up, in heights of the face."""
    head = max(sample.make(0).meshes, key=lambda mesh: len(mesh.points))
    return normal(head.points[head.landmarks["multipie68"].indices])


def normal(marks: Array) -> Array:
    centred = np.asarray(marks, dtype=np.float64) - np.mean(marks, axis=0)
    return np.asarray(centred / np.ptp(centred[:, 1]))


def seen(marks: Array, *, yaw: float = 0, pitch: float = 0, roll: float = 0, distance: float = 5) -> Array:
    """(68, 2) where a camera sees landmarks (68, 3), 140 pixels high in the middle of the photo; degrees."""
    turned = Rotation.from_euler("ZYX", [roll, yaw, pitch], degrees=True).apply(marks)
    flat = turned[:, :2] * [1, -1] * distance / (distance - turned[:, 2:])
    return np.asarray(flat * 140 + [WIDTH / 2, HEIGHT / 2])


def face() -> Array:
    return seen(sample_marks())


def mediapipe(points: Array, count: int = 478) -> list[list[float]]:
    """A list of MediaPipe's that has `points` (68, 2) at its indices, and other places elsewhere."""
    result = np.full((count, 3), 77.0)
    result[list(MULTIPIE68_OF_MEDIAPIPE), :2] = points
    return result.tolist()


def read(folder: Path, content: object, photo: Photo | None = None, index: int | None = None) -> Landmarks68:
    file = folder / "marks.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    found = read_landmarks(file, photo or blank(), index=index)
    assert found.points.shape == (68, 2)
    assert found.points.dtype == np.float64
    return found


def error(folder: Path, content: object, photo: Photo | None = None, index: int | None = None) -> str:
    with pytest.raises(InputError) as caught:
        read(folder, content, photo, index)
    assert str(caught.value).startswith(str(folder / "marks.json"))
    assert "\n" not in str(caught.value)
    return str(caught.value)[len(str(folder / "marks.json")) :]


def test_every_way_to_write_them_says_the_same(tmp_path: Path) -> None:
    points = face()
    deep = np.hstack([points, np.ones((68, 1))]).tolist()
    shares = (points / (WIDTH, HEIGHT)).tolist()
    ways: list[object] = [
        points.tolist(),
        deep,
        [points.tolist()],
        mediapipe(points),
        mediapipe(points, 468),
        {"multipie68": points.tolist()},
        {"multipie68": [deep]},
        {"mediapipe478": mediapipe(points)},
        {"landmarks": mediapipe(points), "units": "pixels"},
        {"landmarks": shares, "units": "normalized"},
        {"landmarks": shares, "units": "normalised by width and height"},
        {"multipie68": points.tolist(), "mediapipe478": mediapipe(points[::-1]), "image": "me.jpg", "detector": "eye"},
    ]
    for way in ways:
        assert read(tmp_path, way).points == pytest.approx(points, abs=1e-9)
    assert read(tmp_path, "\ufeff" + json.dumps(ways[0])).source == "marks.json"


def test_pixels_are_those_of_the_file_however_the_photo_was_reduced(tmp_path: Path) -> None:
    points, photo = face(), blank(scale=0.25)
    assert read(tmp_path, points.tolist(), photo).points == pytest.approx(points / 4)
    shares = {"landmarks": (points / (WIDTH, HEIGHT)).tolist(), "units": "normalized"}
    assert read(tmp_path, shares, photo).points == pytest.approx(points / 4)
    assert f"{WIDTH} x {HEIGHT} pixels" in error(tmp_path, (points + 500).tolist(), photo)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(yaw=st.floats(-60, 60), pitch=st.floats(-30, 30), roll=st.floats(-180, 180), scale=st.floats(0.2, 1))
def test_written_landmarks_are_read_back(tmp_path: Path, yaw: float, pitch: float, roll: float, scale: float) -> None:
    photo, file = blank(scale=scale), tmp_path / "again.json"
    points = seen(sample_marks(), yaw=yaw, pitch=pitch, roll=roll) * scale
    write_landmarks(file, Landmarks68(points=points, source="a test"), photo)
    first = file.read_bytes()
    found = read_landmarks(file, photo)
    assert found.points == pytest.approx(points, abs=5.1e-4)
    write_landmarks(file, Landmarks68(points=found.points, source="a test"), photo)
    assert file.read_bytes() == first


def test_confidences_go_with_landmarks(tmp_path: Path) -> None:
    photo, file = blank(scale=0.5), tmp_path / "again.json"
    assert (read(tmp_path, face().tolist()).confidence == 1).all()
    trust = np.linspace(0, 1, 68)
    write_landmarks(file, Landmarks68(points=face() / 2, source="a test", confidence=trust), photo)
    assert read_landmarks(file, photo).confidence == pytest.approx(trust, abs=6e-4)
    for bad in (0.5, [0.5] * 67, [0.5] * 67 + [1.01], [-0.1] * 68, ["1"] * 68, [True] * 68, {"0": 1}):
        message = error(tmp_path, {"multipie68": face().tolist(), "confidence": bad})
        assert message.endswith("expected 68 numbers of 0 to 1")
        assert message.startswith(" -> confidence: ")


def test_a_photo_with_landmarks() -> None:
    file = shared("photos/astronaut.landmarks.json")
    content = json.loads(file.read_text(encoding="utf-8"))
    assert content["mediapipe_index_of_multipie68"] == list(MULTIPIE68_OF_MEDIAPIPE)
    photo = read_photo(shared("photos/astronaut.png"))
    found = read_landmarks(file, photo)
    assert np.array_equal(found.points, content["multipie68"])
    assert not found.warnings
    smaller = read_photo(shared("photos/astronaut.png"), largest=200)
    assert read_landmarks(file, smaller).points == pytest.approx(found.points * 200 / 512)


def test_several_faces_need_an_index(tmp_path: Path) -> None:
    one, other = face(), face() + np.array([30, 20])
    for both in ([one.tolist(), other.tolist()], {"mediapipe478": [mediapipe(one), mediapipe(other)]}):
        assert "2 faces found, expected one, or an index from 0 to 1" in error(tmp_path, both)
        assert read(tmp_path, both, index=1).points == pytest.approx(other)
        assert "face 2 of 2" in error(tmp_path, both, index=2)
        assert "face -1 of 2" in error(tmp_path, both, index=-1)
    assert read(tmp_path, one.tolist(), index=0).points == pytest.approx(one)
    for none in ([], {"landmarks": []}):
        assert "no face found" in error(tmp_path, none)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("", "is not JSON"),
        ("[[1, 2], [3", "is not JSON"),
        ("[" * 100_000, "is not JSON"),
        ("12", "12, expected a list of 68 or 478 points"),
        ("null", "null, expected a list"),
        ("{}", "no landmarks, expected one of multipie68, mediapipe478, landmarks"),
        ({"points": []}, " -> points: unknown key"),
        ('{"landmarks": [], "landmarks": []}', "'landmarks' twice"),
        ({"landmarks": {"a": 1}}, " -> landmarks: an object, expected a list of points"),
        ([[1, 2]] * 67, " -> landmarks: 67 points, expected 68 or 468 or 478"),
        ({"multipie68": [[1, 2]] * 478}, " -> multipie68: 478 points, expected 68"),
        ({"mediapipe478": [[1, 2]] * 468}, " -> mediapipe478: 468 points, expected 478"),
        ([[[1, 2]] * 68, 3], " -> landmarks: 2 points"),
        ([[1, 2]] * 60 + [[1]] * 8, " -> landmarks -> 60: [1], expected finite numbers"),
        ([[1, 2]] * 60 + [["1", 2]] * 8, ' -> 60: ["1", 2], expected'),
        ([[1, 2]] * 60 + [[True, 2]] * 8, " -> 60: [true, 2], expected"),
        ([[1, 2]] * 60 + [[1, 2, 3, 4]] * 8, " -> 60: [1, 2, 3, 4], expected"),
        ([[1, 2]] * 60 + [[float("nan"), 2]] * 8, " -> 60: [NaN, 2], expected finite numbers"),
        ([[1, 2]] * 60 + [[1, float("-inf")]] * 8, " -> 60: [1, -Infinity], expected finite numbers"),
        ([[1, 2]] * 60 + [[1, 10**400]] * 8, " -> 60: [1, 1000"),
        ({"landmarks": [[1, 2]] * 68, "units": "inches"}, ' -> units: "inches", expected pixels or normalized'),
        ({"landmarks": [[1, 2]] * 68, "units": 1}, " -> units: 1, expected pixels or normalized"),
    ],
)
def test_other_content_is_refused(tmp_path: Path, content: object, what: str) -> None:
    assert what in error(tmp_path, content)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        read_landmarks(tmp_path / "marks.json", blank())
    with pytest.raises(InputError, match="not a regular file"):
        read_landmarks(tmp_path, blank())


def test_landmarks_outside_the_photo_are_refused_beyond_what_detectors_guess(tmp_path: Path) -> None:
    points = face()
    lowest = points[:, 1].max()
    cropped = blank(height=int(lowest) - 10)
    found = read(tmp_path, points.tolist(), cropped)
    assert found.points == pytest.approx(points)
    assert "of 68 landmarks outside me.jpg" in found.warnings[0]
    assert "number 8 at" in error(tmp_path, points.tolist(), blank(height=int(lowest) - 25))  # the chin
    for offset in ((-300, 0), (300, 0), (0, -300), (1e5, 1e5)):
        assert "68 of 68 landmarks outside" in error(tmp_path, (points + offset).tolist())
    stray = points.copy()
    stray[30, 0] = WIDTH + 21
    assert "1 of 68 landmarks outside me.jpg (400 x 300 pixels), number 30" in error(tmp_path, stray.tolist())
    assert "landmarks outside" in error(tmp_path, {"landmarks": points.tolist(), "units": "normalized"})


def test_landmarks_of_no_face_are_refused(tmp_path: Path) -> None:
    points, line = face(), np.linspace(50, 250, 68)
    assert "span 0 pixels" in error(tmp_path, [[100, 100]] * 68)
    assert '"units": "normalized"' in error(tmp_path, (points / (WIDTH, HEIGHT)).tolist())
    assert "on one line" in error(tmp_path, np.stack([line, line + np.arange(68) % 3], axis=1).tolist())
    shuffled = np.random.default_rng(0).permutation(68)
    for order in (shuffled, np.arange(68)[::-1], np.roll(np.arange(68), 17)):
        assert "expected the 68 of Multi-PIE in their order" in error(tmp_path, points[order].tolist())
    some = np.tile(points[:1], (68, 1))
    some[60:] = points[60:]
    assert "expected" in error(tmp_path, some.tolist())


def test_mirrored_landmarks_are_refused_and_turned_ones_are_not(tmp_path: Path) -> None:
    middle = np.array([WIDTH, HEIGHT]) / 2
    for roll in range(0, 360, 30):
        points = seen(sample_marks(), roll=roll)
        assert read(tmp_path, points.tolist()).points == pytest.approx(points)
        for flip in ((-1, 1), (1, -1)):
            assert "mirrored" in error(tmp_path, ((points - middle) * flip + middle).tolist())
    assert "mirrored" in error(tmp_path, ((face() - middle)[:, ::-1] + middle).tolist())  # x and y exchanged


def random_heads(count: int) -> list[Array]:
    """Landmarks (68, 3) of heads with random identities and expressions."""
    data, rng = np.load(shared("ict_facekit/ict_facekit.npz")), np.random.default_rng(0)
    marks = list(LANDMARKS)
    neutral, modes, shapes = (data[f"{name}"] for name in ("neutral", "identity_deltas", "expression_deltas"))
    return [
        normal(
            neutral[marks]
            + np.tensordot(rng.normal(size=len(modes)), modes[:, marks], 1)
            + np.tensordot(rng.random(len(shapes)) * (rng.random(len(shapes)) < 0.15), shapes[:, marks], 1)
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize("yaw", [0.0, 40.0])
def test_a_part_of_the_face_in_another_place_is_refused(tmp_path: Path, yaw: float) -> None:
    """Both eyes at one place, the nose beside the face, the mouth on the brows."""
    points = seen(sample_marks(), yaw=yaw, roll=70)
    across = points[45] - points[36]
    for part, shift in ((slice(42, 48), -0.7 * across), (slice(27, 36), across)):
        wrong = points.copy()
        wrong[part] += shift
        name = {27: "nose", 42: "left eye"}[part.start]
        assert f"the landmarks of the {name} are " in error(tmp_path, wrong.tolist())
    wrong = points.copy()
    wrong[48:] += points[17:27].mean(axis=0) - points[48:].mean(axis=0)
    assert "where a face has them" in error(tmp_path, wrong.tolist())


def test_landmarks_that_no_turned_head_has_are_refused(tmp_path: Path) -> None:
    crushed = face()
    crushed[:17] = crushed[8] + [0.5, 0.0] * np.arange(17)[:, None]
    assert "away from any turned head's, expected at most 0.45" in error(tmp_path, crushed.tolist())


def test_faces_from_every_side_pass(tmp_path: Path) -> None:
    """Up to full profile, from above and below, from near and far, turned in the picture."""
    rng, photo = np.random.default_rng(1), blank()
    for marks in [sample_marks(), *random_heads(8)]:
        for yaw in (-90, -60, -30, 0, 30, 60, 90):
            for pitch in (-40, 0, 40):
                distance, roll = rng.choice([3, 5, 20]), rng.uniform(-180, 180)
                points = seen(marks, yaw=yaw, pitch=pitch, roll=roll, distance=distance)
                assert read(tmp_path, points.tolist(), photo).points == pytest.approx(points)


def test_one_face_is_chosen() -> None:
    assert one_face(["a"], None, "me.jpg") == "a"
    assert one_face(["a", "b"], 1, "me.jpg") == "b"
    for faces, index, what in (
        ([], None, "no face found"),
        ([], 0, "no face found"),
        (["a", "b", "c"], None, "3 faces"),
    ):
        with pytest.raises(InputError, match=what):
            one_face(faces, index, "me.jpg")


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=12,
)
points_of_any_kind = st.sampled_from([1, 68, 468, 478]).flatmap(
    lambda count: st.tuples(st.lists(json_values, max_size=3), st.just(count)).map(
        lambda drawn: ([*drawn[0], *mediapipe(face())] * 2)[: drawn[1]]
    )
)
keys = st.sampled_from(["multipie68", "mediapipe478", "landmarks", "units", "image", "other"])
objects = st.dictionaries(keys, json_values | points_of_any_kind | st.lists(points_of_any_kind, max_size=2), max_size=3)


@settings(
    max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(content=json_values | points_of_any_kind | objects, index=st.none() | st.integers(-1, 2))
def test_any_json_is_read_or_refused_in_one_line(tmp_path: Path, content: object, index: int | None) -> None:
    refused(lambda: read(tmp_path, content, index=index), tmp_path / "marks.json")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(max_size=60), at=st.integers(0, 3000), cut=st.integers(0, 3000))
def test_any_bytes_are_read_or_refused_in_one_line(tmp_path: Path, data: bytes, at: int, cut: int) -> None:
    file, good = tmp_path / "marks.json", json.dumps(face().tolist()).encode()
    file.write_bytes(good[:at] + data + good[at + cut :])
    refused(lambda: read_landmarks(file, blank()), file)


def bundle(folder: Path, **members: bytes) -> Path:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.tflite", data)
    file = folder / "face.task"
    file.write_bytes(buffer.getvalue())
    return file


def test_mediapipe_needs_its_model(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.task: can't be read: No such file"):
        mediapipe_landmarks(blank(), tmp_path / "nowhere.task")
    text = tmp_path / "text.task"
    text.write_text("no model")
    with pytest.raises(InputError, match=r"text\.task: is no MediaPipe task bundle"):
        mediapipe_landmarks(blank(), text)


@pytest.mark.skipif(importlib.util.find_spec("mediapipe") is not None, reason="mediapipe is installed here")
def test_mediapipe_is_asked_for_where_it_is_missing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"not installed, expected: pip install 'mediapipe>=1\.2,<2'"):
        mediapipe_landmarks(blank(), bundle(tmp_path))


@pytest.mark.needs_mediapipe
def test_wrong_models_are_refused_by_mediapipe(tmp_path: Path) -> None:
    for file in (bundle(tmp_path, other=b"x"), bundle(tmp_path, face_detector=b"x", face_landmarks_detector=b"x")):
        with pytest.raises(InputError, match=r"face\.task: .*expected MediaPipe's face_landmarker\.task"):
            mediapipe_landmarks(blank(), file)


@pytest.mark.needs_torch
def test_our_network_finds_no_face_where_there_is_none() -> None:
    with pytest.raises(InputError, match=r"^me\.jpg: no face found, expected one$"):
        own_landmarks(blank(150, 120))
