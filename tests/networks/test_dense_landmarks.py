"""The shipped network of many landmarks: heads that training never saw."""

from __future__ import annotations

import json
import sys
from functools import cache

import numpy as np
import pytest
from places import REPOSITORY
from small_head import make
from with_torch import torch

from facepipe.core.errors import InputError
from facepipe.networks import FoundFace, find_landmarks
from facepipe.networks.files import DenseLandmarkSession, dense_landmark_model, landmark_model
from facepipe.photo.descent.landmark_rig import dense_points
from facepipe.photo.fit.author import pupil_points

pytestmark = pytest.mark.needs_torch

SIZE, YAW = 320, 0.25


@cache
def head() -> tuple[FoundFace, np.ndarray, np.ndarray, np.ndarray]:
    """What is found in a render of a head; where its 68 landmarks, its dense ones and its pupils are, in pixels."""
    from facepipe.photo.descent.working_photo import to_srgb
    from facepipe.photo.renderer.camera import Camera
    from facepipe.photo.renderer.face_model import FaceModel, Look
    from facepipe.photo.renderer.light import ambient, distant

    parts = make(106)
    face = FaceModel(parts)
    points = face.rig()
    marks = parts.meshes[0].landmarks["multipie68"].indices
    axes = np.array([[np.cos(YAW), 0, -np.sin(YAW)], [0, 1, 0], [np.sin(YAW), 0, np.cos(YAW)]])
    tall = float(np.ptp(points[marks].numpy()[:, 1]))
    camera = Camera.at(axes, points[marks].mean(dim=0).numpy() + 90 * axes[2], 45 * SIZE / tall, (SIZE / 2, SIZE / 2))
    light = ambient(torch.full((3,), 0.5)) + distant(torch.tensor([0.4, 0.5, 0.77]), torch.full((3,), 0.7))
    look = Look(camera=camera, light=light, background=torch.full((3,), 0.3))
    image = to_srgb(face.image(points, look, height=SIZE, width=SIZE)[..., :3]).numpy()
    (found,) = find_landmarks(image)
    screen = camera.project(points)[:, :2].numpy()
    return found, screen[marks], screen[dense_points(parts)], screen[pupil_points(parts)]


def off(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(n,) distances over that of the outer eye corners."""
    marks = head()[1]
    return np.asarray(np.linalg.norm(found - truth, axis=1) / np.linalg.norm(marks[36] - marks[45]))


def test_many_points_of_the_skin_are_found_where_they_are() -> None:
    found, marks, dense, pupils = head()
    assert found.dense.shape == dense.shape
    assert off(found.dense, dense).mean() < 0.05
    assert off(found.landmarks, marks)[17:].mean() < 0.03
    assert found.pupils is not None
    assert off(found.pupils[:, :2], pupils).max() < 0.04


def test_points_that_count_little_are_those_that_are_far_off() -> None:
    found, _, dense, _ = head()
    assert 0 < found.dense_confidence.min() <= found.dense_confidence.max() <= 1
    error, order = off(found.dense, dense), np.argsort(found.dense_confidence)
    half = len(order) // 2
    assert error[order[:half]].mean() > 1.2 * error[order[half:]].mean()


def test_the_file_says_where_it_comes_from() -> None:
    import onnx

    path = dense_landmark_model()
    assert path.stat().st_size < 6_200_000
    model = onnx.load(path)
    described = json.loads(next(prop.value for prop in model.metadata_props if prop.key == "facepipe.features"))
    assert described["kind"] == "dense-landmarks"
    assert "synthetic" in described["trained_on"]
    assert "--seed" in described["training"]
    mirrored = np.array(described["mirrored"])
    np.testing.assert_array_equal(mirrored[mirrored], np.arange(len(mirrored)))


def test_the_file_is_the_network_of_this_code() -> None:
    """Exported weights give in onnxruntime what torch gives."""
    sys.path.insert(0, str(REPOSITORY / "training"))
    from landmark_export import dense_onnx
    from landmark_network import MEAN, STD, DenseNetwork

    torch.manual_seed(1)
    network, size = DenseNetwork(5), DenseNetwork.SIZE
    images = torch.rand(2, 3, size, size)
    with torch.no_grad():
        network((images - MEAN) / STD)  # running means of the normalisation
        landmarks, doubt = network.eval()((images - MEAN) / STD)
    described = {"kind": "dense-landmarks", "size": size, "zoom": 1.2, "mirrored": [0], "mean": [MEAN] * 3}
    found, errors = DenseLandmarkSession(dense_onnx(network, described | {"std": [STD] * 3}))(images.numpy())
    np.testing.assert_allclose(found, landmarks.numpy() * size, atol=2e-3)
    np.testing.assert_allclose(errors, 2 * doubt.exp().numpy(), rtol=1e-3)


def test_networks_of_another_kind_are_refused() -> None:
    with pytest.raises(InputError, match=r"expected 'facepipe\.features' of kind dense-landmarks"):
        DenseLandmarkSession(landmark_model())
