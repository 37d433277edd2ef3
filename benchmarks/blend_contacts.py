"""How much deeper skin lies in eyeballs, teeth, gums and the other lip after random blends than in their sources.

Two people of the head in the box each, a share of 0, of 1 or between for every region, at rest and in ARKit's 52
shapes. By teeth, gums and lips the skin that counts is what rays meet with pressed lips, by eyeballs all around them.
Its depth is the exact distance to the nearest place of the part, inside by the normal there: code that the blend's own
measure has no part in. That of lips is the shortest way back to where the face's winding number says no flesh laps.

example: python benchmarks/blend_contacts.py --blends 30 --json out.json
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
import support_modules  # noqa: F401  (finds the modules of tests/support)
from arguments import positive
from contacts import PRESSED
from scipy.spatial import cKDTree

import facepipe
from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.closest_points import SurfaceSearch, place_shares
from facepipe.geometry.contacts import Sheet
from facepipe.geometry.polygons import components, point_normals, point_triangles
from facepipe.geometry.vectors import unit_vectors
from facepipe.geometry.winding_numbers import WindingNumbers
from facepipe.rig.conventions import ARKIT_SHAPES
from facepipe.verbs.blend import BlendOptions, BlendSession, Weights
from facepipe.verbs.blend.session import Solution

PEOPLE = 40
REGIONS = ("cheek", "chin", "ears", "eyebrows", "eyes", "forehead", "mouth", "neck", "nose")
BOUNDS = {
    "EyeballLeft": 0.1,
    "EyeballRight": 0.1,
    "Teeth": 0.3,
    "GumsAndTongue": 0.3,
    "Lips": 0.3,
}  # mm over the deeper source
EYEBALLS, MOUTH = ("EyeballLeft", "EyeballRight"), ("Teeth", "GumsAndTongue")
_STEP_MM, _DEEPEST_MM = 0.1, 6.0  # of the depth of lips
# (98, 3) all around; of 26, not one of which grazed no lip, a point in 30 blends seemed 6.1 mm deep for 1.0
_STEEPS = np.array(list(product((-1.0, -0.5, 0.0, 0.5, 1.0), repeat=3)))
_WAYS = unit_vectors(_STEEPS[np.abs(_STEEPS).max(axis=1) == 1.0])
_WITHIN = np.cos(np.radians(45.0))  # of straight back
_OFF_MM = 0.02  # from skin, where it is asked whether that lies in flesh
# Of a part: skin farther away is not looked at. Sockets lie over 6 mm deep in eyeballs; skin that went deeper in teeth
# and gums would be at 6 mm too, and 12 mm above that of the chin lies the floor of the mouth, which faces up.
_BEHIND_MM = dict.fromkeys(EYEBALLS, 12.0) | dict.fromkeys(MOUTH, 6.0)

_OUTSIDE_MM = 0.7  # of the plane at the nearest point

Pose = tuple[str, list[FloatArray]]  # name, and points (n, 3) mm of the sources and, last, of the blend
Figures = dict[str, dict[str, object]]


def main() -> int:
    """Blend, measure, print; 1 where a part is deeper than its bound or a triangle turns over."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blends", type=positive, default=30, help="pairs of people (default 30)")
    parser.add_argument("--first", type=int, default=0, help="number of the first pair (default 0)")
    parser.add_argument("--no-contacts", action="store_true", help="blend as before skin was held out")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    given = parser.parse_args()
    found, worst = [], dict.fromkeys(BOUNDS, -np.inf)
    with tempfile.TemporaryDirectory() as folder:
        for number in range(given.first, given.first + given.blends):
            one = measure(number, Path(folder), BlendOptions(contacts=not given.no_contacts))
            found.append(one)
            worst = {name: max(deepest, one["parts"][name]["over_mm"]) for name, deepest in worst.items()}
            parts = ", ".join(f"{name} {row['over_mm']:.2f} ({row['shape']})" for name, row in one["parts"].items())
            print(f"{number}: seeds {one['seeds']}: {parts}; turned {one['turned']}", flush=True)
    print("most over the deeper source, mm: " + ", ".join(f"{name} {mm:.3f}" for name, mm in worst.items()))
    turned = sum(one["turned"] for one in found)
    print(f"triangles turned over: {turned}; seconds to solve: {np.mean([one['seconds'] for one in found]):.1f}")
    if given.json:
        given.json.write_text(json.dumps(found, indent=1), encoding="utf-8")
    return int(turned > 0 or any(worst[name] > bound for name, bound in BOUNDS.items()))


def measure(number: int, folder: Path, options: BlendOptions) -> dict:
    """One blend: by part how much deeper skin lies than in the deeper source, and where most."""
    random = np.random.Generator(np.random.PCG64(number))
    seeds = [int(seed) for seed in random.choice(np.arange(1, PEOPLE + 1), 2, replace=False)]
    shares = {name: float(random.choice([0.0, 1.0, random.uniform()])) for name in (*REGIONS, "default")}
    weights = Weights(
        regions={name: (1.0 - shares[name], shares[name]) for name in REGIONS},
        default=(1.0 - shares["default"], shares["default"]),
    )
    paths = [folder / f"{seed}.usdc" for seed in seeds]
    for seed, path in zip(seeds, paths, strict=True):
        if not path.exists():
            facepipe.sample(path, seed=seed)
    session = BlendSession([facepipe.open(path) for path in paths], options, live=False)
    start = time.process_time()
    solution = session.solve(weights)
    seconds = time.process_time() - start
    return {
        "seeds": seeds,
        "shares": shares,
        "seconds": seconds,
        "turned": solution.neutral.held.turned + sum(held.turned for held in solution.held),
        "parts": deepest(session, solution),
    }


def deepest(session: BlendSession, solution: Solution) -> Figures:
    """By part: the point that lies deepest in it beyond the source that has it deepest, in the worst shape."""
    sources, mm = session.sources, session.sources.mm_per_unit
    triangles = {
        mesh.name: point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices).astype(np.int64) + int(start)
        for mesh, start in zip(sources.base.meshes, sources.mesh_offsets[:-1], strict=True)
    }
    found: Figures = {}
    for name in (*EYEBALLS, *MOUTH):
        part, skin = triangles[name], np.unique(triangles["Head"])
        if name in MOUTH:
            skin = _outer(session, triangles["Head"], triangles[name])
        else:
            part = _outer_shell(part, sources.points[0])
            middle, reach = (
                sources.points[0, part].mean(axis=(0, 1)),
                np.ptp(sources.points[0, part], axis=(0, 1)).max(),
            )
            skin = skin[np.linalg.norm(sources.points[0, skin] - middle, axis=1) < reach]
        hard = np.unique(part)
        for shape, faces in _poses(solution, sources.points, mm, np.union1d(skin, hard)):
            *theirs, own = (_depths(points, skin, hard, part, _BEHIND_MM[name]) for points in faces)
            # of teeth the deepest points of each, as lips slide over them; of eyeballs the same point
            if name in MOUTH:
                theirs, own = [depths.max(keepdims=True) for depths in theirs], own.max(keepdims=True)
            over = own - np.max(theirs, axis=0)
            worst = int(over.argmax())
            if name not in found or over[worst] > found[name]["over_mm"]:
                row = [float(depths[worst]) for depths in (*theirs, own)]
                found[name] = {"over_mm": float(over[worst]), "shape": shape, "depths_mm": row}
    outer = _outer(session, triangles["Head"], triangles["Teeth"])
    return found | {"Lips": _lips(session, solution, triangles["Head"], outer)}


def _outer(session: BlendSession, skin: IntArray, hard: IntArray) -> IntArray:
    """Points of the skin before teeth or gums that rays meet with pressed lips."""
    mm = session.sources.mm_per_unit
    closed = session.sources.points[0] * mm
    for sculpt in session.sculpts:
        if sculpt.name in PRESSED:
            closed[sculpt.points] += sculpt.offsets[0] * mm
    return np.unique(Sheet.of(skin, hard, [closed]).outer)


def _lips(session: BlendSession, solution: Solution, skin: IntArray, outer: IntArray) -> dict[str, object]:
    """How much deeper outer skin of the lips lies in flesh than in the deeper source, in the worst shape."""
    found: dict[str, object] = {"over_mm": 0.0, "shape": "rest"}
    sources, lips = session.sources, [body.skin for body in session.contacts.bodies if body.soft]
    watched = np.intersect1d(np.concatenate(lips), outer)
    for shape, (*theirs, own) in _poses(solution, sources.points, sources.mm_per_unit, watched):
        deep = _in_flesh(own, watched, skin)
        if deep > found["over_mm"]:  # else it can't be the worst, whatever the sources have
            depths = [_in_flesh(points, watched, skin) for points in theirs]
            if deep - max(depths) > found["over_mm"]:
                found = {"over_mm": deep - max(depths), "shape": shape, "depths_mm": [*depths, deep]}
    return found


def _in_flesh(points: FloatArray, watched: IntArray, skin: IntArray) -> float:
    """mm that skin at the worst of some points lies in flesh of the face: the shortest way back to where none laps.

    Straight back alone grazes: 6 mm at a place 0.3 mm from the other lip's surface.
    """
    places, inward, numbers = points[watched], -point_normals(points, skin)[watched], WindingNumbers(points, skin)
    deep = np.flatnonzero(numbers.at(places - _OFF_MM * inward) > 0.5)
    straight = [_way_back(numbers, places[row], inward[row], _DEEPEST_MM) for row in deep]
    found = 0.0
    for far, row in sorted(zip(straight, deep.tolist(), strict=True), reverse=True):
        for way in _WAYS[_WAYS @ inward[row] > _WITHIN] if far > found else ():
            far = min(far, _way_back(numbers, places[row], way, far))
        found = max(found, far)
    return found


def _way_back(numbers: WindingNumbers, place: FloatArray, way: FloatArray, most: float) -> float:
    """mm from a place (3,) along a unit vector to where no flesh laps over itself, up to `most`."""
    depth = 0.0
    while depth < most and numbers.at((place + (depth + _STEP_MM) * way)[None])[0] > 1.5:
        depth += _STEP_MM
    return depth


def _outer_shell(triangles: IntArray, points: FloatArray) -> IntArray:
    """(h, 3) those of an eyeball's outermost piece: it has a second shell inside."""
    used, local = np.unique(triangles, return_inverse=True)
    local = local.reshape(-1, 3)
    piece = components(len(used), np.concatenate([local[:, :2], local[:, 1:]]))
    away = np.linalg.norm(points[used] - points[used].mean(axis=0), axis=1)
    mean = np.bincount(piece, away) / np.bincount(piece)
    return triangles[piece[local[:, 0]] == mean.argmax()]


def _poses(solution: Solution, sources: FloatArray, mm: float, watched: IntArray) -> Iterator[Pose]:
    """At rest, and every shape that moves what is watched."""
    rest = [*sources, solution.neutral.points]
    yield "rest", [points * mm for points in rest]
    for sculpt, offsets in zip(solution.sculpts, solution.offsets, strict=True):
        if sculpt.shape in ARKIT_SHAPES and np.isin(sculpt.points, watched).any():
            posed = [points.copy() for points in rest]
            for points, moved in zip(posed, (*sculpt.offsets, offsets), strict=True):
                points[sculpt.points] += moved
            yield sculpt.name, [points * mm for points in posed]


def _depths(points: FloatArray, skin: IntArray, hard: IntArray, triangles: IntArray, behind: float) -> FloatArray:
    """(s,) mm that the points `skin` (s,) lie inside the triangles (h, 3), whose points are `hard`; 0 outside.

    :param behind: mm of the triangles within which skin is looked at
    """
    surface, local = points[hard], np.searchsorted(hard, triangles)
    own, depths = point_normals(surface, local), np.zeros(len(skin))
    # what is far from the part, or clearly outside of the plane at its nearest point, is left out: it takes long
    far, near = cKDTree(surface).query(points[skin], distance_upper_bound=behind)
    rows = np.flatnonzero(np.isfinite(far))
    beside = np.einsum("mi,mi->m", points[skin[rows]] - surface[near[rows]], own[near[rows]])
    rows = rows[beside < _OUTSIDE_MM]
    if len(rows):
        nearest = SurfaceSearch(surface, local).closest(points[skin[rows]])
        shares = place_shares(nearest, surface, local)
        normals = unit_vectors(np.einsum("mk,mkc->mc", shares, own[local[nearest.triangles]]))
        inside = np.einsum("mi,mi->m", points[skin[rows]] - nearest.places, normals) < 0
        depths[rows[inside]] = nearest.distances[inside]
    return depths


if __name__ == "__main__":
    sys.exit(main())
