"""Joints from a JSON file to skeleton and weights: nearest along the surface, spread like heat, loose parts by rule."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Literal

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean, identifier, suggestion
from facepipe.core.reading import read_json_object
from facepipe.declare import from_json
from facepipe.geometry.closest_points import closest_places, place_shares
from facepipe.geometry.geodesics import graph_distances
from facepipe.geometry.heat_weights import heat_weights, normalised
from facepipe.geometry.polygons import components
from facepipe.parts import FaceParts, all_regions
from facepipe.verbs.skin.options import SkinOptions
from facepipe.verbs.skin.skinning import Skinning, skeleton_of
from facepipe.verbs.skin.surface import LOWER, UPPER, Eyeball, Slit, Surface, eyeballs_of, size_of, slits_of, smoothstep

_NEAREST = 1.0  # mm: parts that touch the face are smoothed over this length, others over their distance from it
_SMALL = 0.65  # of the mouth's width: parts up to this size lie above or below the mouth whole
_BLEND = 3.0  # mm over which larger ones change from upper to lower
_IN_BALL = 0.5  # a joint up to this many radii from the centre of an eyeball turns it
MOST_JOINTS = 1024
_MOST_BYTES = 1 << 24
_UNITS = {"stage": None, "mm": 0.001, "cm": 0.01, "m": 1.0}
_LENGTHS = {"low": -1e9, "high": 1e9}
_LONGEST_PATH = 1000
_REACH = 1.5  # a joint in the depth touches the points up to this many times as far as the nearest
_AS_NEAR = 1.1  # patches up to this many times as far as the nearest one are as near
_POWER = 12  # shares of the nearest joints fall with this power of their distances: ties are shared, no more
_BLUR = 0.15  # of a slit's width: band beside a corner over which joints and regions of a lip or lid fade out
_BESIDE = 0.5  # a joint is of a lip or lid up to this many widths of the slit from its rim
_RIVALS = 16  # joints, the nearest, that share a point
_FULL = 0.25  # of its radius: up to there a joint has its full weight
_LEAST = 1e-6  # mm: a radius below counts as this
_FARTHEST = 20.0  # sizes of the face that a joint may be away from it
_AROUND = 0.5  # sizes of the face that joints usually lie around its box at most
_TOGETHER = 0.05  # of the face's size: joints nearer to each other lie in a heap
_HEAP = 3  # joints, from which on that is a sign


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
            # (k,) share of loose points that is above the mouth: small parts whole, others by the nearest of the face
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
            upper = np.asarray(upper)
            weights[points] = 0.0
            weights[points, joints.index(above)], weights[points, joints.index(below)] = upper, 1.0 - upper
        done += names
    return tuple(dict.fromkeys(done))


@dataclass(frozen=True, kw_only=True)
class PlacedJoint:
    """A joint but for its path; what its fields mean is above.

    :raises InputError: a rotation of length 0, or a radius that is not above 0
    """

    position: tuple[float, float, float] = field(metadata=_LENGTHS)
    rotation: tuple[float, float, float, float] = field(default=(0.0, 0.0, 0.0, 1.0), metadata=_LENGTHS)
    radius: float | None = field(default=None, metadata=_LENGTHS)
    regions: tuple[str, ...] = ()
    surface: bool | None = None

    def __post_init__(self) -> None:
        if math.hypot(*self.rotation) < 1e-6:
            raise InputError("rotation", "of length 0, expected a unit quaternion x y z w")
        if self.radius is not None and self.radius <= 0:
            raise InputError("radius", f"{self.radius}, expected a length above 0")


@dataclass(frozen=True, kw_only=True)
class JointSpec(PlacedJoint):
    """One joint to be made."""

    path: str


@dataclass(frozen=True, kw_only=True)
class _Halves:
    upper: str
    lower: str


@dataclass(frozen=True, kw_only=True)
class _JointsFile:
    joints: Mapping[str, PlacedJoint]
    parts: Mapping[str, str | _Halves] = field(default_factory=dict)
    unit: Literal["stage", "mm", "cm", "m"] = "stage"


@dataclass(frozen=True, kw_only=True)
class JointSet:
    """The joints of a face, parents first.

    :raises InputError: no joints, one twice or without its parent, or parts given to a joint that is not there
    """

    joints: tuple[JointSpec, ...]
    parts: Mapping[str, tuple[str, str]] = field(default_factory=dict)  # mesh glob -> joint above and below the mouth
    unit: str = "stage"
    where: str = "joints"  # for messages

    def __post_init__(self) -> None:
        paths = [joint.path for joint in self.joints]
        if not 1 <= len(paths) <= MOST_JOINTS:
            raise InputError(self.where, f"{len(paths)} joints, expected 1 to {MOST_JOINTS}")
        if self.unit not in _UNITS:
            raise InputError(f"{self.where} -> unit", f"'{self.unit[:40]}', expected one of {', '.join(_UNITS)}")
        known = set(paths)
        for number, path in enumerate(paths):
            twice = path in paths[:number]
            where = f"{self.where} -> {_shown(path)}"
            if twice:
                raise InputError(where, "twice, expected each joint once")
            if len(path) > _LONGEST_PATH or any(identifier(part) != part for part in path.split("/")):
                raise InputError(where, "expected names of ASCII letters, digits and underscores, joined by /")
            parent = path.rpartition("/")[0]
            if parent and parent not in known:
                raise InputError(where, f"no parent '{parent[:80]}', expected it among the joints")
        for glob, names in self.parts.items():
            for name in names:
                if name not in known:
                    trail = f"{self.where} -> parts -> {_shown(glob)}"
                    near = did_you_mean(name, paths) or ", expected one of the file"
                    raise InputError(trail, f"no joint '{_shown(name)}'{near}")
        order = sorted(self.joints, key=lambda joint: joint.path.count("/"))
        object.__setattr__(self, "joints", tuple(order))

    def scale(self, meters_per_unit: float) -> float:
        """Stage units in one unit of the file."""
        meters = _UNITS[self.unit]
        return 1.0 if meters is None else meters / meters_per_unit


def read_joints(path: Path) -> JointSet:
    """The joints of a JSON file.

    :raises InputError: not such JSON
    """
    file = from_json(_JointsFile, read_json_object(path, _MOST_BYTES), str(path))
    parts = {
        glob: part if isinstance(part, _Halves) else _Halves(upper=part, lower=part)
        for glob, part in file.parts.items()
    }
    return JointSet(
        joints=tuple(JointSpec(path=name, **vars(joint)) for name, joint in file.joints.items()),
        parts={glob: (part.upper, part.lower) for glob, part in parts.items()},
        unit=file.unit,
        where=str(path),
    )


def _shown(name: str) -> str:
    """A name as messages show it, whatever is in it."""
    return ascii(name)[1:-1][:80]


def from_joints(parts: FaceParts, surface: Surface, joints: JointSet, options: SkinOptions) -> Skinning:
    """Skeleton and weights from joint positions."""
    scale = joints.scale(parts.meters_per_unit)
    positions = np.array([joint.position for joint in joints.joints]) * scale
    millimetres = positions * parts.meters_per_unit * 1000.0
    face = surface.points[surface.inside]
    for placed, position in zip(joints.joints, millimetres, strict=True):
        away, most = float(np.linalg.norm(position - face.mean(axis=0))), _FARTHEST * size_of(face)
        if away > most:
            what = f"{away:.4g} mm from the face, expected at most {most:.4g} (positions are in the unit"
            raise InputError(f"{joints.where} -> {placed.path[:80]}", f"{what} '{joints.unit}')")
    slits = slits_of(surface)
    eyeballs = eyeballs_of(surface)
    apart = [joint.surface is True or bool(joint.regions) for joint in joints.joints]  # of the face for sure
    turned = joints_in(eyeballs, millimetres, np.array(apart))
    held = np.asarray(np.any([np.zeros(len(millimetres), bool), *_inside(eyeballs, millimetres)], axis=0))
    moves = np.array(
        [
            (joint.surface if joint.surface is not None else bool(joint.regions) or not one)
            for joint, one in zip(joints.joints, held, strict=True)
        ]
    )
    if not moves.any():
        raise InputError(joints.where, "no joint moves the face itself, expected one outside eyeballs, or `surface`")
    chosen = [joint for joint, one in zip(joints.joints, moves, strict=True) if one]
    to_mm = scale * parts.meters_per_unit * 1000.0
    radii = np.array([np.inf if joint.radius is None else max(joint.radius * to_mm, _LEAST) for joint in chosen])
    masks = [_mask(parts, surface, slits, joint, joints.where) for joint in chosen]
    own = _joint_weights(surface, chosen, millimetres[moves], radii, masks, slits, options.sharpness)
    weights = np.zeros((len(surface.points), len(moves)))
    weights[:, moves] = following(surface, own)
    # after `following`, by which eyeballs would stick to the lids around them
    for number, joint in turned.items():
        hold(weights, eyeballs[number].points, joint)
    paths = tuple(joint.path for joint in joints.joints)
    mouth = next((slit for slit in slits if slit.name == "mouth"), None)
    hold_parts(surface, weights, joints.parts, paths, mouth)
    rotations = np.array([joint.rotation for joint in joints.joints])
    warning = "no multipie68 landmarks: joints beside lips and lids may move the other one round the corner"
    # most joints outside the face, or all in a heap: perhaps another unit
    size, spread, count = size_of(face), size_of(millimetres), len(millimetres)
    off = np.maximum(face.min(axis=0) - millimetres, millimetres - face.max(axis=0)).clip(0.0)
    beyond = np.linalg.norm(off, axis=1)
    outside, unit = int((beyond > _AROUND * size).sum()), f"mm (positions are in the unit '{joints.unit}')"
    warnings = () if slits else (warning,)
    if 2 * outside > count:
        lying = f"{outside} of {count} joints lie outside the face, up to {beyond.max():.4g} {unit}"
        warnings = (f"{joints.where}: {lying}", *warnings)
    elif count >= _HEAP and spread < _TOGETHER * size:
        lying = f"all {count} joints lie within {spread:.4g} {unit}, the face in {size:.4g} mm"
        warnings = (f"{joints.where}: {lying}", *warnings)
    return Skinning(
        skeleton=skeleton_of(parts.skeleton, paths, positions, rotations),
        weights=weights,
        warnings=warnings,
    )


def _mask(
    parts: FaceParts, surface: Surface, slits: tuple[Slit, ...], joint: JointSpec, where: str
) -> FloatArray | None:
    """(m,) how much of each point the regions of a joint hold."""
    if not joint.regions:
        return None
    first = np.unique(surface.group, return_index=True)[1]
    known: dict[str, FloatArray] = {
        name: np.asarray(mask, np.float64)[first] for name, mask in all_regions(parts.meshes).items()
    }
    for slit in slits:
        for side, sign in (("upper", UPPER), ("lower", LOWER)):
            known.setdefault(f"{slit.name}_{side}", slit.share(sign, _BLUR))
    for name in joint.regions:
        if name not in known:
            near = suggestion(name, known, "none: the face has neither regions nor landmarks")
            raise InputError(f"{where} -> {joint.path} -> regions", f"no '{name[:60]}'{near}")
    return np.asarray(np.clip(np.sum([known[name] for name in joint.regions], axis=0), 0.0, 1.0))


def _joint_weights(
    surface: Surface,
    joints: Sequence[JointSpec],
    positions: FloatArray,
    radii: FloatArray,
    masks: Sequence[FloatArray | None],
    slits: Sequence[Slit],
    sharpness: float,
) -> FloatArray:
    """(i, j) weights of the joints on the i points of the main component, in sum 1.

    :param positions: (j, 3) mm
    :param radii: (j,) mm, infinite without
    :param masks: (m,) of each joint, how much of every point it may have
    :raises InputError: a point that no joint may move
    """
    inside = surface.inside
    distances = _distances(surface, positions)[:, inside].T
    allowed = np.stack([np.ones(len(inside)) if mask is None else mask[inside] for mask in masks], axis=1)
    reached = np.isfinite(distances)
    allowed *= smoothstep((1.0 - np.where(reached, distances, 0.0) / radii) / (1.0 - _FULL)) * reached
    allowed *= _sides(surface, positions, slits)[inside]
    stranded = int((allowed.max(axis=1) <= 0).sum())
    if stranded:
        what = f"{stranded} points of {len(inside)} that no joint may move"
        raise InputError(surface.where, f"{what}, expected a joint without radius, regions or beside a lip")
    nearest = np.where(allowed > 0, distances, np.inf).min(axis=1)
    # heat takes weights in with 1 / distance^2: infinite at a point that a joint lies on
    floor = 1e-3 * float(np.median(nearest)) + 1e-9
    shares = _shares(np.maximum(distances, floor), allowed)
    local = surface.part_triangles(inside, even=True)
    spread = normalised(heat_weights(surface.points[inside], local, shares, np.maximum(nearest, floor), sharpness))
    # heat also runs to where a joint may not be: that goes back to the shares, which keep to what is allowed
    kept = spread * allowed
    return np.asarray(kept + (1.0 - kept.sum(axis=1, keepdims=True)) * shares)


def _shares(distances: FloatArray, allowed: FloatArray) -> FloatArray:
    """(i, j) what of each point is whose: all of it the nearest joint's, as far as that may have it, then the next's.

    Joints about as near as each other share alike, so that no order among them counts.
    """
    width = min(_RIVALS, distances.shape[1])
    away = np.where(allowed > 0, distances, np.inf)
    chosen = np.argpartition(away, width - 1, axis=1)[:, :width] if width < away.shape[1] else None
    pick = (lambda table: table) if chosen is None else (lambda table: np.take_along_axis(table, chosen, axis=1))
    near, may = pick(away), pick(allowed)
    near_shares = may.copy()
    for rival in range(width):
        with np.errstate(over="ignore", invalid="ignore"):
            nearer = 1.0 / (1.0 + (near[:, rival, None] / near) ** _POWER)  # how much the rival comes first
        nearer[:, rival] = 0.0
        near_shares *= 1.0 - may[:, rival, None] * np.where(np.isfinite(nearer), nearer, 0.0)
    near_shares = normalised(near_shares)
    if chosen is None:
        return near_shares
    shares = np.zeros_like(distances)
    np.put_along_axis(shares, chosen, near_shares, axis=1)
    return shares


def _distances(surface: Surface, positions: FloatArray) -> FloatArray:
    """(j, m) from the joints, in a straight line to the surface near them and along it from there."""
    local = surface.part_triangles(surface.inside)
    places = closest_places(positions, surface.points[surface.inside], local)
    sources, starts = [], []
    for position, depth, triangle in zip(positions, places.distances, places.triangles, strict=True):
        corners = surface.inside[local[triangle]]
        reach = _REACH * depth
        # points within `reach`, in patches of the surface that are about as near as that of the nearest triangle. A
        # joint of the lower lip has the upper one within its reach, but not through the lip; one in the middle of the
        # head has a nearest place on either side.
        away = np.linalg.norm(surface.points - position, axis=1)
        near = (away <= reach) & (surface.component == surface.main)
        near[corners] = True
        numbers = np.flatnonzero(near)
        place = np.full(len(near), -1)
        place[numbers] = np.arange(len(numbers))
        pairs = place[surface.edges]
        patch = components(len(numbers), pairs[(pairs >= 0).all(axis=1)])
        nearest = np.full(int(patch.max()) + 1, np.inf)
        np.minimum.at(nearest, patch, away[numbers])
        chosen = nearest <= _AS_NEAR * nearest.min()
        chosen[patch[place[corners]]] = True
        touched = np.asarray(numbers[chosen[patch]])
        sources.append(touched)
        starts.append(np.linalg.norm(surface.points[touched] - position, axis=1))
    return graph_distances(surface.graph, sources, starts)


def _sides(surface: Surface, positions: FloatArray, slits: Sequence[Slit]) -> FloatArray:
    """(m, j) 0 for a joint of one lip or lid on the other, 1 elsewhere, smooth beside the corners."""
    shares = np.ones((len(surface.points), len(positions)))
    local = surface.part_triangles(surface.inside)
    places = closest_places(positions, surface.points[surface.inside], local)
    for slit in slits:
        corners = surface.inside[local[places.triangles]]
        side, distance = slit.side[corners].mean(axis=1), slit.distance[corners].min(axis=1) + places.distances
        beside = distance <= _BESIDE * slit.width
        for sign in (UPPER, LOWER):
            of_one = beside & (sign * side > _BLUR)
            shares[:, of_one] *= slit.share(sign, _BLUR)[:, None]
    return shares
