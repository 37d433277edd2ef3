"""The shipped landmark network and the search for faces: synthetic heads, a photo, and what is no face."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from places import REPOSITORY, SHARED
from small_head import make
from with_torch import torch

from facepipe.core.errors import InputError
from facepipe.networks import FoundFace, find_landmarks, follow_face, landmark_model
from facepipe.networks.files import LandmarkSession

pytestmark = pytest.mark.needs_torch

FloatArray = npt.NDArray[np.floating]

PHOTO = SHARED / "photos" / "astronaut.png"
WORST_OF_RENDERS = 0.05  # of the distance of the outer eye corners, mean over the inner points


def rendered(seed: int, *, size: int, share: float, yaw: float) -> tuple[FloatArray, FloatArray]:
    """(size, size, 3) sRGB of a sample's head on grey, and its 68 landmarks in pixels.

    :param share: of the picture's height that brows to chin fill
    """
    from facepipe.photo.renderer.camera import Camera
    from facepipe.photo.renderer.face_model import FaceModel, Look
    from facepipe.photo.renderer.light import ambient, distant

    parts = make(seed)
    face = FaceModel(parts)
    points = face.rig()
    marks = parts.meshes[0].landmarks["multipie68"].indices
    middle = points[marks].mean(dim=0).numpy()
    tall = float(np.ptp(points[marks].numpy()[:, 1]))
    away = 90.0
    axes = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
    camera = Camera.at(axes, middle + away * axes[2], share * size * away / tall, (size / 2, size / 2))
    light = ambient(torch.full((3,), 0.5)) + distant(torch.tensor([0.4, 0.5, 0.77]), torch.full((3,), 0.7))
    look = Look(camera=camera, light=light, background=torch.full((3,), 0.3))
    linear = face.image(points, look, height=size, width=size)[..., :3].numpy()
    return encoded(linear), camera.project(points)[marks, :2].numpy()


def encoded(linear: FloatArray) -> FloatArray:
    return np.where(linear < 0.0031308, linear * 12.92, 1.055 * linear.clip(1e-6, 1) ** (1 / 2.4) - 0.055).clip(0, 1)


def inner_error(found: FoundFace, marks: FloatArray) -> float:
    """Mean distance of the points that are not on the contour, over the distance of the outer eye corners."""
    across = np.linalg.norm(marks[36] - marks[45])
    return float(np.linalg.norm(found.landmarks - marks, axis=1)[17:].mean() / across)


@pytest.mark.parametrize(("seed", "yaw"), [(101, 0.0), (102, 0.35)])
def test_landmarks_of_a_head_that_training_never_saw(seed: int, yaw: float) -> None:
    image, marks = rendered(seed, size=256, share=0.45, yaw=yaw)
    (found,) = find_landmarks(image)
    assert found.presence > 0.9
    assert inner_error(found, marks) < WORST_OF_RENDERS


def test_the_map_of_a_picture_as_large_as_a_crop_is_its_presence() -> None:
    """And a larger picture's has a window each 16 pixels; that on the face is the surest."""
    session = LandmarkSession(landmark_model())
    crop = np.moveaxis(rendered(101, size=96, share=0.6, yaw=0.0)[0], -1, 0)
    _, presence = session(crop[None])
    np.testing.assert_allclose(1 / (1 + np.exp(-session.presence_map(crop))), presence[:, None], atol=1e-5)
    larger = np.pad(crop, ((0, 0), (32, 64), (48, 0)), mode="edge")
    found = session.presence_map(larger)
    assert found.shape == (7, 4)
    assert np.unravel_index(found.argmax(), found.shape) == (2, 3)


def test_two_faces_are_found_as_two() -> None:
    left, of_left = rendered(103, size=200, share=0.45, yaw=0.0)
    right, of_right = rendered(104, size=200, share=0.4, yaw=-0.2)
    faces = sorted(find_landmarks(np.hstack([left, right])), key=lambda face: face.landmarks[:, 0].mean())
    assert len(faces) == 2
    assert inner_error(faces[0], of_left) < WORST_OF_RENDERS
    assert inner_error(faces[1], of_right + np.array([200, 0])) < WORST_OF_RENDERS


def test_landmarks_follow_the_photo() -> None:
    """Half the resolution, and a border around it: the same landmarks, scaled and moved."""
    image, _ = rendered(105, size=256, share=0.5, yaw=0.15)
    (whole,) = find_landmarks(image)
    half = image.reshape(128, 2, 128, 2, 3).mean(axis=(1, 3))
    (bordered,) = find_landmarks(np.pad(half, ((10, 30), (20, 40), (0, 0)), constant_values=0.6))
    across = np.linalg.norm(whole.landmarks[36] - whole.landmarks[45])
    moved = (bordered.landmarks - np.array([20, 10])) * 2
    assert np.linalg.norm(moved - whole.landmarks, axis=1).mean() < 0.05 * across


def test_what_is_covered_is_less_sure() -> None:
    image, marks = rendered(101, size=160, share=0.55, yaw=0.1)
    (clear,) = find_landmarks(image)
    assert clear.confidence.shape == (68,)
    left, top = marks[48:].min(axis=0).astype(int) - 6
    right, bottom = marks[48:].max(axis=0).astype(int) + 6
    image[top:bottom, left:right] = (0.2, 0.5, 0.3)
    (covered,) = find_landmarks(image)
    assert covered.confidence[48:].mean() < 0.7 * clear.confidence[48:].mean()
    assert covered.confidence[48:].mean() < 0.7 * covered.confidence[17:48].mean()
    assert 0 < covered.confidence.min() <= covered.confidence.max() <= 1


def backgrounds() -> dict[str, FloatArray]:
    rng = np.random.default_rng(7)
    y, x = np.mgrid[0:120, 0:150] / 120
    skin = np.array([0.85, 0.62, 0.5])
    oval = np.exp(-(((x - 0.6) / 0.25) ** 4) - ((y - 0.5) / 0.35) ** 4)[..., None]
    return {
        "plain": np.full((120, 150, 3), 0.5),
        "noise": rng.random((120, 150, 3)),
        "gradient": np.stack([x / 2, y, 1 - y], axis=-1),
        "stripes": np.repeat((np.sin(40 * (x + y)) > 0)[..., None], 3, axis=2).astype(float),
        "a skin-coloured oval": oval * skin + (1 - oval) * 0.2,
    }


@pytest.mark.parametrize("name", backgrounds())
def test_no_face_where_there_is_none(name: str) -> None:
    assert find_landmarks(backgrounds()[name]) == []


def photo() -> FloatArray:
    if not PHOTO.exists():
        pytest.skip("../shared/data/photos is absent")
    from PIL import Image

    with Image.open(PHOTO) as opened:
        return np.asarray(opened.convert("RGB")) / 255


def test_the_face_of_a_photo() -> None:
    """Well under 8 % of the eye distance from MediaPipe's landmarks, which training never saw, and no other face."""
    image = photo()
    known = json.loads(PHOTO.with_suffix(".landmarks.json").read_text())["multipie68"]
    (found,) = find_landmarks(image)
    assert inner_error(found, np.array([point[:2] for point in known])) < 0.06


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_photo_on_its_side_shows_the_same_face(quarters: int) -> None:
    image, marks = rendered(101, size=120, share=0.6, yaw=0.2)
    image = image[:, 8:]  # not square
    height, width = image.shape[:2]
    x, y = (marks - [8, 0]).T
    expected = {1: (y, width - x), 2: (width - x, height - y), 3: (height - y, x)}
    (found,) = find_landmarks(np.rot90(image, quarters))
    assert inner_error(found, np.stack(expected[quarters], axis=1)) < WORST_OF_RENDERS


@pytest.mark.parametrize("quarters", range(4))
def test_a_face_that_has_moved_a_little_is_found_again(quarters: int) -> None:
    """Where a search finds it, whichever way up; not where no face is."""
    image, _ = rendered(101, size=120, share=0.6, yaw=0.2)
    image = np.rot90(image[:, 8:], quarters)
    (found,) = find_landmarks(image)
    followed = follow_face(image, found.landmarks + np.array([7.0, -5.0]))
    assert followed is not None
    np.testing.assert_allclose(followed.landmarks, found.landmarks, atol=0.3)
    assert follow_face(image, found.landmarks * 0.3) is None


@pytest.mark.slow
def test_a_flag_a_helmet_and_patches_are_no_faces() -> None:
    gray = np.repeat(photo()[215:].mean(axis=2, keepdims=True), 3, axis=2)  # all of the photo below the chin
    assert find_landmarks(gray) == []


def test_the_file_is_small_and_says_where_it_comes_from() -> None:
    import onnx

    path = landmark_model()
    assert path.stat().st_size < 5_000_000
    model = onnx.load(path)
    described = json.loads(next(prop.value for prop in model.metadata_props if prop.key == "facepipe.features"))
    assert described["kind"] == "landmarks"
    assert "synthetic" in described["trained_on"]
    assert "--seed" in described["training"]
    assert described["held_out"]["nme_inner"] < 0.035
    assert model.opset_import[0].version <= 18
    assert not any(node.doc_string or node.metadata_props for node in model.graph.node)


def test_the_file_is_the_network_of_this_code() -> None:
    """Exported weights give in onnxruntime what torch gives."""
    sys.path.insert(0, str(REPOSITORY / "training"))
    from landmark_export import to_onnx
    from landmark_network import MEAN, SIZE, STD, LandmarkNetwork

    torch.manual_seed(1)
    network = LandmarkNetwork()
    images = torch.rand(4, 3, SIZE, SIZE)
    with torch.no_grad():
        network((images - MEAN) / STD)  # running means of the normalisation
        landmarks, presence, _ = network.eval()((images - MEAN) / STD)
    described = {"kind": "landmarks", "size": SIZE, "mean": [MEAN] * 3, "std": [STD] * 3}
    found, present = LandmarkSession(to_onnx(network, described))(images.numpy())
    np.testing.assert_allclose(found, landmarks.numpy() * SIZE, atol=2e-3)
    np.testing.assert_allclose(present, presence.sigmoid().numpy()[:, 0], atol=1e-4)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((32, 32)), r"expected \(h, w, 3\)"),
        (np.full((32, 32, 3), np.nan), "NaN or infinity"),
    ],
)
def test_arrays_that_are_no_photo_are_refused(image: FloatArray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_landmarks(image)


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.onnx"
    path.write_bytes(b"no model")
    with pytest.raises(InputError, match="is damaged or no ONNX file"):
        find_landmarks(np.zeros((32, 32, 3)), path)


def test_networks_of_another_kind_are_refused(tmp_path: Path) -> None:
    import onnx

    model = onnx.load(landmark_model())
    for text in ('{"kind": "identity", "size": 96, "mean": [0, 0, 0], "std": [1, 1, 1]}', "no JSON", "[]"):
        onnx.helper.set_model_props(model, {"facepipe.features": text})
        path = tmp_path / "other.onnx"
        onnx.save(model, path)
        with pytest.raises(InputError, match=r"expected 'facepipe\.features' of kind landmarks"):
            find_landmarks(np.zeros((32, 32, 3)), path)


def test_a_network_whose_presence_has_no_map_is_refused(tmp_path: Path) -> None:
    import onnx

    model = onnx.load(landmark_model())
    next(node for node in model.graph.node if "presence" in node.output).op_type = "HardSigmoid"
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(InputError, match="no landmark network"):
        LandmarkSession(tmp_path / "other.onnx")
