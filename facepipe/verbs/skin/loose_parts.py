"""Weights of the loose parts of a face where only its main part has some: eyeballs, teeth, lashes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.closest_points import closest_places, place_shares
from facepipe.geometry.heat_weights import heat_weights, normalised
from facepipe.verbs.skin.features import Eyeball, Slit
from facepipe.verbs.skin.surface import Surface

_NEAREST = 1.0  # mm: parts that touch the face are smoothed over this length, others over their distance from it
_SMALL = 0.65  # of the mouth's width: parts up to this size lie above or below the mouth whole
_BLEND = 3.0  # mm over which larger ones change from upper to lower
_IN_BALL = 0.5  # a joint up to this many radii from the centre of an eyeball turns it


def following(surface: Surface, weights: FloatArray) -> FloatArray:
    """(m, j) weights of all points: those (i, j) of the main part, and of loose points the nearest of it, smoothed."""
    whole = np.zeros((len(surface.points), weights.shape[1]))
    whole[surface.inside] = weights
    if not len(surface.loose):
        return whole
    triangles = surface.part_triangles(surface.inside)
    places = closest_places(surface.points[surface.loose], surface.points[surface.inside], triangles)
    shares = place_shares(places, surface.points[surface.inside], triangles)
    nearest = np.einsum("mc,mcj->mj", shares, weights[triangles[places.triangles]])
    lengths = np.maximum(places.distances, _NEAREST)
    local = surface.part_triangles(surface.loose, even=True)
    whole[surface.loose] = normalised(heat_weights(surface.points[surface.loose], local, nearest, lengths))
    return whole


def joints_in(eyeballs: Sequence[Eyeball], positions: FloatArray, apart: BoolArray) -> dict[int, int]:
    """Eyeball -> the joint (of positions (j, 3), mm) nearest to its centre, where one is in it.

    :param apart: (j,) joints that turn an eyeball only where no other one does, such as those of lids
    """
    turning = {}
    for number, inside in enumerate(_inside(eyeballs, positions)):
        if inside.any():
            own = inside & ~apart if (inside & ~apart).any() else inside
            away = np.linalg.norm(positions - eyeballs[number].centre, axis=1)
            turning[number] = int(np.where(own, away, np.inf).argmin())
    return turning


def in_eyeballs(eyeballs: Sequence[Eyeball], positions: FloatArray) -> BoolArray:
    """(j,) whether a joint (of positions (j, 3), mm) is in an eyeball."""
    return np.asarray(np.any([np.zeros(len(positions), bool), *_inside(eyeballs, positions)], axis=0))


def _inside(eyeballs: Sequence[Eyeball], positions: FloatArray) -> list[BoolArray]:
    return [np.linalg.norm(positions - ball.centre, axis=1) <= _IN_BALL * ball.radius for ball in eyeballs]


def hold(weights: FloatArray, points: IntArray, joint: int) -> None:
    """Give points to one joint, whole."""
    weights[points] = 0.0
    weights[points, joint] = 1.0


def hold_parts(
    surface: Surface,
    weights: FloatArray,
    parts: Mapping[str, tuple[str, str]],
    joints: Sequence[str],
    mouth: Slit | None,
) -> tuple[str, ...]:
    """Give the loose parts that `parts` names to its joints; the names of the meshes.

    :raises InputError: a glob that matches no loose part, or parts above and below on a face without landmarks
    """
    done = []
    for glob, (above, below) in parts.items():
        names = [name for name in surface.mesh_names if fnmatchcase(name, glob)]
        if not names:
            some = ", ".join(surface.mesh_names[:6])
            raise InputError(f"{surface.where} -> parts", f"'{glob[:60]}' matches no mesh, expected some of {some}")
        if above != below and mouth is None:
            trail = f"{surface.where} -> parts -> {glob[:60]}"
            raise InputError(trail, "no multipie68 landmarks that part it, expected 68")
        numbers = [surface.mesh_names.index(name) for name in names]
        points = surface.loose[np.isin(surface.mesh[surface.loose], numbers)]
        if not len(points):
            what = f"'{glob[:60]}' matches no loose part, expected one: joints move the rest of the face along it"
            raise InputError(f"{surface.where} -> parts", what)
        if above == below or mouth is None:
            hold(weights, points, joints.index(above))
        else:
            upper = _upper(surface, points, mouth)
            weights[points] = 0.0
            weights[points, joints.index(above)], weights[points, joints.index(below)] = upper, 1.0 - upper
        done += names
    return tuple(dict.fromkeys(done))


def _upper(surface: Surface, points: IntArray, mouth: Slit) -> FloatArray:
    """(k,) share of loose points that is above the mouth: small parts whole, others by the nearest of the face."""
    triangles = surface.part_triangles(surface.inside)
    places = closest_places(surface.points[points], surface.points[surface.inside], triangles)
    side = mouth.side[surface.inside][triangles[places.triangles]].mean(axis=1)
    upper = (side > 0).astype(np.float64)
    component = surface.component[points]
    large = np.zeros(len(points), bool)
    for number in np.unique(component):
        inside = component == number
        if np.ptp(surface.points[points[inside]], axis=0).max() <= _SMALL * mouth.width:
            upper[inside] = float(side[inside].mean() > 0)
        else:
            large |= inside
    if large.any():
        # gums and the like span both jaws: a step from 0 to 1 would tear them where the mouth opens
        local = surface.part_triangles(points[large], even=True)
        lengths = np.full(int(large.sum()), _BLEND)
        spread = heat_weights(surface.points[points[large]], local, upper[large, None], lengths)
        upper[large] = np.clip(spread[:, 0], 0.0, 1.0)
    return np.asarray(upper)
