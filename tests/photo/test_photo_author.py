"""What a photo fit found, on the stage: sliders, neutral, poses and cameras of photos, recipe."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import facepipe_gltf
import facepipe_onnx
import gltf_reader
import numpy as np
import pytest
from facepipe_gltf import read as gltf
from faces import tiny_face
from oracle import played
from pxr import Gf, Usd, UsdGeom
from scipy.spatial.transform import Rotation
from small_head import make
from with_torch import tensor

import facepipe
from facepipe.checks import validate
from facepipe.cli.action_line import ActionLine, action_of
from facepipe.cli.parser import Parser
from facepipe.core import tokens
from facepipe.core.errors import FitError, InputError
from facepipe.parts import FaceParts, Material, Recipe, Slider
from facepipe.performing import read_kept, recipe_to
from facepipe.photo.descent.subject import FittedCamera, FittedView, PhotoFit
from facepipe.photo.fit import AuthorPhotoFit, FitPhoto, Photo
from facepipe.photo.fit.author import clipping_range
from facepipe.photo.renderer.camera import Camera
from facepipe.stage import Face, save_parts
from facepipe.stage.values import same
from facepipe.verbs.sliders import SetSliders

pytestmark = pytest.mark.needs_torch

PHOTOS = ("my photo.png", "my-photo.jpg", "2.png")
SIZE = (500, 640)  # width and height
PIXELS = 1e-4
NAN = float("nan")


def photo(name: str, size: tuple[int, int] = SIZE) -> Photo:
    """A photo of which only name and size count."""
    return Photo(pixels=np.zeros((size[1], size[0], 3), np.float32), path=Path("somewhere") / name, size=size)


def camera(rng: np.random.Generator, points: np.ndarray, backward: np.ndarray, up: np.ndarray) -> FittedCamera:
    """A camera that sees all points (n, 3) from about `backward`, its principal point off the middle."""
    axes = np.stack([np.cross(up, backward), up, backward])
    rotation = Rotation.from_rotvec(rng.uniform(-0.4, 0.4, 3)) * Rotation.from_matrix(axes)
    middle, radius = points.mean(axis=0), np.linalg.norm(points - points.mean(axis=0), axis=1).max()
    offset = np.array([*rng.uniform(-0.1, 0.1, 2), -rng.uniform(3, 8)]) * radius
    return FittedCamera(
        rotation=rotation.as_rotvec(),
        translation=offset - rotation.apply(middle),
        focal=float(rng.uniform(800, 1600)),
        center=(float(rng.uniform(150, 350)), float(rng.uniform(200, 450))),
    )


def key_light(rng: np.random.Generator) -> np.ndarray:
    """(8,) numbers of a lamp."""
    direction = rng.normal(size=3)
    return np.array([*direction / np.linalg.norm(direction), *rng.uniform(0, 1, 4), rng.uniform(1, 5)])


def fit_of(face: Face, views: int, seed: int = 0) -> PhotoFit:
    """Random values in their ranges, of all sliders over bones and of expressions beside them."""
    rng = np.random.default_rng(seed)
    sliders = [slider for slider in face.sliders if not slider.shapes]
    backward, up = ([0, -1, 0], [0, 0, 1]) if face.up_axis == "Z" else ([0, 0, 1], [0, 1, 0])
    points = face.evaluate()
    targets = rng.uniform(100, 400, (68, 2))
    return PhotoFit(
        sliders={slider.name: float(rng.uniform(slider.minimum, slider.maximum)) for slider in sliders},
        views=tuple(
            FittedView(
                expressions={name: float(rng.uniform(0, 1)) for name in face.shapes[:6]},
                camera=camera(rng, points, np.array(backward, float), np.array(up, float)),
                light=rng.normal(size=(9, 3)),
                key=key_light(rng),
                landmarks=targets + 1,
                targets=targets,
                landmark_error=float(rng.uniform(0, 3)),
            )
            for _ in range(views)
        ),
        tint={material.name: (1.25, 0.9, 0.8) for material in face.materials[:1]},
        history=({"total": 3.0, "landmarks": 2.0}, {"total": 1.5, "landmarks": 1.0, "identity": 0.5}),
        kept=1,
        steps=2,
        stopped="iterations",
    )


def fitted(source: Path, out: Path, fit: PhotoFit, names: tuple[str, ...] = PHOTOS, **more: object) -> Face:
    with facepipe.open(source).deriving(out, **more) as face:  # type: ignore[arg-type]
        AuthorPhotoFit()(face, fit, [photo(name) for name in names])
    return facepipe.open(out)


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample."""
    path = tmp_path_factory.mktemp("head") / "head.usdc"
    save_parts(make(0), path)
    return path


@pytest.fixture(scope="module")
def fit(head: Path) -> PhotoFit:
    return fit_of(facepipe.open(head), len(PHOTOS))


@pytest.fixture(scope="module")
def person(head: Path, fit: PhotoFit) -> Face:
    """The sample, fitted to three photos."""
    return fitted(head, head.parent / "person.usda", fit)


LOOKS = {"lookLeft": 0.6, "lookDown": -0.4}


def test_eyes_look_where_a_photo_shows_pupils(head: Path, fit: PhotoFit, tmp_path: Path) -> None:
    before = facepipe.open(head)
    pupils = np.concatenate(
        [
            start + mesh.landmarks["pupils"].indices
            for mesh, start in zip(before.meshes, before.rig().mesh_offsets, strict=False)
            if "pupils" in mesh.landmarks
        ]
    )
    view, values = fit.views[0], {name: value for name, value in fit.sliders.items() if name not in LOOKS}
    shown = before.evaluate(dict(view.expressions), sliders=values | LOOKS)
    places, errors = pixels(view.camera, shown[pupils]), np.array([[0.5], [0.5]])  # pixels
    seen = replace(view, pupils=np.hstack([places, errors]))
    face = fitted(head, tmp_path / "looking.usda", replace(fit, sliders=values, views=(seen,)), PHOTOS[:1])
    transforms, weights = face.sample(face.photos[0].animation or "")
    posed = face.evaluate(weights, joint_transforms=transforms)
    np.testing.assert_allclose(pixels(view.camera, posed[pupils]), places, atol=1.0)
    lids = face.evaluate(dict(view.expressions), sliders=values)
    still = np.ones(len(lids), bool)
    for mesh, start in zip(before.meshes, before.rig().mesh_offsets, strict=False):
        if mesh.name.startswith("Eyeball"):
            still[start : start + len(mesh.points)] = False
    np.testing.assert_allclose(posed[still], lids[still], atol=1e-4)


def pixels(camera: FittedCamera, points: np.ndarray) -> np.ndarray:
    """(n, 2) where a camera shows world points."""
    local = Rotation.from_rotvec(camera.rotation).apply(points) + camera.translation
    return np.asarray(camera.focal * local[:, :2] * (1, -1) / -local[:, 2:] + camera.center)


def tiny(up_axis: str, meters_per_unit: float) -> FaceParts:
    """A small face with a slider over bones."""
    slider = Slider(name="jawLeft", channels=(("root/jaw", "tx", 0.5),))
    parts = replace(tiny_face(), sliders=(slider,), materials=(Material(name="Skin"),))
    return replace(parts, up_axis=up_axis, meters_per_unit=meters_per_unit)  # type: ignore[arg-type]


def test_the_neutral_is_the_sliders_alone(head: Path, person: Face, fit: PhotoFit) -> None:
    """What opens the stage shows the identity, as `facepipe sliders --set` makes it: no photo's expression is in it."""
    values = {slider.name: slider.value for slider in person.sliders if slider.name in fit.sliders}
    assert values == {name: float(np.float32(value)) for name, value in fit.sliders.items()}
    expected = person.evaluate(sliders={})
    np.testing.assert_allclose(expected, facepipe.open(head).evaluate(sliders=fit.sliders), atol=1e-5)
    shown = played(Path(str(person.stage.GetRootLayer().realPath)))[0]
    assert np.abs(shown - expected).max() < 1e-3 * person.head_height  # scales of SkelAnimation are halves
    with facepipe.open(head).deriving(head.parent / "set.usda") as other:
        SetSliders(values=fit.sliders)(other)
    both = [facepipe.open(head.parent / name).sample("sliders") for name in ("person.usda", "set.usda")]
    np.testing.assert_array_equal(both[0][0], both[1][0])
    assert both[0][1] == both[1][1]
    assert not any(both[0][1].values())


def test_a_pose_is_the_neutral_with_the_expression_of_its_photo(person: Face, fit: PhotoFit) -> None:
    names = [one.animation for one in person.photos]
    assert len({*names}) == len(names) == len(PHOTOS)
    assert [one.image for one in person.photos] == list(PHOTOS)
    for name, view in zip(names, fit.views, strict=True):
        assert name is not None
        transforms, weights = person.sample(name)
        expected = person.evaluate(view.expressions, sliders={})
        np.testing.assert_allclose(person.evaluate(weights, joint_transforms=transforms), expected, atol=1e-5)


def test_sliders_can_be_set_afterwards(person: Face, fit: PhotoFit, tmp_path: Path) -> None:
    with person.deriving(tmp_path / "edited.usda") as face:
        SetSliders(values={"noseWidth": 1.0})(face)
    edited = facepipe.open(tmp_path / "edited.usda")
    np.testing.assert_allclose(
        edited.evaluate(sliders={}), person.evaluate(sliders={**fit.sliders, "noseWidth": 1.0}), atol=1e-5
    )
    assert [animation.name for animation in edited.animations] == [animation.name for animation in person.animations]
    assert len(edited.photos) == len(PHOTOS)
    assert validate(tmp_path / "edited.usda") == ()


def pixels_of(stage: Usd.Stage, name: str, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(n, 2) pixels where USD's own camera shows world points, which it must not clip."""
    prim = next(one for one in stage.Traverse() if one.IsA(UsdGeom.Camera) and one.GetName() == name)
    frustum = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.Default()).frustum
    matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    seen = np.array([matrix.Transform(Gf.Vec3d(*map(float, point))) for point in points])
    assert (np.abs(seen[:, 2]) < 1).all()
    return (seen[:, :2] * (1, -1) + 1) / 2 * size


def expected_pixels(found: FittedCamera, points: np.ndarray) -> np.ndarray:
    """(n, 2) pixels as the fit's differentiable camera has them."""
    numbers = (found.rotation, found.translation, found.focal, found.center)
    rotation, translation, focal, center = map(tensor, numbers)
    own = Camera(rotation=rotation, translation=translation, focal=focal, center=center)
    return own.project(tensor(points))[:, :2].numpy()


@pytest.mark.parametrize("up_axis", ["Y", "Z"])
@pytest.mark.parametrize("meters_per_unit", [0.001, 0.01, 0.0254, 1.0])
def test_cameras_see_the_stage_as_the_fit_does(tmp_path: Path, up_axis: str, meters_per_unit: float) -> None:
    save_parts(tiny(up_axis, meters_per_unit), tmp_path / "face.usda")
    found = fit_of(facepipe.open(tmp_path / "face.usda"), 3, seed=5)
    face = fitted(tmp_path / "face.usda", tmp_path / "out.usda", found)
    points = face.evaluate(sliders={})
    for view, own in zip(found.views, face.photos, strict=True):
        expected = expected_pixels(view.camera, points)
        assert np.abs(pixels_of(face.stage, own.name, points, SIZE) - expected).max() < PIXELS
        film = UsdGeom.Camera(face.stage.GetPrimAtPath(f"/Tiny/Photos/{own.name}")).GetHorizontalApertureAttr().Get()
        assert 0.018 < film / 10 * meters_per_unit < 0.052  # metres: near the film of a 35 mm camera


def test_cameras_of_a_face_that_is_moved_and_scaled(tmp_path: Path) -> None:
    """They stand in the world, below the face: whoever moves the face moves them with it."""
    save_parts(tiny("Y", 0.01), tmp_path / "face.usda")
    stage = Usd.Stage.Open(str(tmp_path / "face.usda"))
    place = UsdGeom.Xformable(stage.GetDefaultPrim()).AddTransformOp()
    place.Set(Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(1, 2, 3), 40)) * Gf.Matrix4d().SetScale(2.5))
    stage.Save()
    found = fit_of(facepipe.open(tmp_path / "face.usda"), 1, seed=6)
    face = fitted(tmp_path / "face.usda", tmp_path / "out.usda", found, PHOTOS[:1])
    points = face.evaluate(sliders={})
    before = expected_pixels(found.views[0].camera, points)
    assert np.abs(pixels_of(face.stage, face.photos[0].name, points, SIZE) - before).max() < PIXELS
    turn = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(0, 1, 0), 25)) * Gf.Matrix4d().SetTranslate(Gf.Vec3d(7, 8, 9))
    attribute = UsdGeom.Xformable(face.prim).GetOrderedXformOps()[0].GetAttr()
    attribute.Set(attribute.Get() * turn)
    moved = np.array([turn.Transform(Gf.Vec3d(*map(float, point))) for point in points])
    assert np.abs(pixels_of(face.stage, face.photos[0].name, moved, SIZE) - before).max() < PIXELS


@pytest.mark.parametrize(("suffix", "flatten"), [(".usda", False), (".usdc", True), (".usdz", False)])
def test_every_kind_of_file_is_valid_and_keeps_photos(
    head: Path, person: Face, fit: PhotoFit, tmp_path: Path, suffix: str, flatten: bool
) -> None:
    out = tmp_path / f"out{suffix}"
    face = fitted(head, out, fit, flatten=flatten)
    assert validate(out) == ()
    for view, expected, own in zip(fit.views, person.photos, face.photos, strict=True):
        assert (own.name, own.image, own.width, own.height) == (expected.name, expected.image, *SIZE)
        np.testing.assert_allclose(own.light, view.light, rtol=1e-6)
        assert own.key is not None
        numbers = (*own.key.direction, *own.key.color, own.key.shine, np.log(own.key.exponent))
        np.testing.assert_allclose(numbers, view.key, rtol=1e-6)
        assert own.tint.keys() == fit.tint.keys()
        assert own.landmark_error == pytest.approx(view.landmark_error)
        assert own.focal == pytest.approx(view.camera.focal, rel=1e-7)
        assert own.center == pytest.approx(view.camera.center, abs=1e-4)


@pytest.mark.parametrize("color", [0.0, 1e-60])
def test_a_photo_in_light_without_a_lamp(head: Path, person: Face, fit: PhotoFit, tmp_path: Path, color: float) -> None:
    """Nothing of a lamp is authored, and that of a fit before goes."""
    dark = with_key(dict.fromkeys((3, 4, 5), color))(fit)
    for source in (head, Path(str(person.stage.GetRootLayer().realPath))):
        face = fitted(source, tmp_path / f"{source.stem}.out.usda", dark)
        assert [one.key is None for one in face.photos] == [False, True, False]
        assert validate(tmp_path / f"{source.stem}.out.usda") == ()
    text = (tmp_path / "head.out.usda").read_text()
    assert [text.count(name) for name in (tokens.PHOTO_LIGHT, tokens.PHOTO_KEY_COLOR)] == [3, 2]


def test_exports(person: Face, fit: PhotoFit, tmp_path: Path) -> None:
    """The fitted face is the rest of GLB and slider graph, each photo's expression a pose; cameras go along."""
    report = facepipe_gltf.export(person, tmp_path / "person.glb", facepipe_gltf.Options(animations=True))
    assert facepipe_gltf.validate(tmp_path / "person.glb", khronos=False) == ()
    assert not any("photo" in line for line in report.dropped)
    again = gltf.read(tmp_path / "person.glb", gltf.Options()).parts
    assert same(again.photos, person.parts().photos)
    file = gltf_reader.read(tmp_path / "person.glb")
    assert "sliders" not in [one["name"] for one in file.list("animations")]  # the person is no expression
    poses = {own.name: view.expressions for own, view in zip(person.photos, fit.views, strict=True)}
    for name, weights in {"": {}, **poses}.items():
        expected = person.split(person.evaluate(weights, sliders={}) / 100)  # centimetres, glTF has metres
        found = file.pose(name, 0.0) if name else file.evaluate()
        for mesh, points in found.items():
            assert np.nanmax(np.abs(points - expected[mesh])) < 1e-5 * person.head_height / 100
    facepipe_onnx.export(person, tmp_path / "face.onnx")
    facepipe_onnx.export(person, tmp_path / "sliders.onnx", facepipe_onnx.Options(sliders=True, points=True))
    graph = facepipe_onnx.Deformer(tmp_path / "sliders.onnx")
    values = graph.evaluate(sliders=fit.sliders)["points"]
    assert np.abs(values - person.evaluate(sliders={})).max() < 1e-5 * person.head_height


def test_names_of_photos_are_valid_and_free(head: Path, fit: PhotoFit, tmp_path: Path) -> None:
    """Also where files of several folders have one name, or that of a clip of the face."""
    source = facepipe.open(head)
    taken = [animation.name for animation in source.animations]
    face = fitted(head, tmp_path / "out.usda", fit, (f"{taken[0]}.png", "sliders.png", f"{taken[0]}.jpg"))
    assert [animation.name for animation in face.animations][: len(taken)] == taken
    assert len({animation.name for animation in face.animations}) == len(face.animations) == len(taken) + 4
    assert [one.animation for one in face.photos] == [one.name for one in face.photos]
    assert validate(tmp_path / "out.usda") == ()


def test_a_new_fit_replaces_the_photos(person: Face, tmp_path: Path) -> None:
    again = fit_of(person, 1, seed=9)
    path = Path(str(person.stage.GetRootLayer().realPath))
    face = fitted(path, tmp_path / "again.usda", again, PHOTOS[1:2])
    assert [one.image for one in face.photos] == [PHOTOS[1]]
    assert len(face.animations) == len(person.animations) - 2
    assert face.photos[0].focal == pytest.approx(again.views[0].camera.focal, rel=1e-7)
    np.testing.assert_allclose(face.evaluate(sliders={}), person.evaluate(sliders=again.sliders), atol=1e-5)
    assert validate(tmp_path / "again.usda") == ()


def on_view(**changes: object) -> Callable[[PhotoFit], PhotoFit]:
    """A change of the second view."""
    return lambda fit: replace(fit, views=(fit.views[0], replace(fit.views[1], **changes), *fit.views[2:]))


def with_key(changes: dict[int, float]) -> Callable[[PhotoFit], PhotoFit]:
    """The lamp of the second view with other numbers, by index."""

    def changed(fit: PhotoFit) -> PhotoFit:
        key = fit.views[1].key.copy()
        for index, number in changes.items():
            key[index] = number
        return on_view(key=key)(fit)

    return changed


def on_camera(**changes: object) -> Callable[[PhotoFit], PhotoFit]:
    return lambda fit: on_view(camera=replace(fit.views[1].camera, **changes))(fit)


def behind(fit: PhotoFit) -> PhotoFit:
    """The second camera, turned about."""
    own = fit.views[1].camera
    half = Rotation.from_rotvec([0, np.pi, 0])
    turned = half * Rotation.from_rotvec(own.rotation)
    return on_camera(rotation=turned.as_rotvec(), translation=half.apply(own.translation))(fit)


REFUSED: dict[str, tuple[Callable[[PhotoFit], PhotoFit], str]] = {
    "unknown slider": (lambda fit: replace(fit, sliders={"beard": 0.5}), "no slider 'beard'"),
    "slider out of range": (lambda fit: replace(fit, sliders={"noseWidth": 1.5}), "slider noseWidth: value 1.5"),
    "NaN of a slider": (lambda fit: replace(fit, sliders={"noseWidth": NAN}), "noseWidth: NaN"),
    "fewer views": (lambda fit: replace(fit, views=fit.views[:2]), "3 photos of 2 views"),
    "unknown shape": (on_view(expressions={"wink": 0.5}), "my-photo.jpg -> wink: no such shape"),
    "weight above 1": (on_view(expressions={"jawOpen": 1.5}), "my-photo.jpg -> jawOpen: weight 1.5"),
    "weight below 0": (on_view(expressions={"jawOpen": -0.1}), "my-photo.jpg -> jawOpen: weight -0.1"),
    "NaN of a weight": (on_view(expressions={"jawOpen": NAN}), "my-photo.jpg -> expressions -> jawOpen: NaN"),
    "infinite light": (on_view(light=np.full((9, 3), np.inf)), "my-photo.jpg -> light: NaN or infinity"),
    "light of few rows": (on_view(light=np.ones((4, 3))), "my-photo.jpg -> light: shape (4, 3), expected (9, 3)"),
    "light beyond float32": (on_view(light=np.full((9, 3), 1e300)), "beyond float32"),
    "NaN of a lamp": (with_key({3: NAN}), "my-photo.jpg -> key: NaN"),
    "lamp of few numbers": (on_view(key=np.ones(7)), "my-photo.jpg -> key: shape (7,), expected (8,)"),
    "lamp without direction": (with_key({0: 0, 1: 0, 2: 0}), "my-photo.jpg -> key: direction 0"),
    "lamp that darkens": (with_key({4: -0.5}), "my-photo.jpg -> key: colour"),
    "lamp too bright": (with_key({4: 1e300}), "beyond float32"),
    "lamp of negative shine": (with_key({6: -0.5}), "my-photo.jpg -> key: shine -0.5"),
    "lamp of infinite exponent": (with_key({7: 1e4}), "key -> exponent: NaN or infinity"),
    "lamp of huge exponent": (with_key({7: 100.0}), "beyond float32"),
    "lamp without exponent": (with_key({7: -1e4}), "exponent 0"),
    "negative error": (on_view(landmark_error=-1.0), "my-photo.jpg -> landmark_error: -1"),
    "NaN of a camera": (on_camera(rotation=np.full(3, NAN)), "my-photo.jpg -> camera -> rotation: NaN"),
    "matrix for a rotation": (on_camera(rotation=np.eye(3)), "my-photo.jpg -> camera -> rotation: shape (3, 3)"),
    "no focal length": (on_camera(focal=0.0), "my-photo.jpg -> camera: focal length 0"),
    "camera that looks away": (behind, "my-photo.jpg: the camera looks away"),
    "unknown material": (lambda fit: replace(fit, tint={"Fur": (1.0, 1.0, 1.0)}), "tint Fur: no such material"),
    "negative tint": (lambda fit: replace(fit, tint={"": (1.0, -1.0, 1.0)}), "expected 3 factors"),
    "NaN of a tint": (lambda fit: replace(fit, tint={"": (1.0, NAN, 1.0)}), "NaN"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_bad_fits_are_refused_and_nothing_is_authored(head: Path, fit: PhotoFit, tmp_path: Path, name: str) -> None:
    change, message = REFUSED[name]
    with facepipe.open(head).deriving(tmp_path / "untouched.usda") as face:
        before = face.stage.GetRootLayer().ExportToString()
        with pytest.raises(InputError if name != "camera that looks away" else FitError) as caught:
            AuthorPhotoFit()(face, change(fit), [photo(one) for one in PHOTOS])
        assert face.stage.GetRootLayer().ExportToString() == before
    assert message in str(caught.value)


def test_the_report(head: Path, fit: PhotoFit, tmp_path: Path) -> None:
    history = (*fit.history, {"total": NAN, "landmarks": 7.0})
    ended = replace(fit, history=history, stopped="not-finite", warnings=("the photo is dark",))
    with facepipe.open(head).deriving(tmp_path / "out.usda") as face:
        reports = [AuthorPhotoFit()(face, ended, [photo(one) for one in PHOTOS])]
    with facepipe.open(head).deriving(tmp_path / "good.usda") as face:
        reports.append(AuthorPhotoFit()(face, fit, [photo(one) for one in PHOTOS]))
    assert [one.missed for one in reports] == [True, False]
    assert reports[0].warnings[0] == "the photo is dark"
    assert "not finite after 2 steps" in " ".join(reports[0].warnings)
    for report in reports:
        content = json.loads(report.to_json(), parse_constant=pytest.fail)
        assert content["sliders"] == fit.sliders
        assert content["losses"] == {
            "total": {"first": 3.0, "last": 1.5},
            "landmarks": {"first": 2.0, "last": 1.0},
            "identity": {"first": 0.5, "last": 0.5},
        }
        for name, view in zip(PHOTOS, fit.views, strict=True):
            own = content["photos"][name]
            assert own["landmark_error_px"] == view.landmark_error
            assert own["expressions"] == view.expressions
            assert own["eye_distance_px"] == pytest.approx(np.hypot(*(view.targets[36] - view.targets[45])))


def test_sliders_of_expressions_are_reported(head: Path, fit: PhotoFit, tmp_path: Path) -> None:
    """A slider over the shapes that photos add would put an expression into the identity."""
    source = facepipe.open(head)
    views = tuple(replace(view, expressions={"mouthSmileLeft": 0.5}) for view in fit.views)
    lines = []
    for smile in (0.0, 1.0):
        changed = replace(fit, views=views, sliders={**fit.sliders, "smile": smile, "frown": 1.0})
        with source.deriving(tmp_path / "out.usda") as face:
            report = AuthorPhotoFit()(face, changed, [photo(one) for one in PHOTOS])
        lines.append([line for line in report.warnings if "expression" in line])
    warning = "the neutral is not free of expression: smile drive shapes that are fitted as expressions too"
    assert lines == [[], [warning]]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a face, photos, landmarks and a model."""
    save_parts(tiny("Y", 0.01), tmp_path / "face.usda")
    (tmp_path / "in").mkdir()
    (tmp_path / "facepipe.toml").touch()
    for name in ("a.png", "b.png", "a.json", "b.json", "net.onnx"):
        (tmp_path / "in" / name).write_bytes(name.encode())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def recorded(recipe: Recipe) -> Path:
    """A fit with a recipe, in a folder beside."""
    Path("out").mkdir(exist_ok=True)
    out, source = Path("out/person.usda").absolute(), facepipe.open("face.usda")
    with source.deriving(out) as face:
        AuthorPhotoFit()(face, fit_of(source, 2), [photo("a.png"), photo("b.png")], recipe=recipe)
    return out


def recipe() -> Recipe:
    photos, marks = (Path("in/a.png"), Path("in/b.png")), (Path("in/a.json"), Path("in/b.json"))
    own = {"identity_model": Path("in/net.onnx"), "iterations": 20, "identity": 0.5}
    return recipe_to(FitPhoto(face=Path("face.usda"), photos=photos, landmarks=marks, **own), "out/person.usda")


def files(folder: Path) -> dict[str, object]:
    photos, marks = ((folder / f"in/a.{kind}", folder / f"in/b.{kind}") for kind in ("png", "json"))
    return {
        "face": folder / "face.usda",
        "photos": photos,
        "landmarks": marks,
        "identity_model": folder / "in/net.onnx",
    }


def test_the_recipe_is_read_back(folder: Path) -> None:
    kept = read_kept(recorded(recipe()), FitPhoto)
    assert {
        **files(folder),
        "iterations": 20,
        "identity": 0.5,
        "faces": (),
        "start": None,
    }.items() <= kept.values.items()
    assert not kept.standalone
    assert kept.warnings == ()
    assert validate(folder / "out" / "person.usda") == ()


def test_changed_and_lost_sources_of_a_recipe(folder: Path) -> None:
    out = recorded(recipe())
    (folder / "in/b.png").write_bytes(b"another")
    assert read_kept(out, FitPhoto).warnings == ("b.png changed since person.usda was made",)
    assert read_kept(out, FitPhoto, ["photos"]).warnings == ()
    (folder / "in/net.onnx").unlink()
    with pytest.raises(InputError, match=r"net\.onnx: no such file, .*--identity-model"):
        read_kept(out, FitPhoto)
    kept = read_kept(out, FitPhoto, ["identity_model"]).values
    assert kept["photos"][1].read_bytes() == b"another"


def edited(*words: str) -> FitPhoto:
    """The action that a line asks for."""
    parser = Parser(common=False)
    ActionLine(FitPhoto).configure(parser)
    return action_of(parser.parse_args([*words, "--edit", "out/person.usda"]), FitPhoto)[1]


def test_an_edit_leaves_out_what_other_files_take_the_place_of(folder: Path) -> None:
    recorded(recipe())
    for name in ("a.png", "b.png", "a.json", "b.json"):
        (folder / "in" / name).rename(folder / name)
    changed = edited("a.png", "--landmarks", "a.json", "face.usda", "--face", "1")
    expected = ((Path("a.png"),), (Path("a.json"),), (1,))
    assert (changed.photos, changed.landmarks, changed.faces) == expected
    assert (changed.identity_model, changed.iterations) == (folder / "in/net.onnx", 20)
    assert edited("a.png", "face.usda").landmarks == ()
    for name in ("a.png", "b.png"):
        (folder / name).rename(folder / "in" / name)
    changed = edited("--landmarker", "a.task", "face.usda")
    assert (changed.landmarks, changed.landmarker, len(changed.photos)) == ((), Path("a.task"), 2)
    with pytest.raises(InputError, match=r"a\.json: no such file, expected it there \(or --landmarks\)"):
        edited("face.usda")


def test_photos_that_can_not_be(folder: Path) -> None:
    with pytest.raises(InputError, match="given twice"):
        FitPhoto(face=Path("face.usda"), photos=(Path("in/a.png"), Path("./in/a.png"))).check()
    with pytest.raises(InputError, match="PHOTO: none given"):
        FitPhoto(face=Path("face.usda"), photos=()).check()
    with pytest.raises(InputError, match="can't be read"):
        recipe_to(FitPhoto(face=Path("face.usda"), photos=(Path("in/none.png"),)), "out.usda")


def test_the_clipping_range_is_ten_times_wider_than_the_depths_of_the_face() -> None:
    """A camera that stands at z = 3, looks down -z, and sees points 5 and 20 before it; others behind it."""
    to_world = np.eye(4)
    to_world[:3, 3] = 0.0, 1.0, 3.0
    points = np.array([[9.0, 7.0, -2.0], [0.0, 0.0, -17.0]])
    assert clipping_range("front", to_world, points) == pytest.approx((0.5, 200.0))
    assert clipping_range("front", to_world, np.array([*points, [0.0, 0.0, 4.0]])) == pytest.approx((0.002, 200.0))
    with pytest.raises(FitError, match="the camera looks away from the face"):
        clipping_range("front", to_world, points + np.array([0.0, 0.0, 20.0]))
