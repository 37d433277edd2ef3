"""Makes the package data of the head in the box: `python samples/head/build.py --data FOLDER`.

FOLDER holds `ict_facekit/ict_facekit.npz` and `makehuman/makehuman_head.npz`. The same folder gives the same bytes.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import arcs
import cards
import directions
import eyes
import locks
import measures
import mouth
import numpy as np
import numpy.typing as npt
import skin_maps
import strokes
import traits
import wrinkles
from anatomy import Jaw, Tongue, eye_centre, jaw_of, tongue_of
from basis import basis
from lids import Stretch, lids, stretch
from lips import rolled
from mirror import evened, mirror_points
from model import KEPT, Floats, Model, read
from packing import STEP, packed, write_arrays
from skeleton import Skeleton, skeleton
from teeth import smaller
from tongue import tongue_out

from facepipe.geometry.polygons import back_of_border
from facepipe.heads.asset import BASIS
from facepipe.importers.ict import LANDMARKS, MATERIALS, REGIONS, head_regions
from facepipe.payload.basis import encode_basis

ROOT = Path(__file__).parents[2]
LICENCES = {"ict_facekit/LICENSE": "LICENSE.ICT-FaceKit.txt", "makehuman/LICENSE.ASSETS.md": "LICENSE.MakeHuman.md"}
SMALLEST = 0.002  # cm: moves below are rounding noise of the source

Arrays = dict[str, npt.NDArray[Any]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "facepipe" / "heads" / "data")
    arguments = parser.parse_args()
    out, model = arguments.out, read(arguments.data)
    out.mkdir(exist_ok=True)
    mirror = mirror_points(model.points, model.shapes, model.indices, model.counts)
    model = replace(model, shapes=rolled(evened(model.shapes, mirror)))
    jaw = jaw_of(model)
    model = smaller(model, jaw)
    tongue = tongue_of(model)
    regions = head_regions(model.points)
    made = skeleton(model, mirror, jaw, tongue, regions, arguments.data)
    write_arrays(out / "head.npz", surface(model, regions) | shapes(model, jaw, tongue) | joints(made))
    steps = np.rint(model.modes.astype(np.float64).transpose(0, 2, 1) / STEP).astype(np.int16)
    (out / BASIS).write_bytes(encode_basis(basis(model, steps, made)))
    margins = lids(model, mirror)
    write_arrays(out / "lids.npz", margins)
    modes = np.ascontiguousarray(steps.transpose(0, 2, 1)) * np.float32(STEP)
    found = controls(model, modes, stretch(model, made, margins), arguments.data)
    write_arrays(out / "measures.npz", found)
    ict = arguments.data / "ict_facekit" / "ict_facekit.npz"
    skin_maps.main(ict, out / "skin_maps.npz")
    wrinkles.main(ict, model.shapes, out)
    cards.main(ict, out)
    for pictures in (strokes, locks, eyes):
        pictures.main(out)
    mouth.main(arguments.data, out)
    for table in ("mixes.json", "bone_sliders.json", "dense.json"):
        shutil.copyfile(Path(__file__).parent / table, out / table)
    for source, name in LICENCES.items():
        shutil.copyfile(arguments.data / source, out / name)
    for path in sorted(out.iterdir()):
        print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB")


def surface(model: Model, regions: dict[str, Floats]) -> Arrays:
    """Points, faces, texture coordinates, materials, regions, landmarks and anchor."""
    heads = [part for part in KEPT if part.mesh == "Head"]
    count, faces = heads[-1].points[1], heads[-1].faces[1]
    corners = int(model.counts[:faces].sum())
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


def shapes(model: Model, jaw: Jaw, tongue: Tongue) -> Arrays:
    """Shapes with their inbetweens."""
    found = {name: {1.0: shape} for name, shape in model.shapes.items()}
    opened, closed = model.shapes["jawOpen"], model.shapes["mouthClose"]
    half = arcs.about_axis(model.points, opened, jaw.hinge, 0.5)
    found["jawOpen"][0.5] = half
    found["mouthClose"][0.5] = arcs.about_axis(model.points, opened + closed, jaw.hinge, 0.5) - half
    for side in ("Left", "Right"):
        centre = eye_centre(model, side)
        for name, weights in (("eyeBlink", (0.25, 0.5, 0.75)), ("eyeLookDown", (0.5,))):
            ways = found[name + side]
            ways |= {share: arcs.about_point(model.points, ways[1.0], centre, share) for share in weights}
    found["tongueOut"] = tongue_out(model, jaw, tongue)
    rows = [(name, weight) for name in sorted(found) for weight in sorted(found[name])]
    return {
        "shape_names": np.array([name for name, _ in rows]),
        "shape_weights": np.array([weight for _, weight in rows]),
        "shapes": packed(np.stack([quiet(found[name][weight]) for name, weight in rows])),
    }


def joints(made: Skeleton) -> Arrays:
    """Joints, the points that they follow, and skin weights."""
    return {
        "joints": np.array(made.joints),
        "joint_points": made.points,
        "joint_shares": made.shares.astype(np.float32),
        "skin_joints": made.indices.astype(np.uint8),
        "skin_weights": np.rint(made.weights * np.iinfo(np.uint16).max).astype(np.uint16),
    }


def controls(model: Model, modes: npt.NDArray[np.float32], lid_joints: Stretch, data: Path) -> Arrays:
    """What measures do to the head, and the weights of identity modes that are typical of sex and age."""
    starts = {part.mesh: part.points[0] for part in reversed(KEPT)}
    parts = {name: slice(starts[name], part.points[1]) for name, part in ((part.mesh, part) for part in KEPT)}
    landmarks = np.array(LANDMARKS, np.int32)
    found = measures.build(model.points, modes, parts, (model.counts, model.indices), landmarks)
    source = data / "makehuman" / "makehuman_head.npz"
    found |= traits.build(model.points, modes, landmarks, found["parity"], source)
    found |= directions.build(model.points, modes, parts, found, lid_joints)
    return {name: values for name, values in found.items() if name not in ("weights", "parity")}


def quiet(shape: Floats) -> Floats:
    """The offsets without those that are rounding noise."""
    return np.where(np.linalg.norm(shape, axis=1, keepdims=True) < SMALLEST, 0.0, shape)


if __name__ == "__main__":
    main()
