"""Networks for first guesses of photo fits: what training lowers, what files hold, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from command_line import done, failed, run
from PIL import Image
from small_head import make
from with_torch import torch

from facepipe.core.errors import FacepipeError, InputError
from facepipe.geometry.face_crops import from_crop
from facepipe.parts import FaceParts
from facepipe.performing import read_kept
from facepipe.photo.amortised.guess import Guess, load_start
from facepipe.photo.amortised.network import POSE_MEAN, POSE_STD, SIZE, Output, held, start_graph
from facepipe.photo.amortised.pictures import HEAD, CropSpace, Picture, Portraits, random_people
from facepipe.photo.amortised.training import PictureLoss, Trained, relative_pose, start_metadata, train_start
from facepipe.photo.descent.fit import fit_photos, pose_space
from facepipe.photo.descent.joint_loss import single
from facepipe.photo.descent.landmark_fit import State
from facepipe.photo.descent.landmark_rig import LandmarkRig
from facepipe.photo.descent.subject import FOCAL, Subject
from facepipe.photo.fit import FitPhoto
from facepipe.photo.options import PhotoFitOptions, StartOptions
from facepipe.photo.renderer.face_model import FaceModel, Look
from facepipe.photo.renderer.light import ambient
from facepipe.stage import save_parts

pytestmark = pytest.mark.needs_torch

TINY = StartOptions(people=4096, renders=16, epochs=2, steps=2)
LEAST = ("--people", "0", "--renders", "8", "--epochs", "0", "--steps", "1")


@pytest.fixture(scope="module")
def parts() -> FaceParts:
    return make(0)


@pytest.fixture(scope="module")
def subject(parts: FaceParts) -> Subject:
    return Subject.of(parts)


@pytest.fixture(scope="module")
def portraits(subject: Subject) -> Portraits:
    return Portraits(subject, FaceModel(subject.parts, largest_texture=64), LandmarkRig.from_subject(subject))


@pytest.fixture(scope="module")
def trained(parts: FaceParts) -> Trained:
    return train_start(parts, TINY)


@pytest.fixture(scope="module")
def network_file(trained: Trained, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("network") / "start.onnx"
    path.write_bytes(start_graph(trained.network, start_metadata(trained, TINY)))
    return path


@pytest.fixture(scope="module")
def face(parts: FaceParts, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("face") / "head.usdc"
    save_parts(parts, path)
    return path


def photo_of(portraits: Portraits, seed: int) -> tuple[np.ndarray, Picture]:
    picture = portraits.picture(np.random.default_rng(seed))
    return picture.pixels.astype(np.float32) / 255, picture


@pytest.mark.parametrize("up_axis", ["Y", "Z"])
def test_poses_go_to_crops_and_back(subject: Subject, up_axis: str) -> None:
    rng = np.random.default_rng(0)
    angle, scale = rng.uniform(-1, 1, 20), rng.uniform(0.3, 3, 20)
    turn = scale[:, None, None] * np.stack([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]).transpose(
        2, 0, 1
    )
    crops = np.concatenate([turn, rng.uniform(0, 90, (20, 2, 1))], axis=2)
    space = CropSpace(space=pose_space(subject, 200, 150), crop=crops, side=SIZE, up_axis=up_axis)
    relative = torch.as_tensor(np.array(POSE_MEAN) + rng.normal(0, 0.2, (20, 7)))
    assert (space.to_crop(space.to_photo(relative)) - relative).abs().max() < 1e-9


def test_a_turned_photo_shows_the_same_face_in_its_crop(subject: Subject, portraits: Portraits) -> None:
    """What is relative to the crop is what it was, when the picture is turned about its middle."""
    people = random_people(subject, portraits.space, 1, np.random.default_rng(1))
    camera = portraits.space.camera(torch.as_tensor(people.poses[0]))
    whole = CropSpace(space=portraits.space, crop=np.eye(2, 3), side=HEAD, up_axis="Y")
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])  # about the middle of the picture
    turned = replace(whole, crop=np.column_stack([turn, HEAD / 2 * (1 - turn.sum(axis=1))]))
    pose = turned.to_photo(whole.to_crop(torch.as_tensor(people.poses[0])))
    points = torch.as_tensor(subject.rig.points[::50])
    before = camera.project(points)[:, :2].numpy()
    after = portraits.space.camera(pose).project(points)[:, :2].numpy()
    np.testing.assert_allclose(after, from_crop(before, turned.crop), atol=1e-6)


def test_renders_show_the_face_where_the_landmarks_are(subject: Subject, portraits: Portraits) -> None:
    """Landmarks within the contour lie on the head that the truth stands for, the picture's corners beside it."""
    _, picture = photo_of(portraits, 5)
    assert picture.truth is not None
    sliders = torch.as_tensor(subject.slider_values(picture.truth.shares), dtype=torch.float32)
    weights = torch.as_tensor(subject.shape_weights(picture.truth.expressions), dtype=torch.float32)
    camera = single(picture.space.camera(torch.as_tensor(picture.truth.pose)))
    look = Look(camera=camera, light=ambient(torch.ones(3)), background=torch.zeros(3))
    covered = portraits.model(sliders, weights, look, height=HEAD, width=HEAD)[..., 3].numpy()
    x, y = picture.landmarks[17:].astype(int).T
    assert covered[y, x].mean() > 0.98
    assert covered[y, x].min() > 0
    assert covered[0, 0] == covered[0, -1] == 0
    edge = picture.pixels.astype(int)[covered == 0].mean(axis=0)
    assert np.abs(picture.pixels.astype(int)[y, x].mean(axis=0) - edge).max() > 10


def test_the_joint_loss_knows_the_lamp_of_a_render(subject: Subject, portraits: Portraits) -> None:
    """The truth explains a render in its lamp, with the shadows that it casts, far better than in harmonics alone."""
    terms = PhotoFitOptions(content=0.0, identity=0.0, attributes=0.0, hue=0.0)
    loss = PictureLoss(subject, portraits.model, portraits.landmarks, terms)
    ratios = []
    for seed in range(6):
        picture = portraits.picture(np.random.default_rng(seed))
        crop = picture.crop(picture.landmarks)
        assert picture.truth is not None
        pose = crop.space(picture.space, subject.parts.up_axis).to_crop(torch.as_tensor(picture.truth.pose)).numpy()
        values = (picture.truth.shares, picture.truth.expressions, (pose - POSE_MEAN) / POSE_STD)
        right = Output(*(torch.as_tensor(value, dtype=torch.float32)[None] for value in values))
        with torch.no_grad():
            lit = float(loss(picture, crop, picture.landmarks, right)["color"])
            dark = float(loss(replace(picture, truth=None), crop, picture.landmarks, right)["color"])
        ratios.append(lit / dark)
    assert max(ratios) < 1
    assert np.mean(ratios) < 0.6


def test_gradients_pass_where_values_are_cut() -> None:
    values = torch.tensor([-0.5, 0.25, 1.5], requires_grad=True)
    result = held(values)
    result.sum().backward()
    assert result.tolist() == [0.0, 0.25, 1.0]
    assert values.grad.tolist() == [1.0, 1.0, 1.0]


def test_training_lowers_the_joint_loss_of_pictures_that_it_has_not_seen(trained: Trained) -> None:
    assert trained.held_out == 4
    assert trained.after["total"] < 0.8 * trained.before["total"]
    assert trained.after["landmarks"] < 0.6 * trained.before["landmarks"]
    assert not trained.warnings


@pytest.mark.slow
def test_the_same_seed_gives_the_same_file(parts: FaceParts) -> None:
    options = StartOptions(people=256, renders=8, epochs=1, steps=1)
    once, again = (train_start(parts, options) for _ in range(2))
    files = [start_graph(one.network, start_metadata(one, options)) for one in (once, again)]
    assert files[0] == files[1]
    other = train_start(parts, replace(options, seed=1, people=0, epochs=0, steps=0))
    assert other.before != once.before


def test_the_file_gives_what_the_network_gives(
    trained: Trained, network_file: Path, subject: Subject, portraits: Portraits
) -> None:
    guess = load_start(network_file, subject)
    photo, picture = photo_of(portraits, 3)
    crop = Picture.from_photo(photo, picture.landmarks, picture.space).crop(picture.landmarks)
    with torch.no_grad():
        found = trained.network(crop.image[None], crop.landmarks[None])
        pose = crop.space(picture.space, "Y").to_photo(relative_pose(found.pose))
    state = guess(photo, picture.landmarks, picture.space)
    np.testing.assert_allclose(state.shares, found.shares[0].clamp(0, 1), atol=1e-4)
    np.testing.assert_allclose(state.expressions, found.expressions.clamp(0, 1), atol=1e-4)
    np.testing.assert_allclose(state.poses, pose, atol=1e-4)


def test_guesses_are_near_the_truth(network_file: Path, subject: Subject, portraits: Portraits) -> None:
    """Poses of people that training has not seen: better than facing the camera."""
    guess, errors, plain = load_start(network_file, subject), [], []
    for seed in range(100, 110):
        photo, picture = photo_of(portraits, seed)
        assert picture.truth is not None
        turn = guess(photo, picture.landmarks, picture.space).poses[0, :3]
        errors.append(np.linalg.norm(turn - picture.truth.pose[:3]))
        plain.append(np.linalg.norm(picture.truth.pose[:3]))
    assert np.mean(errors) < 0.5 * np.mean(plain)


def test_several_photos_share_the_person(network_file: Path, subject: Subject, portraits: Portraits) -> None:
    guess = load_start(network_file, subject)
    photos, pictures = zip(*(photo_of(portraits, seed) for seed in (3, 4)), strict=True)
    alone = [guess(photo, one.landmarks, one.space) for photo, one in zip(photos, pictures, strict=True)]
    both = guess.together(photos, [picture.landmarks for picture in pictures], [picture.space for picture in pictures])
    np.testing.assert_allclose(both.shares, (alone[0].shares + alone[1].shares) / 2)
    np.testing.assert_array_equal(both.poses[1], alone[1].poses[0])
    np.testing.assert_array_equal(both.expressions[1], alone[1].expressions[0])


def test_the_order_of_sliders_does_not_matter(network_file: Path, parts: FaceParts, portraits: Portraits) -> None:
    photo, picture = photo_of(portraits, 3)
    here, there = Subject.of(parts), Subject.of(replace(parts, sliders=parts.sliders[::-1]))
    one, other = (load_start(network_file, own)(photo, picture.landmarks, picture.space) for own in (here, there))
    values = [
        dict(zip([slider.name for slider in own.free_sliders], state.shares, strict=True))
        for own, state in ((here, one), (there, other))
    ]
    assert values[0] == values[1]


def described(path: Path) -> dict[str, Any]:
    return dict(json.loads({prop.key: prop.value for prop in onnx.load(path).metadata_props}["facepipe.photo"]))


def test_the_file_says_what_it_is(network_file: Path, subject: Subject) -> None:
    metadata, model = described(network_file), onnx.load(network_file)
    assert network_file.stat().st_size < 5_000_000
    assert (model.ir_version, model.opset_import[0].version) == (8, 15)
    assert [one["name"] for one in metadata["sliders"]] == [slider.name for slider in subject.free_sliders]
    assert metadata["trained_on"] == "16 renders of FACE"
    assert metadata["further_operators"] == ["Conv"]
    assert set(metadata["held_out"]["after"]) >= {"landmarks", "color", "total"}
    assert "/" not in metadata["training"]


def changed(subject: Subject, how: str) -> Subject:
    parts = subject.parts
    first = subject.sliders[0]
    if how == "one slider less":
        return Subject.of(replace(parts, sliders=(*parts.sliders[:first], *parts.sliders[first + 1 :])))
    if how == "another range":
        wider = replace(parts.sliders[first], maximum=2.0)
        return Subject.of(replace(parts, sliders=(*parts.sliders[:first], wider, *parts.sliders[first + 1 :])))
    return Subject.of(parts, ["jawOpen"])


@pytest.mark.parametrize("how", ["one slider less", "another range", "other expressions"])
def test_networks_of_other_faces_are_refused(network_file: Path, subject: Subject, how: str) -> None:
    with pytest.raises(InputError, match=r"start\.onnx: made for another face"):
        load_start(network_file, changed(subject, how))


def test_files_that_are_no_such_network_are_refused(network_file: Path, subject: Subject, tmp_path: Path) -> None:
    model = onnx.load(network_file)
    del model.metadata_props[:]
    (tmp_path / "bare.onnx").write_bytes(model.SerializeToString())
    (tmp_path / "cut.onnx").write_bytes(network_file.read_bytes()[:100_000])
    (tmp_path / "text.onnx").write_text("no model")
    for name in ("bare.onnx", "cut.onnx", "text.onnx", "none.onnx"):
        with pytest.raises(FacepipeError, match=name):
            load_start(tmp_path / name, subject)


def test_numbers_that_are_none_are_refused(
    network_file: Path, subject: Subject, portraits: Portraits, tmp_path: Path
) -> None:
    model = onnx.load(network_file)
    bias = next(one for one in model.graph.initializer if one.name == "last_bias")
    bias.CopyFrom(onnx.numpy_helper.from_array(np.full(bias.dims, np.inf, np.float32), "last_bias"))
    path = tmp_path / "nan.onnx"
    path.write_bytes(model.SerializeToString())
    guess: Guess = load_start(path, subject)
    photo, picture = photo_of(portraits, 3)
    with pytest.raises(InputError, match=r"nan\.onnx: gives NaN"):
        guess(photo, picture.landmarks, picture.space)


def test_the_command_writes_a_network_for_the_face(
    face: Path, subject: Subject, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "start.onnx"
    text = done(capsys, "train-photo", face, "-o", out, *LEAST, "--json")
    assert json.loads(text)["held_out"]["pictures"] == 2
    assert load_start(out, subject).metadata["training"].endswith("--steps 1 --seed 0")
    code, _, err = run(capsys, "train-photo", face, "-o", out, *LEAST)
    assert (code, "--force" in err) == (2, True)


def test_photos_without_labels_are_learnt_from(
    face: Path, portraits: Portraits, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "people"
    folder.mkdir()
    for seed in range(5):
        _, picture = photo_of(portraits, seed)
        Image.fromarray(picture.pixels).save(folder / f"{seed}.png")
        (folder / f"{seed}.png.landmarks.json").write_text(json.dumps({"multipie68": picture.landmarks.tolist()}))
    Image.new("RGB", (80, 80), "grey").save(folder / "wall.png")
    (folder / "notes.txt").write_text("nothing to see")
    out = tmp_path / "start.onnx"
    words = ("--images", folder, "--renders", "0", "--people", "0", "--steps", "1", "--json")
    text = done(capsys, "train-photo", face, "-o", out, *words, quiet=False)
    result = json.loads(text)
    assert (result["photos"], result["held_out"]["pictures"]) == (5, 1)
    assert len(result["warnings"]) == 1
    assert "wall.png" in result["warnings"][0]
    assert described(out)["trained_on"].startswith("5 photos without labels")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("-o", "start.bin"), "expected .onnx"),
        (("-o", "no/start.onnx"), "the folder does not exist"),
        (("-o", "start.onnx", "--images", "nowhere"), "is no folder"),
        (("-o", "start.onnx", "--images", "."), "no usable face"),
        (("-o", "start.onnx", "--renders", "3", "--people", "0"), "expected 4 or more"),
        (("-o", "start.onnx", "--steps", "-1"), "steps"),
        (("-o", "start.onnx", "--expression", "grin"), "grin"),
        ((), "-o"),
    ],
)
def test_bad_input_is_one_line(
    face: Path,
    words: tuple[str, ...],
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert expected in failed(capsys, "train-photo", face, *words)


def test_a_face_without_sliders_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_parts(replace(make(0), sliders=()), tmp_path / "bare.usdc")
    err = failed(capsys, "train-photo", tmp_path / "bare.usdc", "-o", tmp_path / "start.onnx", folder=tmp_path)
    assert "bare.usdc" in err
    assert "sliders" in err


def test_lenses_of_random_people_are_those_of_portraits(subject: Subject, portraits: Portraits) -> None:
    people = random_people(subject, portraits.space, 500, np.random.default_rng(0))
    focal = people.poses[:, 5] + people.poses[:, 6]
    assert abs(np.median(focal) - np.log(FOCAL)) < 0.1
    assert ((people.shares >= 0) & (people.shares <= 1)).all()
    assert ((people.expressions >= 0) & (people.expressions <= 1)).all()


@pytest.mark.gate
@pytest.mark.slow
def test_a_fit_begins_at_the_guess_where_that_is_better(
    network_file: Path, subject: Subject, portraits: Portraits
) -> None:
    """From the truth as a guess the descent begins at the truth; from a poor guess after stage one, as without it.

    Landmarks outweigh the prior: a random person has 0.8 of joint loss in the truth, and 0.3 in stage one, else.
    """
    photo, picture = photo_of(portraits, 7)
    assert picture.truth is not None
    options = PhotoFitOptions(iterations=1, size=96, landmarks=20.0, content=0.0, identity=0.0, attributes=0.0)
    true = State(
        shares=picture.truth.shares, expressions=picture.truth.expressions[None], poses=picture.truth.pose[None]
    )
    poor = State(shares=1 - true.shares, expressions=0.5 + 0 * true.expressions, poses=true.poses + 0.1)
    default, best, worst = (
        fit_photos(subject.parts, [photo], [picture.landmarks], options, start=start).history[0]
        for start in (None, true, poor)
    )
    assert best["landmarks"] < 1e-3 < default["landmarks"]  # stage one would be drawn to the defaults
    assert best["total"] < default["total"]
    assert worst["total"] < 1.5 * default["total"]


@pytest.mark.gate
@pytest.mark.slow
def test_the_fit_command_takes_the_network(
    network_file: Path, face: Path, portraits: Portraits, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, picture = photo_of(portraits, 3)
    Image.fromarray(picture.pixels).save(tmp_path / "photo.png")
    (tmp_path / "photo.json").write_text(json.dumps({"multipie68": picture.landmarks.tolist()}))
    network = tmp_path / "start.onnx"  # beside the person: what a recipe names elsewhere needs --root
    network.write_bytes(network_file.read_bytes())
    words = ["fit-photo", tmp_path / "photo.png", face, "--landmarks", tmp_path / "photo.json", "--iterations", "0"]
    words += ["--size", "64"]
    words += ["-o", tmp_path / "person.usda", "--start", network]
    assert run(capsys, *words)[0] in (0, 1)
    kept = read_kept(tmp_path / "person.usda", FitPhoto).values
    assert kept["start"].samefile(network)
    err = failed(
        capsys, "fit-photo", "--edit", tmp_path / "person.usda", "--expression", "jawOpen", "--force", folder=tmp_path
    )
    assert "made for another face" in err
