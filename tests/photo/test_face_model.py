"""A face from sliders to an image: colours, coverage, and a slider found again from an image."""

from __future__ import annotations

import io
import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from faces import grid_mesh, replace_mesh, tiny_face
from photo_files import png_of
from PIL import Image
from small_head import make
from with_torch import tensor, torch

from facepipe.core.errors import InputError, TopologyError
from facepipe.parts import FaceParts, Material, MaterialFaces, Texture, TextureInput
from facepipe.photo.renderer.camera import Camera
from facepipe.photo.renderer.face_model import FaceModel, Look
from facepipe.photo.renderer.light import ambient, distant
from facepipe.pictures.camera import portrait
from facepipe.rig import build

pytestmark = pytest.mark.needs_torch

WHITE = ambient(torch.ones(3))
BLUE = (0.1, 0.3, 0.6)


@cache
def sample() -> tuple[FaceParts, FaceModel]:
    """With a texture on the face, and one colour behind it and below."""
    parts = make(0, textures=64)
    plain = [
        replace(material, diffuse_color=BLUE) if material.name == "M_BackHead" else material
        for material in parts.materials
    ]
    parts = replace(parts, materials=tuple(plain))
    return parts, FaceModel(parts)


def camera_on(points: np.ndarray, size: int, dtype: torch.dtype = torch.float32) -> Camera:
    own = portrait(points, "front", size, size)
    return Camera.at(own.axes, own.eye, own.focal, own.center, dtype=dtype)


def textured(indices: bool, **changes: object) -> FaceParts:
    """A grid in the plane z = 0, its UVs from corner to corner, with a random black and white texture."""
    pixels = np.random.default_rng(0).integers(0, 2, (7, 5, 3)).astype(np.uint8) * 255
    source = TextureInput(texture=Texture(name="t.png", data=png_of(pixels)))
    mesh = grid_mesh(size=4)
    (uv_set,) = mesh.uv_sets
    if indices:  # the same UVs, in another order and face by face
        order = np.arange(len(uv_set.values))[::-1]
        place = np.argsort(order)[mesh.face_vertex_indices].astype(np.int32)
        uv_set = replace(uv_set, values=np.asarray(uv_set.values)[order], indices=place)
    material = replace(Material(name="Paint", diffuse_color=source), **changes)
    mesh = replace_mesh(mesh, uv_sets=(uv_set,), material="Paint")
    return FaceParts(meshes=(mesh,), materials=(material,))


@pytest.mark.parametrize("indices", [False, True])
def test_a_texture_lies_where_its_uvs_say(indices: bool) -> None:
    """The grid fills the image from x = -1.5 to 1.5 and y = 3 to 0: each pixel has the texel below it."""
    parts = textured(indices)
    camera = Camera.at(np.eye(3), np.array([0, 1.5, 10.0]), 200.0, (30, 30), dtype=torch.float64)
    model = FaceModel(parts, dtype=torch.float64)
    look = Look(camera=camera, light=ambient(torch.ones(3, dtype=torch.float64)), background=tensor([0, 0, 0]))
    image = model(None, None, look, height=60, width=60).numpy()
    pixels = np.asarray(Image.open(io.BytesIO(parts.materials[0].diffuse_color.texture.data))) / 255
    for row, column in ((0, 0), (6, 4), (3, 2), (2, 0), (4, 3)):
        x, y = (column + 0.5) * 60 / 5, (row + 0.5) * 60 / 7  # the texel's centre, inside a pixel or on its border
        near = image[round(y - 0.51) : round(y + 0.49) + 1, round(x - 0.51) : round(x + 0.49) + 1, :3]
        np.testing.assert_allclose(near.mean(axis=(0, 1)), pixels[row, column], atol=0.1)
    assert (image[..., 3] == 1).all()


def test_in_white_light_each_surface_has_its_own_color() -> None:
    _, model = sample()
    points = model.rig()
    look = Look(camera=camera_on(points.numpy(), 96), light=WHITE, background=torch.tensor([0.1, 0.2, 0.6]))
    image = model(None, None, look, height=96, width=96)
    shoulder = image[80:86, 24:30]
    np.testing.assert_allclose(shoulder[..., :3], np.broadcast_to(BLUE, (6, 6, 3)), atol=1e-5)
    assert (shoulder[..., 3] - 1).abs().max() < 1e-6
    empty = image[..., 3] == 0
    assert (image[empty][:, :3] == look.background).all()
    assert 0.2 < image[..., 3].mean() < 0.6
    skin = image[60, 36, :3]
    assert skin[0] > skin[1] > skin[2] > 0.1, "the skin's texture is on the cheek"


def test_images_are_linear_in_light_tint_and_background() -> None:
    _, model = sample()
    generator = torch.Generator().manual_seed(0)
    light = distant(torch.tensor([0.0, 0.6, 0.8]), torch.ones(3)) + WHITE
    tint = torch.rand((len(model.colors.names), 3), generator=generator)
    background = torch.rand((40, 48, 3), generator=generator)
    points = model.rig()
    look = Look(camera=camera_on(points.numpy(), 40), light=light, background=background)

    def image(**changes: object) -> torch.Tensor:
        return model.image(points, replace(look, **changes), height=40, width=48)[..., :3]

    black = torch.zeros(3)
    lit = image(background=black)
    np.testing.assert_allclose(image(background=black, light=0.5 * light), 0.5 * lit, atol=1e-6)
    np.testing.assert_allclose(image(background=black, tint=torch.full_like(tint, 0.25)), 0.25 * lit, atol=1e-6)
    assert (image(background=black, tint=tint) <= lit + 1e-6).all()
    np.testing.assert_allclose(image() - lit, image(light=0 * light), atol=1e-6)
    free = {"light": light.clone(), "tint": tint, "background": background.clone()}
    for one in free.values():
        one.requires_grad_()
    pull = torch.rand((40, 48, 3), generator=generator)
    (image(**free) * pull).sum().backward()
    for name, own in free.items():
        step = torch.rand(own.shape, generator=generator) * 0.1
        with torch.no_grad():
            moved = [(image(**{**free, name: own + sign * step}) * pull).sum() for sign in (1, -1)]
        assert float((own.grad * step).sum()) == pytest.approx(float(moved[0] - moved[1]) / 2, rel=2e-3)


def test_texels_have_gradients() -> None:
    model = FaceModel(textured(False), dtype=torch.float64)
    camera = Camera.at(np.eye(3), np.array([0, 1.5, 10.0]), 50.0, (8, 8), dtype=torch.float64)
    texels = model.colors.textures["Paint"].clone().requires_grad_()
    light = ambient(torch.ones(3, dtype=torch.float64))

    def image(own: torch.Tensor) -> torch.Tensor:
        look = Look(camera=camera, light=light, background=tensor([0, 0, 0]), textures={"Paint": own})
        return model(None, None, look, height=16, width=16)[..., :3]

    assert torch.autograd.gradcheck(image, (texels,))


def test_see_through_surfaces_are_left_out() -> None:
    parts = tiny_face()
    materials = (Material(name="Glass", opacity=0.5), Material(name="Red", diffuse_color=(0.8, 0.1, 0.05)))
    head, teeth = parts.meshes
    some = MaterialFaces(material="Red", faces=np.arange(5, dtype=np.int32))
    meshes = (replace_mesh(head, material="Glass", material_faces=(some,)), replace_mesh(teeth, material="Red"))
    parts = replace(parts, meshes=meshes, materials=materials)
    model = FaceModel(parts)
    assert len(model.outline.triangles) == 2 * 5 + 2 * 4
    look = Look(camera=camera_on(build(parts).points, 32), light=WHITE, background=torch.zeros(3))
    image = model(None, None, look, height=32, width=32)
    inside = image[..., 3] > 1 - 1e-6
    np.testing.assert_allclose(
        image[inside][:, :3], np.broadcast_to((0.8, 0.1, 0.05), (int(inside.sum()), 3)), atol=1e-5
    )
    assert inside.sum() > 50


def test_broken_textures_and_unknown_materials_are_refused() -> None:
    broken = TextureInput(texture=Texture(name="skin.png", data=b"no image"))
    with pytest.raises(InputError, match=r"texture skin.png: is not a picture"):
        FaceModel(textured(False, diffuse_color=broken))
    with pytest.raises(TopologyError, match="material 'Paint' is not among"):
        FaceModel(replace(textured(False), materials=()))


@pytest.mark.parametrize(("name", "value"), [("jawWidth", 0.7), ("noseLength", -0.6)])
def test_gradient_descent_finds_a_slider_again(name: str, value: float) -> None:
    """From its default, from nothing but a picture: to within 4 % of its range, where it moves less than a pixel."""
    _, model = sample()
    size = 96
    own = portrait(model.rig().numpy(), (0.5, 0.1), size, size)
    camera = Camera.at(own.axes, own.eye, own.focal, own.center)
    light = 0.5 * WHITE + distant(torch.tensor([-0.48, 0.6, 0.64]), torch.full((3,), 0.6))
    look = Look(camera=camera, light=light, background=torch.tensor([0.1, 0.2, 0.6]))
    number = model.rig.sliders.names.index(name)

    def image(setting: torch.Tensor) -> torch.Tensor:
        sliders = model.rig.sliders.value.index_copy(0, torch.tensor([number]), setting)
        return model(sliders, None, look, height=size, width=size)

    goal = image(torch.tensor([value]))
    found = torch.zeros(1, requires_grad=True)
    steps = torch.optim.Adam([found], lr=0.1)
    for step in range(40):
        steps.param_groups[0]["lr"] = 0.1 * (1 - step / 40)
        steps.zero_grad()
        ((image(found) - goal) ** 2).sum().backward()
        steps.step()
    assert found.item() == pytest.approx(value, abs=0.08)


def test_the_rest_of_facepipe_does_without_torch() -> None:
    code = "import sys, facepipe, facepipe.cli, facepipe.rig, facepipe.pictures\nassert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=600)
    hidden = (
        "import sys; sys.modules['torch'] = None; import importlib.util as u; find = u.find_spec\n"
        "u.find_spec = lambda name, *rest: None if name == 'torch' else find(name, *rest)\n"
        "from facepipe.core.errors import InputError\n"
        "try:\n    import facepipe.photo.renderer\nexcept InputError as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", hidden], check=True, timeout=600, capture_output=True, text=True)
    assert "pip install 'facepipe[train]'" in done.stdout
