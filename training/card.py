"""Scenes drawn by OpenGL: some hundred times as fast on a graphics card as `facepipe.pictures.draw`, much alike.

The light is that of `facepipe.pictures.lighting`. Left out are light scattered below the skin, hollows
narrower than the maps of the sky, and the order of see-through layers. It needs ``moderngl`` and a driver with EGL;
Mesa's software driver serves too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import moderngl
import numpy as np
import numpy.typing as npt

from facepipe.geometry.colors import to_srgb
from facepipe.parts import Material, Texture, TextureInput
from facepipe.pictures.camera import Camera
from facepipe.pictures.lighting import Portrait
from facepipe.pictures.occlusion import Sky
from facepipe.pictures.scene import Scene, decode

FloatArray = npt.NDArray[np.floating]

_FINE = 2  # samples of a pixel in each direction, whose mean is the texture's first level
_SHADOW = 768  # pixels a side of the map of the key's light
_MOST_BOXES = 3
_SRGB8_ALPHA8 = 0x8C43
_SOLID, _STRANDS, _CLEAR = range(3)  # in the order in which they are drawn
_TEXTURED = ("diffuse_color", "roughness", "occlusion", "opacity", "normal")
_CHANNEL = {"r": 0, "g": 1, "b": 2, "a": 3, "rgb": 0}


@dataclass(frozen=True, kw_only=True)
class _Piece:
    """Triangles of one material."""

    kind: int
    first: int  # index
    count: int
    material: Material
    double_sided: bool


class Card:
    """A graphics context that draws pictures of one size."""

    def __init__(self, size: int) -> None:
        """:param size: pixels a side"""
        self.size = size
        self._context = context = moderngl.create_context(standalone=True, backend="egl", require=330)
        folder = Path(__file__).parent / "shaders"
        text = {path.stem: path.read_text(encoding="utf-8") for path in folder.glob("*.glsl")}
        self._surface = context.program(vertex_shader=text["points"], fragment_shader=text["surface"])
        self._depth = context.program(vertex_shader=text["shadow"], fragment_shader="#version 330\nvoid main() {}\n")
        fine = (_FINE * size, _FINE * size)
        self._samples = context.texture(fine, 4, dtype="f2")
        self._samples.build_mipmaps(max_level=1)  # gets its memory, which must not move once it is drawn to
        self._fine = context.framebuffer([self._samples], context.depth_renderbuffer(fine))
        self._map = context.depth_texture((_SHADOW, _SHADOW))
        self._map.compare_func = ""
        self._map.filter = moderngl.NEAREST, moderngl.NEAREST
        self._map.repeat_x = self._map.repeat_y = False
        self._shadow = context.framebuffer(depth_attachment=self._map)
        for slot, name in enumerate((*(f"{one}_map" for one in _TEXTURED), "key_map")):
            self._surface[name].value = slot
        self._white = context.texture((1, 1), 4, b"\xff" * 4)

    def load(self, scene: Scene) -> Model:
        """What all poses of a face share."""
        return Model(self._context, self._surface, self._depth, scene)

    def draw(self, model: Model, camera: Camera, lights: Portrait, background: FloatArray) -> npt.NDArray[np.uint8]:
        """(S, S, 3) sRGB, as `facepipe.pictures.draw.draw` gives.

        :param background: (S, S, 3) linear
        """
        model.light(lights, camera)
        key = _key_map(model.scene, lights.key @ camera.axes)
        self._shadow.use()
        self._shadow.clear(depth=1.0)
        self._context.enable_only(moderngl.DEPTH_TEST)
        self._depth["to_map"].write(key.T.astype("f4").tobytes())
        model.occluders.render()
        self._fine.use()
        self._context.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
        self._set_view(model.scene, camera, lights, key)
        self._map.use(5)
        mean = self._drawn(model, plain=False)
        linear = mean[..., :3] + (1 - mean[..., 3:]) * background
        return np.asarray(to_srgb(np.clip(linear, 0, 1)) * 255 + 0.5, np.uint8)

    def shares(self, model: Model, values: FloatArray) -> FloatArray:
        """(S, S, 3) what the last picture shows of values (n, 3) at points, 0 where nothing of the face is.

        What lights the model is lost: its next picture begins with `draw`.
        """
        model.carry(values)
        self._fine.use()
        return self._drawn(model, plain=True)[..., :3]

    def _drawn(self, model: Model, *, plain: bool) -> FloatArray:
        """(S, S, 4) means of samples, times their opacity.

        :param plain: what points carry, as it is
        """
        self._surface["plain"].write(np.asarray(plain, "i4").tobytes())
        self._fine.clear(0, 0, 0, 0, depth=1.0)
        for piece in model.pieces:
            self._set_material(model, piece)
            clear = piece.kind == _CLEAR
            self._context.enable_only(moderngl.DEPTH_TEST | (moderngl.BLEND if clear else 0))
            self._fine.depth_mask = not clear
            model.surfaces.render(vertices=piece.count, first=piece.first)
        self._fine.depth_mask = True
        self._samples.build_mipmaps(max_level=1)
        samples = np.frombuffer(self._samples.read(level=1), np.float16)
        return samples.reshape(self.size, self.size, 4)[::-1].astype(np.float32)

    def _set_view(self, scene: Scene, camera: Camera, lights: Portrait, key: FloatArray) -> None:
        depth = camera.project(scene.points)[:, 3]
        near, far = max(depth.min() - 1, 0.5), depth.max() + 1
        values = {
            "axes": camera.axes.T,
            "eye": camera.eye,
            "lens": (camera.focal, *camera.center, self.size),
            "reach": (near, far),
            "to_map": key.T,
            "up": camera.axes[:, 1],
            "sky": lights.sky,
            "ground": lights.ground,
            "exposure": lights.exposure,
        }
        for name, value in values.items():
            self._surface[name].write(np.asarray(value, "f4").tobytes())
        boxes = lights.boxes
        self._surface["box_count"].value = len(boxes)
        for name, rows in {
            "box_axes": [box.axes for box in boxes],  # rows: across, up, towards: columns in GLSL
            "box_color": [box.color for box in boxes],
            "box_shape": [(*box.size, box.spread, box.glare) for box in boxes],
        }.items():
            rows = np.asarray(rows, "f4")
            padded = np.concatenate([rows, np.zeros((_MOST_BOXES - len(rows), *rows.shape[1:]), "f4")])
            self._surface[name].write(padded.tobytes())

    def _set_material(self, model: Model, piece: _Piece) -> None:
        material, numbers = piece.material, {"kind": piece.kind, "double_sided": int(piece.double_sided)}
        for slot, name in enumerate(_TEXTURED):
            source = getattr(material, name)
            textured = isinstance(source, TextureInput)
            (model.texture(source.texture, color=name == "diffuse_color") if textured else self._white).use(slot)
            if name in ("diffuse_color", "normal"):
                numbers[f"{name}_scale"] = np.ones(3) if source is None else source.scale[:3] if textured else source
            else:
                channel = _CHANNEL[source.channels] if textured else 0
                scale, bias = (source.scale[channel], source.bias[channel]) if textured else (0.0, source)
                numbers[name] = (scale, bias, channel)
        numbers["bumpy"] = int(material.normal is not None)
        numbers["threshold"] = material.opacity_threshold
        numbers["mirror"] = ((material.ior - 1) / (material.ior + 1)) ** 2
        numbers["loose"] = int(isinstance(material.opacity, TextureInput))
        for name, value in numbers.items():
            kind = "i4" if isinstance(value, int) else "f4"
            if name in self._surface:
                self._surface[name].write(np.asarray(value, kind).tobytes())


class Model:
    """A face on the card: its triangles and textures once, points of a pose, and the light of a view."""

    def __init__(
        self, context: moderngl.Context, surface: moderngl.Program, depth: moderngl.Program, scene: Scene
    ) -> None:
        self._context, self._textures = context, {}
        order, self.pieces = _pieces(scene)
        uv = np.nan_to_num(scene.uv_corners("st")[order].reshape(-1, 2))
        points = scene.triangles[order].ravel()
        rows = np.ascontiguousarray(np.column_stack([points.astype(np.float32), uv]), np.float32)
        distinct, index = np.unique(rows.view(np.dtype((np.void, rows.itemsize * 3))).ravel(), return_inverse=True)
        distinct = distinct.view(np.float32).reshape(-1, 3)
        self._points = distinct[:, 0].astype(np.int64)
        count = len(self._points)
        self._place = context.buffer(reserve=count * 24, dynamic=True)
        self._carried = context.buffer(reserve=count * 24, dynamic=True)
        uvs = context.buffer(np.ascontiguousarray(distinct[:, 1:], "f4").tobytes())
        self.surfaces = context.vertex_array(
            surface,
            [
                (self._place, "3f 3f", "point", "normal"),
                (uvs, "2f", "uv"),
                (self._carried, "3f 3f", "ahead", "behind"),
            ],
            context.buffer(index.astype("i4").tobytes()),
        )
        self._solid = context.buffer(reserve=len(scene.points) * 12, dynamic=True)
        hiding = context.buffer(scene.occluders.astype("i4").tobytes())
        self.occluders = context.vertex_array(depth, [(self._solid, "3f", "point")], hiding)
        self.pose(scene)

    def pose(self, scene: Scene) -> None:
        """Another pose of the same face."""
        self.scene = scene
        self._sky = Sky(directions=scene.sky.directions.astype(np.float32), seen=scene.sky.seen.astype(np.float32))
        self._place.write(np.column_stack([scene.points, scene.normals])[self._points].astype("f4").tobytes())
        self._solid.write(scene.points.astype("f4").tobytes())

    def light(self, lights: Portrait, camera: Camera) -> None:
        """What of the dome and of each box arrives at points."""
        normals = self.scene.normals.astype(np.float32)
        sides = [lights.carried(self._sky, one, camera.axes) for one in (normals, -normals)]
        room = ((0, 0), (0, _MOST_BOXES - sides[0].shape[1]))
        self.carry(np.concatenate([np.pad(side, room) for side in sides], axis=1))

    def carry(self, values: FloatArray) -> None:
        """Values at points: (n, 6) of fronts and backs, or (n, 3) of both."""
        both = np.tile(values, 6 // values.shape[1])
        self._carried.write(both[self._points].astype("f4").tobytes())

    def texture(self, texture: Texture, *, color: bool) -> moderngl.Texture:
        """The texture on the card."""
        if (texture, color) not in self._textures:
            pixels = decode(texture, 512)[::-1]
            options = {"internal_format": _SRGB8_ALPHA8} if color else {}
            loaded = self._context.texture(pixels.shape[1::-1], 4, np.ascontiguousarray(pixels).tobytes(), **options)
            loaded.build_mipmaps()
            loaded.anisotropy = 4.0
            self._textures[texture, color] = loaded
        return self._textures[texture, color]

    def release(self) -> None:
        """Free what the card holds."""
        for loaded in self._textures.values():
            loaded.release()
        self._textures.clear()
        for array in (self.surfaces, self.occluders):
            array.index_buffer.release()
            array.release()
        for buffer in (self._place, self._carried, self._solid):
            buffer.release()


def _pieces(scene: Scene) -> tuple[npt.NDArray[np.integer], list[_Piece]]:
    """The order of triangles (t,), and which of them are of which material."""
    rows, pieces, at = [], [], 0
    kinds = [(_kind(surface.material), number) for number, surface in enumerate(scene.surfaces)]
    for kind, number in sorted(kinds):
        found = np.flatnonzero(scene.surface == number)
        if len(found):
            surface = scene.surfaces[number]
            pieces.append(
                _Piece(
                    kind=kind,
                    first=3 * at,
                    count=3 * len(found),
                    material=surface.material or _plain(),
                    double_sided=surface.mesh.double_sided,
                )
            )
            rows.append(found)
            at += len(found)
    return np.concatenate(rows), pieces


@cache
def _plain() -> Material:
    return Material(name="")


def _kind(material: Material | None) -> int:
    if material is None or not isinstance(material.opacity, TextureInput):
        return _SOLID
    return _STRANDS if material.opacity_threshold > 0 else _CLEAR


def _key_map(scene: Scene, towards: FloatArray) -> FloatArray:
    """(4, 4) from the world to -1..1 of the key's map, the third axis away from the light."""
    backward = towards / np.linalg.norm(towards)
    right = np.cross(np.eye(3)[np.argmin(np.abs(backward))], backward)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(backward, right), -backward])
    at = scene.points @ axes.T
    low, high = at.min(axis=0), at.max(axis=0)
    scale = 2 / (np.ptp(at[:, :2], axis=0).max() * 1.02), 2 / ((high - low)[2] * 1.02)
    result = np.eye(4)
    result[:3, :3] = axes * np.array([scale[0], scale[0], scale[1]])[:, None]
    result[:3, 3] = -(low + high) / 2 * (scale[0], scale[0], scale[1])
    return result
