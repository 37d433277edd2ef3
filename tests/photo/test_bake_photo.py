"""Photos of heads with known skin in known light, baked to heads of the same shape with another skin."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from baked_face import SKIN, person, put_fitted, small_person, wearing, with_cards
from command_line import Capsys, content, done, exit_code, failed
from feature_graphs import coarse_picture, save
from PIL import Image, ImageDraw
from scipy.spatial import cKDTree
from textures import picture

import facepipe
from facepipe.geometry.colors import from_srgb
from facepipe.heads.assembly import make_head
from facepipe.heads.people import Look
from facepipe.heads.surfaces import dressed, other_cards
from facepipe.parts import FaceParts, Material, Mesh, TextureInput
from facepipe.photo.texture import BakePhotoReport
from facepipe.rig import build
from facepipe.stage import Face
from facepipe.textures.seen_skin import sampled
from facepipe.textures.skin_surface import LEFT, RIGHT, mirrored_points, skin_of

LIGHT_SKIN, DARK_SKIN = 0, 5  # seeds
SIZE = 256


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with fitted.usda, a light-skinned head, and photos of it with the skin of another person."""
    folder = tmp_path_factory.mktemp("fitted")
    dark = small_person(DARK_SKIN)
    put_fitted(wearing(dark, small_person(LIGHT_SKIN)), dark, folder, front=0.0, side=0.5)
    return folder


@pytest.fixture(scope="module")
def baked(fitted: Path) -> Face:
    """The same with the photo's skin."""
    facepipe.bake_photo(fitted / "fitted.usda", photos=[fitted / "front.png"], out=fitted / "baked.usda")
    return facepipe.open(fitted / "baked.usda")


def skin(parts: FaceParts) -> Iterator[np.ndarray]:
    """(size, size, 3) sRGB 0..1 of each texture of the skin."""
    for material in parts.materials:
        if material.name in SKIN:
            assert isinstance(material.diffuse_color, TextureInput)
            image = Image.open(io.BytesIO(material.diffuse_color.texture.image())).convert("RGB")
            yield np.asarray(image, np.float64) / 255


def face_of(parts: FaceParts) -> np.ndarray:
    """(s, s, 3) the face's middle: from the forehead to the chin."""
    texture = next(skin(parts))
    return texture[30:160, 70:186]


def test_baked_colours_are_those_of_the_skin_without_the_light_of_the_photo(baked: Face) -> None:
    truth, template = face_of(small_person(DARK_SKIN)), face_of(small_person(LIGHT_SKIN))
    off, before = (np.abs(found - truth).mean() for found in (face_of(baked.parts()), template))
    assert off < 0.06
    assert off < before / 3


def test_both_sides_are_lit_alike(baked: Face) -> None:
    """The lamp stands at one side."""
    left, right = (face.mean(axis=(0, 1)) for face in np.split(face_of(baked.parts()), 2, axis=1))
    assert np.abs(left - right).max() < 0.02


def test_nothing_behind_the_head_is_on_it(baked: Face) -> None:
    """What is behind is magenta."""
    for texture in skin(baked.parts()):
        assert (texture[..., [0, 2]].min(axis=2) - texture[..., 1] < 0.15).all()


def test_no_step_shows_where_textures_meet(baked: Face, fitted: Path) -> None:
    """Points that both materials of the skin share: their colours differ no more than in the textures before."""
    before = np.quantile(steps(facepipe.open(fitted / "fitted.usda")), 0.95)
    assert np.quantile(steps(baked), 0.95) < max(1.2 * before, 0.03)


def steps(face: Face) -> list[float]:
    """How much the two textures differ at points that both show."""
    mesh = face.meshes[0]
    uv_set, textures = mesh.uv_sets[0], list(skin(face.parts()))
    assert uv_set.indices is not None
    colors: list[dict[int, np.ndarray]] = [{}, {}]
    for point, (u, v) in zip(mesh.face_vertex_indices, np.asarray(uv_set.values)[uv_set.indices], strict=True):
        row, column = np.clip([(1 - v) * SIZE, u % 1 * SIZE], 0, SIZE - 1).astype(int)
        colors[int(u)][int(point)] = textures[int(u)][row, column]
    shared = sorted(colors[0].keys() & colors[1].keys())
    assert len(shared) > 100
    return [float(np.abs(colors[0][point] - colors[1][point]).max()) for point in shared]


def test_several_photos_show_more_and_agree(fitted: Path, baked: Face) -> None:
    photos = [fitted / f"{name}.png" for name in ("front", "side")]
    facepipe.bake_photo(fitted / "fitted.usda", photos=photos, out=fitted / "both.usda")
    both = facepipe.open(fitted / "both.usda")
    truth = face_of(small_person(DARK_SKIN))
    assert np.abs(face_of(both.parts()) - truth).mean() < 0.06
    assert np.abs(face_of(both.parts()) - face_of(baked.parts())).mean() < 0.03


def test_the_light_of_the_stage_goes_with_the_textures(baked: Face, fitted: Path) -> None:
    """Light times colour is as before: what the face shows in its photo."""
    before, after = facepipe.open(fitted / "fitted.usda").photos[0], baked.photos[0]
    assert before.key is not None
    assert after.key is not None
    factor = np.array(after.key.color) / before.key.color
    assert np.abs(after.light[:4] - before.light[:4] * factor).max() < 0.3
    assert not after.tint


def test_the_command_writes_the_same_again_and_exports_it(fitted: Path, capsys: Capsys) -> None:
    words = ("bake-photo", fitted / "fitted.usda", fitted / "front.png", "--size", 128)
    assert "skin_face_photo.png, skin_back_photo.png" in done(capsys, *words, "-o", fitted / "again.usda")
    before = content(fitted / "again_textures")
    done(capsys, "cook", fitted / "again.usda", "--force")
    assert content(fitted / "again_textures") == before
    made = list(skin(facepipe.open(fitted / "again.usda").parts()))
    for name in ("again.glb", "flat.usdz"):
        if name.endswith("glb"):
            done(capsys, "export", fitted / "again.usda", "-o", fitted / name)
        else:
            done(capsys, *words, "-o", fitted / name)
        for found, expected in zip(skin(facepipe.read(fitted / name).parts()), made, strict=True):
            np.testing.assert_array_equal(found, expected)


@pytest.mark.needs_torch
@pytest.mark.slow
def test_the_report_shows_the_textured_face_and_how_like_its_photo_it_is(fitted: Path, capsys: Capsys) -> None:
    """The render of the report has the photo's colours where the face is."""
    save(coarse_picture(), fitted / "net.onnx")
    folder = fitted / "report"
    words = ("bake-photo", fitted / "fitted.usda", fitted / "front.png", "--identity-model", fitted / "net.onnx")
    words = (*words, "--report", folder, "--force", "-o", fitted / "judged.usda", "--similarity-threshold")
    assert "similarity" in done(capsys, *words, 0.95)
    assert exit_code(*words, 0.9999999) == 1
    assert "front.png: similarity of 0.9" in capsys.readouterr().err
    assert {path.name for path in folder.iterdir()} == {"front.render.png", "report.html", "report.json"}
    assert (folder / "report.html").read_text(encoding="utf-8").count("<figure>") == 3 + 3 + 4
    assert json.loads((folder / "report.json").read_text())["similarities"]["front.png"] > 0.95
    photo = np.asarray(Image.open(fitted / "front.png").convert("RGB"), np.float64)
    render = np.asarray(Image.open(folder / "front.render.png"), np.float64)
    shown = render[..., 3] == 255
    assert shown.mean() > 0.1
    assert np.median(np.abs(render[..., :3] - photo)[shown]) < 10


@pytest.mark.slow
def test_cards_of_brows_go_where_the_photo_has_brows(tmp_path: Path) -> None:
    parts = with_cards(person(LIGHT_SKIN, 64), "Brows", "Lashes")
    put_fitted(parts, parts, tmp_path, size=240, front=0.0)
    report = facepipe.bake_photo(tmp_path / "fitted.usda", photos=[tmp_path / "front.png"], out=tmp_path / "out.usda")
    assert report.hidden == ("Brows",)
    opacity = {material.name: material.opacity for material in facepipe.open(tmp_path / "out.usda").materials}
    assert opacity["Brows"] == 0
    assert isinstance(opacity["Lashes"], TextureInput)


PAINT = np.array([0.25, 0.12, 0.3])


def on_lids_and_brows(parts: FaceParts) -> np.ndarray:
    """(SIZE, SIZE) texels of the face beside the upper lids' rims and on brows."""
    surface = skin_of(parts, build(parts).points, SIZE)
    marks, unit = surface.points[surface.landmarks], surface.eye_distance(surface.points)
    up = (marks[27] - marks[8]) / np.linalg.norm(marks[27] - marks[8])
    spots = np.concatenate([marks[[37, 38, 43, 44]] + 0.035 * unit * up, marks[18:26] - 0.05 * unit * up])
    texels = surface.textures[0].texels
    near = cKDTree(spots).query(texels.carried(surface.points))[0] < 0.025 * unit
    mask = np.zeros(SIZE * SIZE, bool)
    mask[texels.at[near]] = True
    return mask.reshape(SIZE, SIZE)


def test_lids_and_brows_look_as_in_the_photo_however_dark_and_of_what_hue(tmp_path: Path) -> None:
    parts = person(LIGHT_SKIN)  # paint is finer than the small one's triangles
    spots, before = on_lids_and_brows(parts), next(skin(parts))
    texture = picture("painted.png", (np.where(spots[..., None], PAINT, before) * 255).astype(np.uint8))
    face = next(one for one in parts.materials if one.name == SKIN[0])
    assert isinstance(face.diffuse_color, TextureInput)
    other = replace(face, diffuse_color=replace(face.diffuse_color, texture=texture))
    painted = replace(parts, materials=tuple(other if one.name == SKIN[0] else one for one in parts.materials))
    put_fitted(parts, painted, tmp_path, size=640, front=0.0)
    facepipe.bake_photo(tmp_path / "fitted.usda", photos=[tmp_path / "front.png"], out=tmp_path / "out.usda")
    made = next(skin(facepipe.open(tmp_path / "out.usda").parts()))
    off, at_first = (np.abs(one - PAINT)[spots].mean() for one in (made, before))
    assert off < at_first / 2


def hair_of(parts: FaceParts) -> Material:
    return next(material for material in parts.materials if material.name == "Hair")


def card_color(parts: FaceParts, name: str = "Hair") -> np.ndarray:
    """(3,) what the picture of hair, or of other cards, is multiplied with."""
    color = next(one for one in parts.materials if one.name == name).diffuse_color
    assert isinstance(color, TextureInput)
    return np.array(color.scale[:3])


RED = (0.8, 0.2, 0.05)


@dataclass(frozen=True)
class Haired:
    """A face with brows and cropped hair, and what became of it by a photo of long red hair and of no brows."""

    before: FaceParts
    shown: FaceParts
    report: BakePhotoReport
    out: Path


@pytest.fixture(scope="module")
def haired(tmp_path_factory: pytest.TempPathFactory) -> Haired:
    """The photo shows the same person: something hides the brows."""
    folder = tmp_path_factory.mktemp("haired")
    before = with_cards(person(LIGHT_SKIN, 64), "Brows", "Hair")
    hair = hair_of(before)
    assert isinstance(hair.diffuse_color, TextureInput)
    red = replace(hair, diffuse_color=replace(hair.diffuse_color, scale=(*RED, 1.0)))
    shown = replace(before, materials=tuple(red if one.name == "Hair" else one for one in before.materials))
    shown = replace(shown, meshes=(*shown.meshes[:-1], other_cards(shown.meshes[-1], "long", shown.meshes[0])))
    put_fitted(before, shown, folder, size=240, front=0.0)
    hide(folder / "front.png", (0.3, 0.2, 0.7, 0.36))
    report = facepipe.bake_photo(folder / "fitted.usda", photos=[folder / "front.png"], out=folder / "out.usda")
    return Haired(before, shown, report, folder / "out.usda")


def hide(file: Path, box: tuple[float, float, float, float]) -> None:
    """Put a green thing before what is in a box of a photo, in shares of its sides."""
    photo = Image.open(file).convert("RGB")
    left, top, right, bottom = box
    width, height = photo.size
    ellipse = (left * width, top * height, right * width, bottom * height)
    ImageDraw.Draw(photo).ellipse(ellipse, fill=(60, 150, 70))
    photo.save(file)


def test_hair_has_the_colour_of_the_hair_in_the_photo(haired: Haired) -> None:
    made = card_color(facepipe.open(haired.out).parts())
    off, before = (np.abs(np.log(color / RED)).mean() for color in (made, card_color(haired.before)))
    assert off < 0.5
    assert off < before / 3
    assert haired.report.hair is not None


IRISES = ("M_IrisLeft", "M_IrisRight", "Pupil")


def iris_picture(parts: FaceParts) -> np.ndarray:
    """(s, s, 3) linear, of the left iris."""
    color = next(one for one in parts.materials if one.name == IRISES[0]).diffuse_color
    assert isinstance(color, TextureInput)
    image = Image.open(io.BytesIO(color.texture.image())).convert("RGB")
    return from_srgb(np.asarray(image, np.float64) / 255)


def test_irises_have_the_colour_of_those_in_the_photo(tmp_path: Path) -> None:
    parts = small_person(LIGHT_SKIN, 64)
    truth = np.array([0.25, 0.35, 0.9])

    def tinted(material: Material) -> Material:
        assert isinstance(material.diffuse_color, TextureInput)
        return replace(material, diffuse_color=replace(material.diffuse_color, scale=(*truth.tolist(), 1.0)))

    other = replace(parts, materials=tuple(tinted(one) if one.name in IRISES else one for one in parts.materials))
    put_fitted(parts, other, tmp_path, size=480, front=0.0)
    report = facepipe.bake_photo(tmp_path / "fitted.usda", photos=[tmp_path / "front.png"], out=tmp_path / "out.usda")
    made = iris_picture(facepipe.open(tmp_path / "out.usda").parts())
    factor = made.mean(axis=(0, 1)) / iris_picture(parts).mean(axis=(0, 1))
    assert set(IRISES) in map(set, report.textures.values())
    assert np.abs(np.log(factor / truth)).mean() < 0.35
    assert np.abs(np.log(factor / truth)).mean() < np.abs(np.log(truth)).mean() / 2


def test_eyes_without_pictures_stay_as_they_are(tmp_path: Path) -> None:
    parts = small_person(LIGHT_SKIN, 64)
    plain = tuple(one if one.name in SKIN else replace(one, diffuse_color=(0.3, 0.3, 0.3)) for one in parts.materials)
    parts = replace(parts, materials=plain)
    put_fitted(parts, parts, tmp_path, size=240, front=0.0)
    report = facepipe.bake_photo(tmp_path / "fitted.usda", photos=[tmp_path / "front.png"], out=tmp_path / "out.usda")
    assert sorted(name for names in report.textures.values() for name in names) == sorted(SKIN)


def test_hair_has_the_style_that_is_nearest_to_that_of_the_photo(haired: Haired, capsys: Capsys) -> None:
    made, shown = facepipe.open(haired.out), haired.shown.meshes[-1]
    assert haired.report.hair_style == "long"
    assert_alike(made.meshes[-1], shown)
    assert not [one for one in facepipe.validate(haired.out) if one.severity == "error"]
    done(capsys, "export", haired.out, "-o", haired.out.with_suffix(".glb"))
    read = next(mesh for mesh in facepipe.read(haired.out.with_suffix(".glb")).meshes if mesh.name == "Hair")
    assert len(read.face_vertex_counts) == len(shown.face_vertex_counts)


def test_a_bald_person_gets_no_hair_and_a_scalp_of_skin(tmp_path: Path) -> None:
    """A face with cropped hair, whose photo shows the same person without any."""
    cropped = with_cards(person(LIGHT_SKIN, 64), "Hair")
    shaved = dressed(make_head(np.zeros(100)), Look(style="bald"), 64)
    shown = wearing(person(LIGHT_SKIN, 64), shaved)
    put_fitted(cropped, shown, tmp_path, size=240, front=0.0)
    report = facepipe.bake_photo(tmp_path / "fitted.usda", photos=[tmp_path / "front.png"], out=tmp_path / "out.usda")
    assert report.hair_style == "bald"
    assert report.hidden == ("Hair",)
    made, before = (facepipe.open(tmp_path / f"{name}.usda").parts() for name in ("out", "fitted"))
    truth = list(skin(shown))
    off, at_first = (np.abs(list(skin(one))[1] - truth[1]).mean() for one in (made, before))
    assert off < at_first


def assert_alike(found: Mesh, expected: Mesh) -> None:
    """Faces, texture coordinates, skin and shapes of two meshes."""
    np.testing.assert_allclose(found.points, expected.points, atol=1e-4)
    np.testing.assert_array_equal(found.face_vertex_indices, expected.face_vertex_indices)
    np.testing.assert_allclose(found.uv_sets[0].values, expected.uv_sets[0].values, atol=1e-6)
    assert found.skin is not None
    assert expected.skin is not None
    np.testing.assert_allclose(found.skin.joint_weights, expected.skin.joint_weights, atol=1e-6)
    assert [shape.name for shape in found.blendshapes] == [shape.name for shape in expected.blendshapes]


def test_what_is_before_the_face_is_not_on_it(tmp_path: Path) -> None:
    """A green thing before a cheek and the nose."""
    parts = small_person(LIGHT_SKIN, 128)
    put_fitted(parts, parts, tmp_path, front=0.0)
    hide(tmp_path / "front.png", (0.44, 0.38, 0.56, 0.48))
    facepipe.bake_photo(tmp_path / "fitted.usda", photos=[tmp_path / "front.png"], out=tmp_path / "out.usda")
    for texture in skin(facepipe.open(tmp_path / "out.usda").parts()):
        assert (texture[..., 1] - texture[..., 0] < 0.02).all()


def test_brows_that_no_photo_shows_have_a_colour_that_goes_with_the_hair(haired: Haired) -> None:
    made = facepipe.open(haired.out).parts()
    (was_red, _, was_blue), (is_red, _, is_blue) = card_color(haired.before, "Brows"), card_color(made, "Brows")
    assert is_red / is_blue > 2 * was_red / was_blue
    assert isinstance(next(one for one in made.materials if one.name == "Brows").opacity, TextureInput)
    assert haired.report.hidden == ()


@pytest.mark.slow
def test_what_is_behind_a_head_is_not_its_hair(tmp_path: Path) -> None:
    """Behind a head with a painted scalp and no cards is magenta."""
    parts = with_cards(person(LIGHT_SKIN, 64), "Hair")
    shaved = tuple(replace(one, opacity=0.0) if one.name == "Hair" else one for one in parts.materials)
    put_fitted(parts, replace(parts, materials=shaved), tmp_path, size=240, front=0.0)
    facepipe.bake_photo(tmp_path / "fitted.usda", photos=[tmp_path / "front.png"], out=tmp_path / "out.usda")
    red, green, blue = card_color(facepipe.open(tmp_path / "out.usda").parts())
    assert min(red, blue) < green + 0.05


@pytest.mark.parametrize(
    ("photo", "fault"),
    [
        ("other.png", "expected one of front.png, side.png"),
        ("small/front.png", "is 100 x 100 pixels, expected 320 x 320"),
    ],
)
def test_photos_that_the_face_was_not_fitted_to_are_refused(
    fitted: Path, tmp_path: Path, capsys: Capsys, photo: str, fault: str
) -> None:
    (tmp_path / photo).parent.mkdir(exist_ok=True)
    Image.new("RGB", (100, 100)).save(tmp_path / photo)
    words = ("bake-photo", fitted / "fitted.usda", tmp_path / photo, "-o", tmp_path / "out.usda")
    assert fault in failed(capsys, *words, folder=tmp_path)


def test_textures_are_put_on_layers_that_are_being_made(fitted: Path, tmp_path: Path) -> None:
    face = facepipe.open(fitted / "fitted.usda")
    with pytest.raises(facepipe.InputError, match="no layer to put textures on"):
        face.new_texture(["M_Face"], "a.png", b"")
    with pytest.raises(facepipe.InputError, match="M_Fase"), face.deriving(tmp_path / "out.usda") as layer:
        layer.new_texture(["M_Fase"], "a.png", b"")
    assert not list(tmp_path.iterdir())


def test_mirrored_points_are_across_the_plane_between_landmarks_of_both_sides() -> None:
    """The plane is off the origin and at no axis; a point has no mirror image where there is no other."""
    random = np.random.default_rng(0)
    ways = np.linalg.qr(random.normal(size=(3, 3)))[0]
    half = random.uniform((-2.0, -1.0, 0.1), (2.0, 1.0, 2.0), (68, 3))
    alone = np.array([[0.0, 5.0, 1.0]])
    other = half * np.array([1.0, 1.0, -1.0])
    points = np.concatenate([half, other, alone]) @ ways + 3.0
    landmarks = np.arange(68)
    landmarks[list(RIGHT)] = np.array(LEFT) + 68
    found = mirrored_points(points, landmarks)
    assert found.tolist() == [*range(68, 136), *range(68), -1]


def test_photos_are_sampled_up_to_their_first_row_and_column() -> None:
    """Where pixels have their middles, samples are the pixels."""
    pixels = np.random.default_rng(0).random((40, 48, 3)).astype(np.float32)
    rows, columns = np.indices((40, 48)).reshape(2, -1)[:, ::-1]
    found = sampled(pixels, np.stack([columns, rows], axis=1) + 0.5, 1.0)
    np.testing.assert_allclose(found, pixels[rows, columns], atol=1e-4)
