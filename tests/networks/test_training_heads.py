"""The scripts that made the shipped networks, on a few pictures of the people that they draw."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from shutil import copyfile

import code_of_training  # noqa: F401  (finds the modules of training/)
import dense_heads
import features_data
import features_geometry
import features_heads
import head_sources
import heads
import landmark_data
import mask_heads
import moderngl
import numpy as np
import photo_scores
import pictures as pictures_of
import pytest
import scenes
import train_dense
import train_features
import train_landmarks
import train_mask
from landmark_export import mask_onnx, to_onnx
from with_torch import torch

from facepipe.geometry.colors import to_srgb
from facepipe.geometry.face_crops import TEMPLATE, to_crop
from facepipe.heads.asset import asset
from facepipe.networks.files import LandmarkSession, MaskNetwork
from facepipe.networks.onnx_file import CLASSES
from facepipe.pictures.draw import draw
from facepipe.pictures.scene import build_scene
from facepipe.pictures.shade import Shader

pytestmark = pytest.mark.needs_torch

PARTS = {"leftBrow": slice(22, 27), "rightBrow": slice(17, 22), "nose": slice(27, 36), "lowerLip": slice(54, 60)}


@cache
def needs_opengl() -> None:
    """Skips a test where there is no driver: Debian has one in ``libgl1-mesa-dri`` and ``libegl1``.

    Once: a context that ends takes the place of the one that draws.
    """
    try:
        moderngl.create_context(standalone=True, backend="egl", require=330).release()
    except Exception as error:  # moderngl has no class of its own
        pytest.skip(f"no OpenGL by EGL: {error}")


@cache
def pictures() -> list[heads.Arrays]:
    """Two pictures each of one person in a look of their own and of two who change it."""
    same, other = (np.random.default_rng(seed) for seed in (2, 3))
    changing = [row for number in (1, 2) for row in features_heads.person(number, 2, 1.0, other)]
    return [*heads.person(0, same, poses=1, views=2), *changing]


def test_landmarks_lie_where_the_labels_have_their_parts() -> None:
    rng = np.random.default_rng(5)
    who = head_sources.Person(rng, by_sliders=False)
    subject = who.dressed(who.look, rng)
    scene = build_scene(subject.face, subject.neutral(), scenes.SIZE)
    behind, place = np.full((scenes.SIZE, scenes.SIZE, 3), 0.5), scenes.Placement(1.0, 0.0, np.zeros(2))
    for _ in range(3):
        view = scenes.render(scene, who.look, place, behind, rng)
        for name, numbers in PARTS.items():
            rows, columns = np.nonzero(view.labels == CLASSES.index(name))
            middle = np.array([columns.mean(), rows.mean()]) + 0.5
            assert np.linalg.norm(view.landmarks[numbers].mean(axis=0) - middle) < 0.06 * scenes.SIZE, name


@pytest.mark.slow
def test_people_are_drawn_alike_by_the_same_numbers_and_not_by_others() -> None:
    (again,) = heads.person(0, np.random.default_rng(2), poses=1, views=1)  # the first of two views
    first = pictures()[0]
    assert first.keys() == again.keys()
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert not np.array_equal(again["landmarks"], pictures()[2]["landmarks"])


def test_a_person_who_changes_looks_keeps_the_shape() -> None:
    one, other = pictures()[2:4]
    assert np.array_equal(one["neutral"], other["neutral"])
    assert np.array_equal(one["attributes"], other["attributes"])
    assert one["attribute_mask"].all()
    assert not np.array_equal(one["image"], other["image"])


def test_shards_are_read_with_faces_where_their_crops_expect_them(tmp_path: Path) -> None:
    heads.write_shard(pictures()[2:], tmp_path / "looks_000.npz")
    read = features_data.read([tmp_path])
    assert read.names == head_sources.slider_names()
    assert read.changing.all()
    target = TEMPLATE * 2 - 1
    assert np.sqrt(((read.marks - target) ** 2).sum(axis=2).mean()) < 0.2
    geometry = features_geometry.marks_of(
        head_sources.Person(np.random.default_rng(1), by_sliders=True).bare(), np.random.default_rng(1)
    )
    assert np.sqrt(((geometry - TEMPLATE) ** 2).sum(axis=1).mean()) < 0.1


@pytest.mark.slow
def test_training_of_features_lowers_the_loss_on_their_classes(tmp_path: Path) -> None:
    heads.write_shard(pictures()[2:], tmp_path / "looks_000.npz")
    read = features_data.read([tmp_path])
    losses = train_features.Losses(read)
    left = {}
    for steps in (1, 8):
        torch.manual_seed(0)
        network = train_features.train(read, steps, 0)
        with torch.no_grad():
            terms = losses(network.train(), np.arange(len(read)), torch.Generator().manual_seed(0))
        assert all(torch.isfinite(term) for term in terms.values())
        left[steps] = terms["semantics"].item()
    assert left[8] < left[1]


@pytest.mark.slow
def test_training_lowers_the_loss_and_gives_a_network_that_facepipe_reads() -> None:
    shown = pictures() * 8
    known = landmark_data.Heads(
        images=np.stack([one["image"] for one in shown]),
        landmarks=np.stack([one["landmarks"] for one in shown]) / scenes.SIZE,
        presence=np.ones(len(shown), np.float32),
    )
    rows = np.arange(6)
    steps = {}
    for count in (1, 30):
        network = train_landmarks.train(known, count, 0, lambda *_: None)
        with torch.no_grad():
            steps[count] = train_landmarks.joint_loss(network, landmark_data.plain(known, rows)).item()
    assert steps[30] < 0.7 * steps[1]
    session = LandmarkSession(
        to_onnx(network, {"kind": "landmarks", "size": 96, "mean": [0.45] * 3, "std": [0.25] * 3})
    )
    found, presence = session(np.zeros((1, 3, 96, 96), np.float32))
    assert found.shape == (1, 68, 2)
    assert presence.shape == (1,)


@pytest.mark.slow
def test_opengl_draws_heads_as_facepipe_does() -> None:
    needs_opengl()
    size = dense_heads.SIZE
    rng = np.random.default_rng(5)
    who = head_sources.Person(rng, by_sliders=False)
    subject = who.dressed(who.look, rng)
    scene = build_scene(subject.face, subject.pose(rng), size)
    card, behind = dense_heads.shared_card(), np.full((size, size, 3), 0.2, np.float32)
    model = card.load(scene)
    for pose in range(2):
        if pose:
            scene = build_scene(subject.face, subject.pose(rng), size)
            model.pose(scene)
        head = scene.points[: asset().parts["Head"].points.stop]
        camera, _ = scenes.random_camera(head, scenes.Placement(1.0, 0.0, np.zeros(2)), size, rng)
        light = scenes.random_light(who.look, rng)
        drawn = card.draw(model, camera, light, behind).astype(float)
        expected = draw(Shader(scene, camera, lights=light), size, to_srgb(behind).astype(np.float32), 2, 10.0)
        empty = to_srgb(behind) * 255
        assert np.abs(drawn - expected).mean() < 0.1 * np.abs(expected - empty).mean()
    model.release()


@pytest.mark.slow
def test_training_of_many_landmarks_lowers_the_loss_on_pictures_of_their_crops(tmp_path: Path) -> None:
    needs_opengl()
    heads.write_shard(dense_heads.person(np.random.default_rng(6), poses=1, views=4), tmp_path / "dense_000.npz")
    known = train_dense.Heads(tmp_path, range(9), "cpu")
    images, points = known.batch(np.arange(4), None)
    assert images.shape == (4, 3, 192, 192)
    assert np.abs(points[:, :68].mean(dim=0).numpy() - ((TEMPLATE - 0.5) * 1.2 + 0.5)).mean() < 0.1
    _, mirrored = known.batch(np.tile(np.arange(4), 6), np.random.default_rng(0))  # about half of them
    assert (mirrored[:, 36, 0] < mirrored[:, 45, 0]).all()
    copyfile(tmp_path / "dense_000.npz", tmp_path / "dense_001.npz")  # a file that comes later
    known.grow()
    known.grow()
    assert len(known.images) == 8
    left = {}
    for count in (1, 12):
        network = train_dense.train(known, count, 0, lambda *_: None)
        with torch.no_grad():
            left[count] = train_dense.expected_error_loss(network.train(), images, points).item()
    assert left[12] < 0.8 * left[1]


@pytest.mark.slow
def test_training_of_masks_lowers_the_loss_on_heads_with_hair_and_things_in_front(tmp_path: Path) -> None:
    needs_opengl()
    rows = mask_heads.person(np.random.default_rng(3))[:8]
    heads.write_shard(rows, tmp_path / "mask_000.npz")
    known = train_mask.Heads(tmp_path, range(9), "cpu")
    images, shares = known.batch(np.arange(len(rows)), None)
    assert images.shape == (len(rows), 3, 192, 192)
    assert np.abs(shares.sum(dim=1).numpy() - 1).max() < 0.01
    face, hair, other = shares.mean(dim=(0, 2, 3)).tolist()
    assert min(face, other) > 0.1
    assert hair > 0.02
    left = {}
    for count in (1, 12):
        network = train_mask.train(known, count, 0, lambda *_: None)
        with torch.no_grad():
            left[count] = train_mask.cross_entropy(network.train(), images, shares).item()
    assert left[12] < 0.8 * left[1]
    described = {"kind": "face-mask", "size": 192, "classes": ["face", "hair", "other"]}
    session = MaskNetwork(mask_onnx(network, described | {"mean": [0.45] * 3, "std": [0.25] * 3}))
    crops = (images * 0.25 + 0.45).numpy()
    with torch.no_grad():
        expected = network.eval()(images).softmax(dim=1).numpy()
    np.testing.assert_allclose(session(crops), expected, atol=0.01)


def test_a_hand_or_glasses_cover_what_they_are_drawn_over() -> None:
    rng, marks = np.random.default_rng(1), TEMPLATE * 160
    covers = []
    for _ in range(20):
        image = rng.uniform(0.2, 0.8, (160, 160, 3))
        shown, cover = pictures_of.often_occluded(image, marks, rng)
        assert 0 <= cover.min() <= cover.max() <= 1
        assert (shown >= 0.49 * image)[cover == 0].all()  # lenses may be tinted
        assert np.abs(shown - image)[cover == 1].max(initial=1.0) > 0.1
        covers.append(cover)
    assert 0.2 < np.mean([cover.max() > 0.9 for cover in covers]) < 0.9


def test_a_photo_is_scored_in_views_that_show_the_whole_face() -> None:
    marks = TEMPLATE * 80 + (300, 200)
    shown = list(photo_scores.views(marks))
    assert len(shown) == 13
    for name, matrix, side in shown:
        seen = to_crop(marks, matrix)
        assert seen.min() > 0, name
        assert seen.max() < side, name
        assert (np.linalg.det(matrix[:, :2]) < 0) == (name == "mirrored")
