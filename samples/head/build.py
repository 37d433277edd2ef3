"""Makes the package data of the head in the box: `python samples/head/build.py --data FOLDER`.

FOLDER holds `ict_facekit/ict_facekit.npz` and `makehuman/makehuman_head.npz`. The same folder gives the same bytes.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

import arcs
import numpy as np
import numpy.typing as npt
from model import KEPT, Floats, Model, read
from packing import packed, write_arrays

from facepipe.geometry.balls import fit_ball
from facepipe.geometry.borders import back_of_border
from facepipe.importers.ict_regions import REGIONS, head_regions
from facepipe.importers.ict_topology import LANDMARKS, MATERIALS

ROOT = Path(__file__).parents[2]
LICENCES = {"ict_facekit/LICENSE": "LICENSE.ICT-FaceKit.txt", "makehuman/LICENSE.ASSETS.md": "LICENSE.MakeHuman.md"}
SMALLEST = 0.002  # cm: moves below are rounding noise of the source
EYES = {"Left": "Eyeball left", "Right": "Eyeball right"}
HALFWAY = (0.25, 0.5, 0.75)

Arrays = dict[str, npt.NDArray[Any]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "facepipe" / "heads" / "data")
    arguments = parser.parse_args()
    out, model = arguments.out, read(arguments.data)
    out.mkdir(exist_ok=True)
    write_arrays(out / "head.npz", surface(model) | shapes(model))
    write_arrays(out / "modes.npz", {"modes": packed(model.modes)})
    for source, name in LICENCES.items():
        shutil.copyfile(arguments.data / source, out / name)
    for path in sorted(out.iterdir()):
        print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB")


def surface(model: Model) -> Arrays:
    """Points, faces, texture coordinates, materials, regions, landmarks and anchor."""
    heads = [part for part in KEPT if part.mesh == "Head"]
    count, faces = heads[-1].points[1], heads[-1].faces[1]
    corners = int(model.counts[:faces].sum())
    regions = head_regions(model.points)
    anchor = back_of_border(model.points[:count], model.counts[:faces], model.indices[:corners])
    meshes = list(dict.fromkeys(part.mesh for part in KEPT))
    last = {part.mesh: part for part in KEPT}
    regions_of = {part.mesh: part.region for part in reversed(KEPT)}  # Head's first part has none
    return {
        "points": model.points.astype(np.float32),
        "counts": model.counts.astype(np.uint8),
        "indices": model.indices,
        "uvs": model.uvs.astype(np.float32),
        "uv_indices": model.uv_indices,
        "materials": model.materials.astype(np.uint8),
        "material_names": np.array(list(MATERIALS)),
        "meshes": np.array(meshes),
        "mesh_ends": np.array([(last[name].points[1], last[name].faces[1]) for name in meshes], np.int32),
        "mesh_regions": np.array([regions_of[name] for name in meshes]),
        "region_names": np.array(REGIONS),
        "regions": np.rint(255 * np.stack([regions[name] for name in REGIONS])).astype(np.uint8),
        "landmarks": np.array(LANDMARKS, np.int32),
        "anchor": np.array(anchor, np.int32),
    }


def shapes(model: Model) -> Arrays:
    """Shapes with their inbetweens."""
    found = {name: {1.0: quiet(shape)} for name, shape in model.shapes.items()}
    hinge = jaw_hinge(model)
    jaw, close = found["jawOpen"][1.0], found["mouthClose"][1.0]
    found["jawOpen"][0.5] = arcs.about_axis(model.points, jaw, hinge, 0.5)
    found["mouthClose"][0.5] = arcs.about_axis(model.points, jaw + close, hinge, 0.5) - found["jawOpen"][0.5]
    for side, part in EYES.items():
        centre = eye_centre(model, part)
        for name, weights in (("eyeBlink", HALFWAY), ("eyeLookDown", (0.5,))):
            ways = found[name + side]
            ways |= {share: arcs.about_point(model.points, ways[1.0], centre, share) for share in weights}
    rows = [(name, weight) for name in found for weight in sorted(found[name])]
    return {
        "shape_names": np.array([name for name, _ in rows]),
        "shape_weights": np.array([weight for _, weight in rows]),
        "shapes": packed(np.stack([found[name][weight] for name, weight in rows])),
    }


def quiet(shape: Floats) -> Floats:
    """The offsets without those that are rounding noise."""
    return np.where(np.linalg.norm(shape, axis=1, keepdims=True) < SMALLEST, 0.0, shape)


def jaw_hinge(model: Model) -> Floats:
    """(3,) about which the lower teeth turn as the jaw opens."""
    teeth = slice(*next(part.points for part in KEPT if part.mesh == "Teeth"))
    opened = model.shapes["jawOpen"][teeth]
    lower = np.linalg.norm(opened, axis=1) > 1.0
    return arcs.jaw_hinge(model.points[teeth][lower], opened[lower])


def eye_centre(model: Model, title: str) -> Floats:
    """(3,) of the ball of an eye, whatever its cornea does."""
    part = next(part for part in KEPT if part.title == title)
    return fit_ball(model.points[slice(*part.points)]).centre


if __name__ == "__main__":
    main()
