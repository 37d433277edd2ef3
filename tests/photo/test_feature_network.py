"""The shipped feature network, on renders of a sample head that no training has seen."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import numpy_helper
from PIL import Image, ImageDraw
from with_torch import torch

from facepipe import heads
from facepipe.networks.files import sample_crop
from facepipe.networks.onnx_file import CLASSES
from facepipe.parts import FaceParts
from facepipe.photo.features.extractor import Extractor, load_extractor
from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.face_model import FaceModel, Look, opaque_surfaces
from facepipe.photo.renderer.light import ambient, distant
from facepipe.photo.renderer.rasterise import rasterise
from facepipe.pictures.camera import portrait

pytestmark = pytest.mark.needs_torch

FILE = Path(str(files("facepipe.networks") / "face_features.onnx"))
SEED = 41  # of a sample that training does not draw
SIZE = 224  # pixels a side of the renders
PERSONS = 8
IGNORED = -1  # the neck, which is face to some and background to others

_UPPER_LIP = (48, 49, 50, 51, 52, 53, 54, 64, 63, 62, 61, 60)
_LOWER_LIP = (48, 60, 67, 66, 65, 64, 54, 55, 56, 57, 58, 59)


@dataclass(frozen=True)
class Portrait:
    """A render and what it shows."""

    crop: torch.Tensor  # (1, 3, s, s) sRGB
    labels: np.ndarray  # (s / 2, s / 2) classes, in the same crop


@cache
def network() -> Extractor:
    return load_extractor(FILE)


@cache
def subject() -> tuple[FaceParts, FaceModel]:
    """With brows and hair that are no longer cut out of their cards: the renderer leaves out what is not opaque."""
    parts = heads.make(SEED, textures=128, controls="bones")
    shown = [
        replace(material, opacity=1.0) if material.name in ("Brows", "Hair") else material
        for material in parts.materials
    ]
    parts = replace(parts, materials=tuple(shown))
    return parts, FaceModel(parts)


@cache
def triangle_classes() -> np.ndarray:
    """Of the opaque triangles, all but the lips and the sides of the brows."""
    parts, _ = subject()
    names = {"EyeballLeft": "leftEye", "EyeballRight": "rightEye", "Hair": "hair", "Head": "face"}
    of_points = np.concatenate(
        [np.full(len(mesh.points), CLASSES.index(names.get(mesh.name, "teeth"))) for mesh in parts.meshes]
    )
    head = parts.meshes[0]
    of_points[: len(head.points)][np.asarray(head.regions["nose"]) > 0.5] = CLASSES.index("nose")
    of_points[: len(head.points)][np.asarray(head.regions["neck"]) > 0.5] = IGNORED
    first = sum(len(one.points) for one in parts.meshes[: [mesh.name for mesh in parts.meshes].index("Brows")])
    brows = next(mesh for mesh in parts.meshes if mesh.name == "Brows").points
    of_points[first : first + len(brows)] = np.where(
        brows[:, 0] > 0, CLASSES.index("leftBrow"), CLASSES.index("rightBrow")
    )
    return of_points[opaque_surfaces(parts).triangles].min(axis=1)


def random_sliders(rng: np.random.Generator) -> torch.Tensor:
    """(s,) values in their ranges; those of expressions and of what can't be seen from the front at rest."""
    sliders = subject()[1].rig.sliders
    lower, upper, default = (one.numpy() for one in (sliders.lower, sliders.upper, sliders.default))
    free = np.isin(sliders.names, network().names)
    return torch.as_tensor(np.where(free, rng.uniform(lower, upper), default), dtype=torch.float32)


def random_look(rng: np.random.Generator, points: np.ndarray, turned: float) -> Look:
    """Up to so many radians from the front, in soft light with a strong side, before one colour."""
    view = float(rng.uniform(-1, 1) * turned), float(rng.uniform(-0.4, 0.4) * turned)
    seen = portrait(points, view, SIZE, SIZE)
    way = rng.normal(size=3) * (1, 0.6, 0.3) + (0, 0.3, 1)
    key = way / np.linalg.norm(way), rng.uniform(0.3, 1.2, 3)
    side = distant(*(torch.as_tensor(one, dtype=torch.float32) for one in key))
    light = ambient(torch.as_tensor(rng.uniform(0.3, 0.6, 3), dtype=torch.float32)) + side
    camera = Camera.at(seen.axes, seen.eye, seen.focal, seen.center)
    return Look(camera=camera, light=light, background=torch.as_tensor(rng.random(3), dtype=torch.float32))


def taken(sliders: torch.Tensor, rng: np.random.Generator, turned: float) -> Portrait:
    """A portrait of the head in another light, and from elsewhere each time if it may be turned."""
    parts, model = subject()
    points = model.rig(sliders)
    look = random_look(rng, points.numpy(), turned)
    linear = model.image(points, look, height=SIZE, width=SIZE)[..., :3].clamp(0, 1)
    image = torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp(min=1e-6) ** (1 / 2.4) - 0.055)
    screen = look.camera.project(points)
    marks = screen[:, :2].numpy()[parts.meshes[0].landmarks["multipie68"].indices]
    raster = rasterise(screen, torch.as_tensor(opaque_surfaces(parts).triangles), SIZE, SIZE)
    labels = np.zeros(SIZE * SIZE, int)
    labels[raster.pixels.numpy()] = triangle_classes()[raster.triangles.numpy()]
    labels = labels.reshape(SIZE, SIZE)
    for corners, name in ((_UPPER_LIP, "upperLip"), (_LOWER_LIP, "lowerLip")):
        mask = Image.new("1", (SIZE, SIZE))
        ImageDraw.Draw(mask).polygon([tuple(one) for one in marks[list(corners)]], fill=1)
        labels[np.asarray(mask) & (labels == CLASSES.index("face"))] = CLASSES.index(name)
    matrix, half = network().crop_matrix(marks), network().size // 2
    places = np.stack(np.meshgrid(*[(np.arange(half) + 0.5) * 2] * 2), axis=-1) @ matrix[:, :2].T + matrix[:, 2]
    column, row = np.clip(places.astype(int), 0, SIZE - 1).reshape(-1, 2).T
    crop = sample_crop(image, matrix, network().size)
    return Portrait(crop, labels[row, column].reshape(half, half))


@cache
def gallery() -> tuple[tuple[Portrait, ...], dict[str, Any]]:
    """Portraits of some persons, of each two from the front and one from elsewhere, and their features."""
    rng = np.random.default_rng(0)
    persons = [random_sliders(rng) for _ in range(PERSONS)]
    portraits = tuple(taken(person, rng, turned) for person in persons for turned in (0.0, 0.0, 0.4))
    with torch.no_grad():
        features = network().features(torch.cat([one.crop for one in portraits]))
    return portraits, features


def test_the_file_is_small_and_says_what_it_was_trained_on() -> None:
    data = FILE.read_bytes()
    assert len(data) < 5_000_000
    model = onnx.load_from_string(data)
    onnx.checker.check_model(model, full_check=True)
    (said,) = (json.loads(prop.value) for prop in model.metadata_props if prop.key == "facepipe.features")
    assert "synthetic heads" in said["trained_on"]
    assert said["command"].startswith("python training/train_features.py")
    assert said["command"].endswith(f"--seed {said['seed']}")
    assert set(said["held_out"]) >= {"intersection_over_union", "verification", "attribute_error"}
    assert not re.search(r'[\s"=]/\w', json.dumps(said)), "a path of the machine it was made on"
    for one in model.graph.initializer:
        assert np.isfinite(numpy_helper.to_array(one)).all()


def test_one_forward_gives_all_kinds_as_onnxruntime_does() -> None:
    extractor = network()
    assert extractor.kinds == ("content", "identity", "attributes")
    pictures = torch.rand(2, 3, extractor.size, extractor.size, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        found = extractor.features(pictures)
        fed = extractor.normalize(pictures).numpy()
    flat = [*found["content"], found["identity"], found["attributes"]]
    session = onnxruntime.InferenceSession(FILE, providers=["CPUExecutionProvider"])
    for ours, theirs in zip(flat, session.run(None, {"image": fed}), strict=True):
        np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-4)


def test_outputs_are_features_of_several_depths_probabilities_a_unit_vector_and_shares() -> None:
    _, features = gallery()
    sides = [one.shape[-1] for one in features["content"]]
    assert len(sides) == 4
    assert sides[:3] == sorted(sides[:3], reverse=True)
    probabilities = features["content"][-1].numpy()
    assert probabilities.shape[1:] == (len(CLASSES), 64, 64)
    assert probabilities.min() >= 0
    np.testing.assert_allclose(probabilities.sum(axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(features["identity"].numpy(), axis=1), 1, atol=1e-5)
    attributes = features["attributes"].numpy()
    assert attributes.shape[1] == len(network().names)
    assert 0 <= attributes.min() <= attributes.max() <= 1


def test_probabilities_have_gradients_to_the_picture() -> None:
    picture = gallery()[0][0].crop.clone().requires_grad_()
    network()(picture)[-1][:, CLASSES.index("nose")].sum().backward()
    assert picture.grad.abs().sum() > 0


def test_semantics_name_the_parts_of_a_head() -> None:
    portraits, features = gallery()
    found = features["content"][-1].argmax(dim=1).numpy()
    truth = np.stack([one.labels for one in portraits])
    known = truth != IGNORED
    overlap = {
        name: ((found == i) & (truth == i)).sum() / (((found == i) | (truth == i)) & known).sum()
        for i, name in enumerate(CLASSES)
        if name != "teeth"  # the mouths are shut
    }
    assert np.mean(list(overlap.values())) > 0.6, overlap


def test_one_head_in_other_light_is_nearer_than_other_heads() -> None:
    embeddings = gallery()[1]["identity"].numpy().reshape(PERSONS, 3, -1)
    cosines = embeddings[:, 0] @ embeddings[:, 1].T  # all from the front, each in a light of its own
    others = cosines[~np.eye(PERSONS, dtype=bool)].reshape(PERSONS, -1)
    nearer = (cosines.diagonal()[:, None] > others).mean()
    assert nearer > 0.6


def test_content_depends_on_the_head_and_its_pose_more_than_on_light() -> None:
    for features in gallery()[1]["content"]:
        one, other, turned = features.reshape(PERSONS, 3, -1).unbind(1)
        assert (one - other).abs().mean() < (one - turned).abs().mean()
