"""How well `facepipe bake-photo` finds the colours of skin that is known, under light that it has to find.

usage: python benchmarks/photo_texture.py [--seeds 3 5 8 14] [--size 512] [--pixels 640] [--json out.json]

Each person is photographed under four studios, from three sides in turn, with highlights and cast shadows. The stage
has the person's shape, camera and pose, and the skin of the average head. Its light is harmonics alone, by least
squares of the photo over that skin: what a fit that knows the shape would find, as far off in tone as that head is.

Columns, over the texels that the photo gives a confidence above 0.5, mean absolute differences in sRGB:

  error      of the baked colours from the person's
  evenness   the same after the median difference is taken out: what is left of light, shadows and highlights
  template   of the average head's colours from the person's
  shown      share of the face that the photo shows
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from arguments import positive
from tables import aligned

from facepipe.core.arrays import Float32Array, FloatArray
from facepipe.geometry.colors import from_srgb, to_srgb
from facepipe.heads import make
from facepipe.parts import FaceParts, PhotoView, TextureInput
from facepipe.pictures import PictureOptions, picture
from facepipe.pictures.camera import Camera
from facepipe.pictures.lighting import Light, Studio, harmonics
from facepipe.rig import build
from facepipe.textures.bake import Baker, template_texels
from facepipe.textures.seen_skin import Exposure, expose, sampled, to_pixels
from facepipe.textures.skin_surface import SkinSurface, skin_of

SKIN = ("M_Face", "M_BackHead")
YAWS = (0.0, 0.3, -0.3)
STUDIOS = {  # direction and colour of the lamp, sky, ground
    "front": ((0.1, 0.3, 0.95), (0.55, 0.55, 0.55), (0.5, 0.5, 0.5), (0.3, 0.3, 0.3)),
    "side": ((0.8, 0.35, 0.5), (1.0, 0.95, 0.9), (0.35, 0.37, 0.4), (0.2, 0.2, 0.2)),
    "top": ((-0.2, 0.8, 0.55), (1.0, 1.0, 1.0), (0.5, 0.5, 0.52), (0.15, 0.14, 0.13)),
    "warm": ((-0.5, 0.3, 0.8), (0.9, 0.75, 0.55), (0.4, 0.38, 0.34), (0.2, 0.2, 0.2)),
}
FIGURES = ("error", "evenness", "template", "shown")


def main() -> None:
    """Photograph, bake, print the table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=positive, nargs="+", default=[3, 5, 8, 14], help="people (default 3 5 8 14)")
    parser.add_argument("--size", type=positive, default=512, help="texels a side (default 512)")
    parser.add_argument("--pixels", type=positive, default=640, help="of the photos, a side (default 640)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    rows = [row for number, seed in enumerate(arguments.seeds) for row in measured(seed, number, arguments)]
    mean = {figure: float(np.mean([row[figure] for row in rows])) for figure in FIGURES}
    cells = [(str(row["seed"]), str(row["light"]), *(f"{row[figure]:.3f}" for figure in FIGURES)) for row in rows]
    cells.append(("mean", "", *(f"{mean[figure]:.3f}" for figure in FIGURES)))
    print("\n".join(aligned([("seed", "light", *FIGURES), *cells])))
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": rows, "mean": mean}, indent=2) + "\n", encoding="utf-8")


def measured(seed: int, number: int, arguments: argparse.Namespace) -> Iterator[dict[str, object]]:
    """A row for each light."""
    person, average = (make(each, textures=arguments.size) for each in (seed, 0))
    skins = {material.name: material for material in average.materials if material.name in SKIN}
    stage = replace(person, materials=tuple(skins.get(material.name, material) for material in person.materials))
    points = build(person).evaluate()
    camera = camera_at(points[: len(person.meshes[0].points)], YAWS[number % len(YAWS)], arguments.pixels)
    skin = skin_of(stage, points, arguments.size)
    for light, (direction, color, sky, ground) in STUDIOS.items():
        lamps = (Light(direction=direction, color=color),)
        studio = Studio(lights=lamps, sky=sky, ground=ground, compress=False)
        options = PictureOptions(size=arguments.pixels, samples=2, camera=camera, studio=studio)
        photo = np.asarray(picture(person, points, options), np.float32) / 255
        yield {"seed": seed, "light": light, **figures(skin, person, points, camera, photo)}


def camera_at(points: FloatArray, yaw: float, size: int) -> Camera:
    """A camera before a head, `yaw` radians to its left."""
    backward = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    axes = np.stack([[np.cos(yaw), 0.0, -np.sin(yaw)], [0.0, 1.0, 0.0], backward])
    middle, focal = (points.min(axis=0) + points.max(axis=0)) / 2, 1.9 * size
    eye = middle + 1.15 * np.ptp(points[:, 1]) * focal / size * backward
    return Camera(axes=axes, eye=eye, focal=focal, center=(size / 2, size / 2))


def figures(
    skin: SkinSurface, person: FaceParts, points: FloatArray, camera: Camera, photo: Float32Array
) -> dict[str, float]:
    """The columns of a photo."""
    transform, size = np.eye(4), len(photo)
    transform[:3, :3], transform[:3, 3] = camera.axes.T, camera.eye
    view = PhotoView(
        name="photo",
        width=size,
        height=size,
        transform=transform,
        focal=camera.focal,
        center=camera.center,
        clipping=(1.0, 1e4),
        light=np.zeros((9, 3)),
    )
    baker = Baker(skin)
    light = light_of(expose(skin, view, photo, points), np.exp(baker.template))
    exposure = expose(skin, replace(view, light=light), photo, points)
    baked, off, before = baker([exposure]), [], []
    materials = {material.name: material.diffuse_color for material in person.materials}
    for texture, picture_, flat in zip(skin.textures, baked.pictures, baker.flats, strict=True):
        source = materials[texture.materials[0]]
        assert isinstance(source, TextureInput)
        seen = texture.texels.carried(baked.trust[:, None])[:, 0] > 0.5
        at = texture.texels.at[seen]
        truth = to_srgb(template_texels(replace(texture, source=source)))[seen]
        off.append(picture_.reshape(-1, 3)[at] / 255 - truth)
        before.append(to_srgb(flat[seen]) - truth)
    errors = np.concatenate(off)
    return {
        "error": float(np.abs(errors).mean()),
        "evenness": float(np.abs(errors - np.median(errors, axis=0)).mean()),
        "template": float(np.abs(np.concatenate(before)).mean()),
        "shown": baked.seen,
    }


def light_of(photo: Exposure, colors: FloatArray) -> FloatArray:
    """(9, 3) harmonics under which points of linear colours (n, 3) look as in a photo: robust least squares."""
    seen = photo.trust > 0.5
    places, _ = to_pixels(photo.view, photo.points[seen])
    shown = from_srgb(sampled(photo.pixels, places, 1.0).astype(np.float64))
    shape = harmonics(photo.normals[seen]) + photo.light.hidden[seen]
    light = np.zeros((9, 3))
    for channel in range(3):
        rows, trust = shape * colors[seen, channel : channel + 1], np.ones(int(seen.sum()))
        ridge = 1e-4 * np.trace(rows.T @ rows) * np.eye(9)
        for _ in range(4):
            weighted = rows * trust[:, None]
            light[:, channel] = np.linalg.solve(weighted.T @ rows + ridge, weighted.T @ shown[:, channel])
            trust = 1 / (1 + ((rows @ light[:, channel] - shown[:, channel]) / 0.06) ** 2)
    return light


if __name__ == "__main__":
    main()
