"""Joints and skin weights: MakeHuman's, laid over the head by landmarks, as far as its bones go.

Its weights say what belongs to neck, lips, lids, nose and cheeks; joints between them are added at places on the skin;
how much of each point the jaw has is read off the scanned jawOpen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from anatomy import Jaw, Tongue, eye_centre, smooth
from mirror import FLIP, twin
from model import KEPT, Floats, Ints, Model

from facepipe.geometry.geodesics import graph_distances
from facepipe.geometry.heat_weights import SMALLEST_SHARE, heat_weights, influences, normalised
from facepipe.importers import load
from facepipe.importers.ict import LANDMARKS
from facepipe.parts import FaceParts
from facepipe.verbs.skin.from_face import from_face
from facepipe.verbs.skin.surface import Surface, surface_of

HEAD = "root/neck/head"
JAW = f"{HEAD}/jaw"
NOSE = f"{HEAD}/nose"
Place = (
    int | tuple[float, float, float]
)  # a landmark's position in the list of 68, or the skin nearest to a place in cm

TRUNK = ("spine01", *(f"{bone}.{side}" for side in "LR" for bone in ("breast", "clavicle", "shoulder01", "upperarm01")))
# joint -> MakeHuman's bones whose weights it has; "Left" ones get a twin
BONES = {
    "root": TRUNK,
    "root/neck": ("neck01", "neck02", "neck03"),
    HEAD: ("head", "eye.L", "eye.R", "oculi01.L", "oculi01.R", "risorius03.L", "risorius03.R"),
    JAW: ("jaw",),
    NOSE: ("levator06.L", "levator06.R"),
    f"{HEAD}/lidUpperLeft": ("orbicularis03.L",),
    f"{HEAD}/lidLowerLeft": ("orbicularis04.L",),
    f"{HEAD}/lipUpper": ("oris05",),
    f"{HEAD}/lipUpperLeft": ("oris03.L",),
    f"{HEAD}/lipCornerLeft": ("levator05.L",),
    f"{JAW}/lipLower": ("oris01",),
    f"{JAW}/lipLowerLeft": ("oris07.L",),
}
# joint on the skin -> where it is, how far along the skin its weights reach (cm), and the largest of them
ADDED: dict[str, tuple[Place, float, float]] = {
    f"{HEAD}/forehead": ((0.0, 8.8, 10.0), 4.0, 0.8),
    f"{HEAD}/templeLeft": ((6.8, 5.8, 5.5), 3.2, 0.7),
    f"{HEAD}/browInnerLeft": (22, 2.2, 0.85),
    f"{HEAD}/browMidLeft": (24, 2.2, 0.85),
    f"{HEAD}/browOuterLeft": (26, 2.2, 0.85),
    f"{NOSE}/noseBridge": (28, 2.2, 0.8),
    f"{NOSE}/noseTip": (30, 2.2, 0.9),
    f"{NOSE}/nostrilLeft": ((1.6, 0.3, 10.9), 1.6, 0.95),
    f"{HEAD}/cheekUpperLeft": ((4.9, -0.2, 8.6), 2.8, 0.85),
    f"{HEAD}/cheekLowerLeft": ((4.9, -3.6, 8.0), 3.0, 0.9),
    f"{HEAD}/lipCornerLeft": (54, 1.6, 0.8),
    f"{HEAD}/jowlLeft": (12, 3.2, 0.85),
    f"{JAW}/chin": ((0.0, -6.6, 10.8), 2.4, 0.8),
}
SEATS: dict[str, Place] = {  # of joints that have MakeHuman's weights
    f"{HEAD}/lipUpper": 51,
    f"{HEAD}/lipUpperLeft": 52,
    f"{JAW}/lipLower": 57,
    f"{JAW}/lipLowerLeft": 56,
}
EAR = f"{HEAD}/earLeft"
TONGUE = (f"{JAW}/tongue", f"{JAW}/tongue/tongueMid", f"{JAW}/tongue/tongueMid/tongueTip")
LIPS_AND_LIDS = ("lip", "lid")
LARGE = ("root", "root/neck", HEAD, JAW)
# mm over which weights are smoothed: before and after they are cut to few a point, which leaves edges
EVEN = ({"large": 12.0, "added": 5.0, "small": 2.0}, {"large": 3.0, "added": 4.0, "small": 1.0})
EVEN += EVEN[1:]
SHARP = 1.5  # power that keeps weights of more than the nearest few joints small
FEW = 4
FOLLOWED = 48  # points by which a joint follows the head's identity
FAINT = 0.02  # less of a large joint is none


@dataclass(frozen=True, kw_only=True)
class Skeleton:
    """j joints, parents first, along the axes of the world."""

    joints: tuple[str, ...]
    points: Ints  # (j, FOLLOWED) of which each joint is
    shares: Floats  # (j, FOLLOWED) the weighted mean
    indices: Ints  # (n, FEW) joints of every point of the head
    weights: Floats  # (n, FEW)


def skeleton(model: Model, mirror: Ints, jaw: Jaw, tongue: Tongue, regions: dict[str, Floats], data: Path) -> Skeleton:
    """The skeleton of the head.

    :param regions: masks of Head's points
    """
    parts, surface = _face(data)
    source = load("makehuman", data / "makehuman" / "makehuman_head.npz").parts
    made = from_face(parts, surface, source, "makehuman", smoothing=2.0)
    theirs = dict(zip(made.skeleton.names, made.weights[surface.group].T, strict=True))
    binds = dict(zip(made.skeleton.names, made.skeleton.bind_transforms[:, :3, 3], strict=True))
    places = _places(model, binds, jaw, regions)
    joints = tuple(sorted(places, key=lambda path: path.split("/")))
    weights = np.zeros((len(model.points), len(joints)))
    for joint, bones in BONES.items():
        for name in {joint, twin(joint)}:
            other = name != joint
            weights[:, joints.index(name)] = sum(theirs[_side(bone, other)] for bone in bones)
    _add(weights, joints, places, surface, regions)
    weights = (weights + weights[mirror][:, [joints.index(twin(joint)) for joint in joints]]) / 2
    share = jaw.share(model.points, model.shapes["jawOpen"])
    share = np.where(share < FAINT, 0.0, share)
    lower = np.array([path.startswith(JAW) for path in joints])
    weights *= np.where(lower, share[:, None], 1.0 - share[:, None])
    for lengths in EVEN:
        _even(weights, joints, surface, lengths)
        weights = _few(weights, joints, share)
    _loose(weights, joints, tongue, share)
    indices, kept = influences(weights, FEW)
    followed, shares = _followed(model, mirror, joints, places)
    return Skeleton(joints=joints, points=followed, shares=shares, indices=indices, weights=kept)


def _face(data: Path) -> tuple[FaceParts, Surface]:
    parts = load("ict", data / "ict_facekit" / "ict_facekit.npz").parts
    kept = {part.mesh for part in KEPT}
    parts = replace(parts, meshes=tuple(mesh for mesh in parts.meshes if mesh.name in kept))
    return parts, surface_of(parts, "ICT-FaceKit")


def _side(bone: str, other: bool) -> str:
    """The bone, or that of the other side."""
    sides = {".L": ".R", ".R": ".L"}
    return bone[:-2] + sides[bone[-2:]] if other and bone[-2:] in sides else bone


def _places(model: Model, binds: dict[str, Floats], jaw: Jaw, regions: dict[str, Floats]) -> dict[str, Floats]:
    """Joint -> (3,), alike on both sides."""
    ears = regions["ears"] * (model.points[: len(regions["ears"]), 0] > 0)
    places = {
        "root": 0.3 * binds["spine01"] + 0.7 * binds["neck01"],
        "root/neck": 0.5 * (binds["neck01"] + binds["neck02"]),
        HEAD: binds["head"],
        JAW: jaw.hinge,
        NOSE: np.array([0.0, 0.9, 10.4]),
        EAR: ears @ model.points[: len(ears)] / ears.sum(),
        **{path: binds[bone] for path, bone in zip(TONGUE, ("tongue01", "tongue02", "tongue03"), strict=True)},
        **{path: _seat(model, place) for path, (place, _, _) in ADDED.items()},
        **{path: _seat(model, place) for path, place in SEATS.items()},
        **dict.fromkeys((f"{HEAD}/eyeLeft", f"{HEAD}/lidUpperLeft", f"{HEAD}/lidLowerLeft"), eye_centre(model, "Left")),
    }
    places |= {twin(path): place * FLIP for path, place in places.items() if "Left" in path}
    middle = {path: place * (0.0, 1.0, 1.0) for path, place in places.items() if twin(path) == path}
    return places | middle


def _seat(model: Model, place: Place) -> Floats:
    """A place on the skin of the face."""
    skin = model.points[slice(*KEPT[0].points)]
    if isinstance(place, int):
        return model.points[LANDMARKS[place]]
    return skin[np.linalg.norm(skin - place, axis=1).argmin()]


def _add(
    weights: Floats, joints: Sequence[str], places: dict[str, Floats], surface: Surface, regions: dict[str, Floats]
) -> None:
    """Give the added joints their share of what lips and lids leave."""
    names = [name for joint in ADDED for name in sorted({joint, twin(joint)})]
    sewn = surface.group[: len(regions["ears"])]
    own = surface.points[sewn]
    seats = [sewn[[np.linalg.norm(own - 10.0 * places[name], axis=1).argmin()]] for name in names]
    distances = graph_distances(surface.graph, seats)[:, sewn].T / 10.0
    reach = np.array([ADDED[name if name in ADDED else twin(name)][1:] for name in names])
    shares = reach[:, 1] * smooth((reach[:, 0] - distances) / (0.88 * reach[:, 0]))
    side = own[:, 0] / 10.0
    ears = {"Left": regions["ears"] * (side > 0), "Right": regions["ears"] * (side < 0)}
    names += [twin(EAR), EAR]
    shares = np.column_stack([shares, ears["Right"], ears["Left"]])
    shares /= np.maximum(shares.sum(axis=1, keepdims=True), 1.0)
    base = [i for i, joint in enumerate(joints) if not joint.rpartition("/")[2].startswith(LIPS_AND_LIDS)]
    head = weights[: len(sewn)]
    free = head[:, base].sum(axis=1, keepdims=True)
    head[:, base] *= 1.0 - shares.sum(axis=1, keepdims=True)
    head[:, [joints.index(name) for name in names]] += free * shares


def _even(weights: Floats, joints: Sequence[str], surface: Surface, lengths: Mapping[str, float]) -> None:
    """Smooth the weights on the skin: another head's lie some millimetres off."""
    inside = surface.inside
    first = np.unique(surface.group, return_index=True)[1][inside]
    triangles = surface.part_triangles(inside, even=True)
    found = np.zeros((len(surface.points), len(joints)))
    for kind, length in lengths.items():
        own = [i for i, path in enumerate(joints) if _kind(path) == kind]
        rough = weights[np.ix_(first, own)]
        far = np.full(len(first), length)
        found[np.ix_(inside, own)] = heat_weights(surface.points[inside], triangles, rough, far)
    weights[:] = found[surface.group]


def _kind(path: str) -> str:
    if path in LARGE:
        return "large"
    return "added" if {path, twin(path)} & ADDED.keys() else "small"


def _few(weights: Floats, joints: Sequence[str], share: Floats) -> Floats:
    """At most FEW joints a point, of which the jaw and what hangs on it have just their share (n,)."""
    large = np.array([path in LARGE for path in joints])
    bases = np.array([path in (HEAD, JAW) for path in joints])
    lower = np.array([path.startswith(JAW) for path in joints])
    small = np.where(large, 0.0, weights)
    strong = small**SHARP
    strong = np.maximum(strong - np.sort(strong, axis=1)[:, -FEW, None], 0.0)  # smooth from point to point
    small = normalised(strong) * small.sum(axis=1, keepdims=True)
    found = np.zeros_like(weights)
    for mine, amount, base in ((lower, share, JAW), (~lower, 1.0 - share, HEAD)):
        own = small * mine
        own *= np.minimum(1.0, amount / np.maximum(own.sum(axis=1), 1e-9))[:, None]
        rest = normalised(np.where(mine & large, weights, 0.0))
        rest = np.where(rest < FAINT, 0.0, rest)
        rest[:, joints.index(base)] += 1e-9
        found += own + (amount - own.sum(axis=1))[:, None] * normalised(rest)
    found[found < SMALLEST_SHARE] = 0.0
    for _ in range(FEW):
        many = np.flatnonzero((found > 0).sum(axis=1) > FEW)
        least = np.where((found[many] > 0) & ~bases, found[many], np.inf).argmin(axis=1)
        base = np.where(lower[least], joints.index(JAW), joints.index(HEAD))
        found[many, base] += found[many, least]
        found[many, least] = 0.0
    return normalised(found)


def _loose(weights: Floats, joints: Sequence[str], tongue: Tongue, share: Floats) -> None:
    """Eyeballs turn whole; teeth and gums are the jaw's or the head's, and the tongue has joints of its own."""
    for part in KEPT:
        own = weights[slice(*part.points)]
        if part.mesh != "Head":
            own[:] = 0.0
        if part.mesh.startswith("Eyeball"):
            own[:, joints.index(f"{HEAD}/eye{part.mesh.removeprefix('Eyeball')}")] = 1.0
        elif part.mesh != "Head":
            held = share[slice(*part.points)]
            held = np.round(held) if part.mesh == "Teeth" else held
            own[:, joints.index(JAW)], own[:, joints.index(HEAD)] = held, 1.0 - held
    chain = np.maximum(0.0, 1.0 - np.abs(tongue.along[:, None] * 2.0 - np.arange(len(TONGUE))))
    weights[tongue.points] *= 1.0 - tongue.free[:, None]
    weights[np.ix_(tongue.points, [joints.index(path) for path in TONGUE])] += tongue.free[:, None] * chain


def _followed(model: Model, mirror: Ints, joints: Sequence[str], places: dict[str, Floats]) -> tuple[Ints, Floats]:
    """Of every joint points whose weighted mean it is, and stays as the head takes on another identity."""
    found: dict[str, tuple[Ints, Floats]] = {}
    for joint in joints:
        if "Right" in joint:
            continue
        middle = twin(joint) == joint
        points = _spread(model, joint, places[joint], FOLLOWED // 2 if middle else FOLLOWED)
        if middle:
            points = np.concatenate([points, mirror[points]])
        shares = _mean(model.points[points], places[joint])
        found |= (
            {joint: (points, shares)} if middle else {joint: (points, shares), twin(joint): (mirror[points], shares)}
        )
    return tuple(np.stack([found[joint][i] for joint in joints]) for i in range(2))


def _spread(model: Model, joint: str, place: Floats, count: int) -> Ints:
    """Points on the left around a joint, far from each other."""
    of_eye = joint.rpartition("/")[2].startswith(("eye", "lid"))
    part = next(one for one in KEPT if one.mesh == ("EyeballLeft" if of_eye else "Head"))
    own = np.arange(part.points[0], part.points[1] if of_eye else KEPT[1].points[1])
    own = own[model.points[own, 0] >= 0]
    away = np.linalg.norm(model.points[own] - place, axis=1)
    own = own[away <= max(1.0, 2.0 * away.min(), np.sort(away)[3 * count])]
    chosen = [own[0]]
    nearest = np.full(len(own), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, np.linalg.norm(model.points[own] - model.points[chosen[-1]], axis=1))
        chosen.append(own[nearest.argmax()])
    return np.array(chosen, np.int32)


def _mean(points: Floats, place: Floats) -> Floats:
    """Shares, in sum 1 and none larger than need be, with which the mean of the points (k, 3) is the place."""
    system = np.vstack([np.ones(len(points)), (points - place).T])
    return np.linalg.pinv(system, rcond=1e-3)[:, 0]
