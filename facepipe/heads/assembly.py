"""A face of the package data and what is known of a person."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib.resources import files
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.threads import one_thread
from facepipe.heads.asset import ATTRIBUTION, IDENTITY_MODES, Asset, Part, arrays, asset, unpacked
from facepipe.heads.lid_fit import LOOKS, SIDES, SQUINT, TURN, Ends, Eye, Socket, sockets
from facepipe.heads.lip_fit import fit_lips
from facepipe.heads.part_fits import Shapes, fit_eyes, fit_mouth
from facepipe.heads.people import OLDEST, YOUNGEST, draw
from facepipe.heads.surfaces import dressed, laid_again
from facepipe.parts import (
    Animation,
    Blendshape,
    BoneLimits,
    FaceParts,
    Inbetween,
    Landmarks,
    MaterialFaces,
    Mesh,
    PersonBasis,
    Recipe,
    Skeleton,
    Skin,
    Slider,
    UvSet,
)
from facepipe.rig.bone_coefficients import CHANNELS, rest_coefficients

MEET = 0.433  # cm below the middle of an eye: where lids meet
_MIDDLE = 1.0  # cm on each side of the middle, over which left and right mix
TALK = "talk"
_RATE = 24
_SPOKEN = ("sil", "DD", "E", "FF", "aa", "SS", "O", "PP", "U", "sil")  # over a second, each passing into the next
_HEAD, _NECK = "root/neck/head", "root/neck"
_EYES = (f"{_HEAD}/eyeLeft", f"{_HEAD}/eyeRight")
_MIRRORED = ("tx", "ry", "rz")  # channels of the other sign on the other side
_SAME = 1e-4  # cm: shapes that differ less are the same
MEASURES_REACH = 1.5  # of sliders of measures: three standard deviations, which people have
IDENTITY_STEP = 1 / 4096  # of gains and weights of the identity sliders
IDENTITY_REACH = 6.0  # of sliders of modes, which are in standard deviations: 5.5 is the most of 300 people by seeds
_LEAST = 1e-3  # cm, or share of the size: less moves no joint
_CHANNELS = (  # joint, channel, column of `Direction.eyes`, and how much of it
    *(("eye", channel, column, 1.0) for column, channel in enumerate(("tx", "ty", "tz", "sx"))),
    *(("eye", channel, 3, 1.0) for channel in ("sy", "sz")),
    *((lid, channel, 4, share) for lid in ("lidUpper", "lidLower") for channel, share in (("ty", MEET), ("sy", 1.0))),
)
_RISING = ((-1.0, 0.0), (0.0, 0.0), (1.0, 1.0))
_FALLING = ((-1.0, 1.0), (0.0, 0.0), (1.0, 0.0))

_MOODS: dict[str, dict[str, float]] = {
    "smile": {"mouthSmile": 1.0, "cheekSquint": 0.5},
    "frown": {"mouthFrown": 1.0, "browInnerUp": 0.5},
    "blink": {"eyeBlink": 1.0},
    "mouthOpen": {"jawOpen": 1.0},
}
VISEMES: dict[str, dict[str, float]] = {
    "sil": {"mouthPress": 0.05},
    "PP": {"mouthPress": 0.5, "mouthRollLower": 0.3, "mouthRollUpper": 0.25, "mouthPucker": 0.1},
    "FF": {"jawOpen": 0.04, "mouthRollLower": 0.55, "mouthUpperUp": 0.3, "mouthShrugLower": 0.15},
    "TH": {"tongueOut": 0.72, "mouthLowerDown": 0.15, "mouthUpperUp": 0.1},
    "DD": {"jawOpen": 0.12, "mouthLowerDown": 0.3, "mouthUpperUp": 0.15},
    "kk": {"jawOpen": 0.2, "mouthStretch": 0.15, "mouthLowerDown": 0.15},
    "CH": {"jawOpen": 0.07, "mouthFunnel": 0.7, "mouthPucker": 0.2, "mouthShrugUpper": 0.15},
    "SS": {"jawOpen": 0.03, "mouthStretch": 0.35, "mouthSmile": 0.15, "mouthLowerDown": 0.4, "mouthUpperUp": 0.2},
    "nn": {"jawOpen": 0.09, "mouthLowerDown": 0.25, "mouthUpperUp": 0.1},
    "RR": {"jawOpen": 0.1, "mouthFunnel": 0.45, "mouthPucker": 0.2},
    "aa": {"jawOpen": 0.55, "mouthStretch": 0.1, "mouthLowerDown": 0.2},
    "E": {"jawOpen": 0.22, "mouthStretch": 0.35, "mouthSmile": 0.2, "mouthLowerDown": 0.2, "mouthUpperUp": 0.1},
    "I": {"jawOpen": 0.12, "mouthSmile": 0.5, "mouthStretch": 0.25, "mouthLowerDown": 0.25},
    "O": {"jawOpen": 0.4, "mouthFunnel": 0.7, "mouthPucker": 0.15},
    "U": {"jawOpen": 0.12, "mouthPucker": 0.75, "mouthFunnel": 0.45},
}
Controls = Literal["measures", "bones"]
MODE = "identity"  # what names of sliders of modes begin with
BLINKS = ("eyeBlinkLeft", "eyeBlinkRight")
LIDS = (*BLINKS, *(name + side for name in (*LOOKS, SQUINT) for side in SIDES))  # shapes that each person has fitted


@dataclass(frozen=True, kw_only=True)
class Direction:
    """Two standard deviations of a measure, or what is typical of sex or age."""

    name: str
    group: str
    offsets: npt.NDArray[np.float32]  # (n, 3) cm, symmetric, less what joints do: 0 on the eyeballs
    eyes: FloatArray  # (2, 5) left and right: translation in cm, what is added to its scale, and to that of its lids
    sided: bool  # whether each side has a control of its own

    @cached_property
    def shapes(self) -> tuple[Direction, ...]:
        """What blendshapes are made of: its left and right half, which add up to it, or itself."""
        return (self._half(0), self._half(1)) if self.sided else (self,)

    def _half(self, side: int) -> Direction:
        across = np.clip(asset().points[:, :1] * (1 - 2 * side) / _MIDDLE, -1.0, 1.0)
        share = 0.5 + across * (3.0 - across**2) / 4.0  # a smooth step
        offsets = np.round(self.offsets * share, 3).astype(np.float32)  # as the whole ones are: half the memory
        eyes = self.eyes * (np.arange(2) == side)[:, None]
        return replace(self, name=self.name + SIDES[side], offsets=offsets, eyes=eyes)


@cache
def directions() -> tuple[Direction, ...]:
    """The directions of all measures and traits."""
    data = arrays("measures")
    names = [*data["names"], *data["traits"]]
    groups = [*data["groups"], *("person" for _ in data["traits"])]
    sided = [*data["sided"], *(False for _ in data["traits"])]
    return tuple(
        Direction(name=str(names[i]), group=str(groups[i]), offsets=offsets, eyes=data["eyes"][i], sided=bool(sided[i]))
        for i, offsets in enumerate(unpacked(data["offsets"]))
    )


def bone_sliders() -> tuple[Slider, ...]:
    """The sliders over joints."""
    table = json.loads((files("facepipe.heads") / "data" / "bone_sliders.json").read_text("utf-8"))
    paths = {path.rpartition("/")[2]: path for path in asset().joints}
    made = []
    for group, rows in table.items():
        for name, gains in rows.items():
            channels = []
            for target, gain in gains.items():
                joint, _, channel = target.partition(".")
                if joint.endswith("*"):
                    channels.append((paths[f"{joint[:-1]}Left"], channel, gain))
                    channels.append((paths[f"{joint[:-1]}Right"], channel, -gain if channel in _MIRRORED else gain))
                else:
                    channels.append((paths[joint], channel, gain))
            made.append(Slider(name=name, group=group, minimum=-1.0, channels=tuple(channels)))
    return tuple(made)


@cache
def _sockets_with_skin() -> tuple[Socket, ...]:
    return tuple(socket.with_skin(side, eye_ends) for side, socket in zip(SIDES, sockets(), strict=True))


def eye_ends(side: str, lids: IntArray) -> Ends:
    """The sliders of measures that change both eyes, at both ends."""
    offsets = {shape.name: shape.offsets[lids] for one in directions() for shape in one.shapes}
    moved, ball, joints = [], [], []
    for slider in identity_sliders():
        if slider.group == "eyes" and not slider.name.endswith(SIDES):
            gains = {
                (joint.rpartition("/")[2].removesuffix(side), channel): gain
                for joint, channel, gain in slider.channels
                if joint.endswith(side)
            }
            for end in (-1.0, 1.0):
                moved.append(end * sum(gain * offsets[shape] for shape, gain in slider.shapes))
                ball.append([end * gains.get(("eye", channel), 0.0) for channel in ("tx", "ty", "tz", "sx")])
                joints.append([end * gains.get(("lidUpper", channel), 0.0) for channel in ("ty", "sy")])
    return Ends(lids=np.array(moved), ball=np.array(ball), joints=np.array(joints))


def _with_looks(points: FloatArray, shapes: Shapes, heights: FloatArray | None = None) -> Shapes:
    """The shapes with looks and squints that keep the lids of points (n, 3) before the eyeballs.

    :param heights: as of `Eye.of`
    """
    fitted = dict(shapes)
    for side, socket in zip(SIDES, sockets(), strict=True):
        names = {name: f"{name}{side}" for name in (*LOOKS, SQUINT)}
        own = {name: {at: ways[socket.lids] for at, ways in shapes[full].items()} for name, full in names.items()}
        for name, ways in Eye.of(socket, points, heights).fitted(own).items():
            fitted[names[name]] = whole = {at: way.astype(np.float64) for at, way in shapes[names[name]].items()}
            for at, way in ways.items():
                whole[at][socket.lids] = way
    return fitted


Gains = Sequence[tuple[Direction, float]]


@cache
def identity_sliders() -> tuple[Slider, ...]:
    """The sliders of measures, from -1 to 1; those of one side name their mirror."""
    by_name = {direction.name: direction for direction in directions()}
    measured = set(arrays("measures")["names"].tolist())
    sliders = []
    for one in by_name.values():
        reach = MEASURES_REACH if one.name in measured else 1.0
        sliders += _family(one.name, one.group, [(one, 1.0)], reach)
    table = json.loads((files("facepipe.heads") / "data" / "mixes.json").read_text("utf-8"))
    for group, mixes in table.items():  # group -> slider -> gain of each measure
        for name, gains in mixes.items():
            sliders += _family(name, group, [(by_name[measure], gain) for measure, gain in gains.items()])
    return tuple(sliders)


def _family(name: str, group: str, parts: Gains, reach: float = 1.0) -> list[Slider]:
    """The slider of both sides and, where all its directions have sides, those of each."""
    whole = [(shape, gain) for one, gain in parts for shape in one.shapes]
    if not all(one.sided for one, _ in parts):
        return [_slider(name, group, whole, reach)]
    sides = [
        _slider(name + side, group, [(one.shapes[i], gain) for one, gain in parts], reach)
        for i, side in enumerate(SIDES)
    ]
    mirrors = [replace(one, mirror=other.name) for one, other in (sides, sides[::-1])]
    return [_slider(name, group, whole, reach), *mirrors]


def _slider(name: str, group: str, parts: Gains, reach: float) -> Slider:
    eyes = sum((gain * shape.eyes for shape, gain in parts), np.zeros((2, 5)))
    channels = [
        (f"root/neck/head/{joint}{side}", channel, round(float(gains[column] * share), 5))
        for side, gains in zip(SIDES, eyes, strict=True)
        for joint, channel, column, share in _CHANNELS
        if abs(gains[column]) >= _LEAST
    ]
    shapes = tuple((shape.name, gain) for shape, gain in parts)
    return Slider(name=name, group=group, minimum=-reach, maximum=reach, channels=tuple(channels), shapes=shapes)


@cache
def mode_sliders() -> tuple[Slider, ...]:
    """Sliders of the identity modes, and of sums of them by region, each less what the modes add to measures."""
    return sliders_of(arrays("identity"))


def sliders_of(data: Mapping[str, npt.NDArray[Any]]) -> tuple[Slider, ...]:
    """Those of the arrays of identity.npz."""
    size = len(data["even"])
    rows = [
        *((f"{MODE}{mode + 1:03}", "identity", row, IDENTITY_REACH) for mode, row in enumerate(np.eye(size))),
        *(
            (str(name), str(group), IDENTITY_STEP * row, MEASURES_REACH)
            for name, group, row in zip(data["names"], data["groups"], data["weights"], strict=True)
        ),
    ]
    by_name, made = {slider.name: slider for slider in identity_sliders()}, []
    for name, group, weights, reach in rows:
        channels: dict[tuple[str, str], float] = {}
        shapes: dict[str, float] = {}
        for measure, amount in measures_of(weights, data).items():
            for joint, channel, gain in by_name[measure].channels:
                channels[joint, channel] = channels.get((joint, channel), 0.0) - amount * gain
            for shape, gain in by_name[measure].shapes:
                shapes[shape] = shapes.get(shape, 0.0) - amount * gain
        slider = Slider(
            name=name,
            group=group,
            minimum=-reach,
            maximum=reach,
            channels=tuple((*where, gain) for where, gain in channels.items()),
            shapes=tuple(shapes.items()),
            modes=tuple((int(mode), float(weights[mode])) for mode in np.flatnonzero(weights)),
        )
        made.append(slider)
    return tuple(made)


def measures_of(weights: FloatArray, data: Mapping[str, npt.NDArray[Any]] | None = None) -> dict[str, float]:
    """The values of the sliders of measures that a person by weights (100,) of the identity modes has as its own.

    Sliders of both sides have the mean of both, those of one side what it differs by.

    :param data: arrays of identity.npz; None: the package's
    """
    data, names = data or arrays("identity"), arrays("measures")["names"]
    even, gains = data["even"], IDENTITY_STEP * data["gains"].astype(np.float64)
    both, apart = (np.where(rows, weights, 0.0) @ gains for rows in (even, ~even))
    found = {str(name): float(value) for name, value in zip(names, both, strict=True) if value}
    for name, value in zip(names, apart, strict=True):
        if value:
            found |= {f"{name}{SIDES[0]}": float(value), f"{name}{SIDES[1]}": -float(value)}
    return found


def values_of(weights: FloatArray) -> dict[str, float]:
    """The values of all sliders that are a person by weights (100,) of the identity modes: measures and modes."""
    modes = {f"{MODE}{mode + 1:03}": float(weight) for mode, weight in enumerate(weights)}
    return {**measures_of(np.asarray(weights, np.float64)), **modes}


def sided(weights: dict[str, float], shapes: frozenset[str]) -> dict[str, float]:
    """The weights with those of both sides for names that shapes have by sides alone."""
    return {
        shape: weight
        for name, weight in weights.items()
        for shape in ((name,) if name in shapes else (name + side for side in SIDES))
    }


def sliders(shapes: frozenset[str]) -> tuple[Slider, ...]:
    """The sliders of a head that has the shapes of ARKit."""
    made = [
        Slider(name=prefix + name, group=group, shapes=tuple(sided(weights, shapes).items()))
        for group, prefix, table in (("expression", "", _MOODS), ("visemes", "viseme_", VISEMES))
        for name, weights in table.items()
    ]
    return (
        *made,
        _look("lookLeft", "ry", ("eyeLookOutLeft", "eyeLookInRight"), ("eyeLookInLeft", "eyeLookOutRight")),
        _look("lookDown", "rx", ("eyeLookDownLeft", "eyeLookDownRight"), ("eyeLookUpLeft", "eyeLookUpRight")),
    )


def _look(name: str, channel: str, forth: tuple[str, ...], back: tuple[str, ...]) -> Slider:
    """Turns both eyes, and has the lids follow them either way."""
    return Slider(
        name=name,
        group="eyes",
        minimum=-1.0,
        channels=tuple((eye, channel, TURN) for eye in _EYES),
        channel_curves=(None, None),
        shapes=tuple((shape, 1.0) for shape in (*forth, *back)),
        shape_curves=(_RISING,) * len(forth) + (_FALLING,) * len(back),
    )


_Tracks = Mapping[str, FloatArray | float]


def animations(shapes: frozenset[str]) -> tuple[Animation, ...]:
    """`smile`, `lookLeft` and `talk` of a head that has the shapes of ARKit."""
    smile = sided({"mouthSmile": 0.9, "cheekSquint": 0.5, "jawOpen": 0.05}, shapes)
    look = {"eyeLookOutLeft": 0.7, "eyeLookInRight": 0.7}
    turns = {f"{_NECK}.ry": 0.12, f"{_HEAD}.rx": 0.05, f"{_HEAD}.ry": 0.25} | {f"{eye}.ry": 0.35 for eye in _EYES}
    times = np.arange(_RATE + 1) / _RATE
    beats = np.abs(times[:, None] * (len(_SPOKEN) - 1) - np.arange(len(_SPOKEN)))
    shares = 0.5 + 0.5 * np.cos(np.pi * np.minimum(beats, 1.0))  # (times, spoken), in sum 1
    weights: dict[str, FloatArray] = {}
    for share, viseme in zip(shares.T, _SPOKEN, strict=True):
        for shape, weight in sided(VISEMES[viseme], shapes).items():
            weights[shape] = weights.get(shape, np.zeros(len(times))) + weight * share
    slow = np.sin(2 * np.pi * times)
    blink = np.exp(-(((times - 0.75) / 0.06) ** 2))
    weights |= {"eyeBlinkLeft": blink, "eyeBlinkRight": blink, "browInnerUp": 0.4 * np.maximum(slow, 0.0)}
    return (
        _animation("smile", None, smile, {}),
        _animation("lookLeft", None, look, turns),
        _animation(TALK, times, weights, {f"{_HEAD}.rx": 0.04 * slow, f"{_HEAD}.ry": 0.06 * slow}),
    )


def _animation(name: str, times: FloatArray | None, shapes: _Tracks, turns: _Tracks) -> Animation:
    """:param turns: joint path and channel -> radians"""
    samples = 1 if times is None else len(times)
    joints = tuple(sorted({key.rpartition(".")[0] for key in turns}, key=lambda path: path.split("/")))
    coefficients = np.tile(rest_coefficients(len(joints)), (samples, 1, 1))
    for key, values in turns.items():
        joint, _, channel = key.rpartition(".")
        coefficients[:, joints.index(joint), CHANNELS.index(channel)] = values
    weights = [np.broadcast_to(values, samples) for values in shapes.values()]
    return Animation(
        name=name,
        times=times,
        joints=joints,
        coefficients=coefficients,
        shapes=tuple(shapes),
        shape_weights=np.stack(weights, axis=1),
    )


@one_thread()
def make(
    seed: int = 0,
    *,
    textures: int = 0,
    controls: Controls = "measures",
    age: float | None = None,
    feminine: float | None = None,
) -> FaceParts:
    """A person's head; seed 0 is the average one. Same seed, same arrays, and one topology for all.

    Lips of people meet. The average head's stay 0.7 mm apart, as it is what others are made from: on lips that touch,
    a transfer to a surface 2 mm off takes 37 mm of the lower lip's motion to the upper one.

    :param textures: texels a side of the skin's textures; 0: colours at points, no textures, and so no hair
    :param controls: sliders of measures, over shapes of their own, or sliders over bones
    :param age: years, 18 to 80; None: as the seed draws it
    :param feminine: 0 typically male, 1 typically female; None: as the seed draws it
    :raises InputError: a seed below 0, or an age or `feminine` out of range
    """
    if seed < 0:
        raise InputError("seed", f"is {seed}, expected 0 or more")
    given = {"age": (age, YOUNGEST, OLDEST), "feminine": (feminine, 0.0, 1.0)}
    for name, (value, low, high) in given.items():
        if value is not None and not low <= value <= high:
            raise InputError(name, f"is {value:g}, expected {low:g} to {high:g}")
    who = draw(seed, years=age, feminine=feminine)
    made = dressed(make_head(who.identity, controls, closed=seed > 0), who.look, textures or None)
    asked = {name: value for name, (value, _, _) in given.items() if value is not None}
    options = {"seed": seed, "textures": textures, "controls": controls, **asked}
    return replace(made, recipe=Recipe(verb="sample", options=options))


def make_head(identity: FloatArray, controls: Controls = "measures", *, closed: bool = True) -> FaceParts:
    """The bare head in centimetres, without materials, by (100,) standard deviations of the identity modes.

    :param closed: with lips that meet; else as far apart as the modes leave them
    """
    head = asset()
    points = head.person(identity)
    if closed:
        points = fit_lips(points)
    points, shapes = _with_parts_fitted(points)
    shapes = _with_looks(points, shapes)
    if controls == "measures":
        shapes = {
            **shapes,
            **{shape.name: {1.0: shape.offsets} for direction in directions() for shape in direction.shapes},
        }
    own_sliders, basis = bone_sliders(), None
    if controls == "measures":
        own_sliders = (*identity_sliders(), *mode_sliders())
        basis = PersonBasis(name=asset().basis.name, digest=asset().basis_digest.hex())
    # limits that keep the face whole: 0.8 cm, 0.4 rad and 30 % for face joints, wider turns for jaw, neck and eyes
    lower = np.tile(np.repeat([-0.8, -0.4, 0.7], 3), (len(head.joints), 1))
    upper = np.tile(np.repeat([0.8, 0.4, 1.3], 3), (len(head.joints), 1))
    for i, joint in enumerate(head.joints):
        name = joint.rpartition("/")[2]
        if name in ("root", "neck", "head"):
            lower[i, :3], upper[i, :3] = 0.0, 0.0
            lower[i, 3:6], upper[i, 3:6] = -0.7, 0.7
        elif name == "jaw":
            lower[i, 3], upper[i, 3] = -0.05, 0.45
        elif name.startswith(("eye", "lid")):
            lower[i, 3:6], upper[i, 3:6] = -0.6, 0.6
    return FaceParts(
        name="Face",
        meters_per_unit=0.01,
        meshes=tuple(_mesh(head, name, part, points, shapes) for name, part in head.parts.items()),
        skeleton=skeleton(points),
        animations=animations(frozenset(head.shapes)),
        played=TALK,
        sliders=(*sliders(frozenset(head.shapes)), *own_sliders),
        person_basis=basis,
        bone_limits=BoneLimits(lower=lower, upper=upper),
        attribution=ATTRIBUTION,
    )


def _mesh(head: Asset, name: str, part: Part, points: FloatArray, shapes: Shapes) -> Mesh:
    uvs, uv_indices = np.unique(head.uv_indices[part.corners], return_inverse=True)
    whole = name == "Head"
    masks = head.regions
    landmarks = {}
    if whole:
        landmarks = {"multipie68": Landmarks(indices=head.landmarks), "dense": Landmarks(indices=head.dense)}
    else:
        count = part.points.stop - part.points.start
        masks = {region: np.full(count, float(region == part.region)) for region in head.regions}
        if name.startswith("Eyeball"):
            landmarks = {"pupils": Landmarks(indices=np.array([pupil(name)], np.int32))}
    own = head.materials[part.faces]
    return Mesh(
        name=name,
        points=points[part.points],
        face_vertex_counts=head.counts[part.faces],
        face_vertex_indices=head.indices[part.corners] - part.points.start,
        uv_sets=(UvSet(values=head.uvs[uvs], indices=uv_indices.reshape(-1).astype(np.int32)),),
        blendshapes=blendshapes_of(part, shapes),
        skin=Skin(joint_indices=head.skin_joints[part.points], joint_weights=head.skin_weights[part.points]),
        regions=masks,
        landmarks=landmarks,
        anchor=head.anchor if whole else None,
        material_faces=tuple(
            MaterialFaces(material=head.material_names[number], faces=np.flatnonzero(own == number).astype(np.int32))
            for number in np.unique(own)
        ),
    )


def pupil(name: str) -> int:
    """The foremost point of an eye, as its mesh numbers them."""
    head = asset()
    return int(head.points[head.parts[name].points, 2].argmax())


def blendshapes_of(part: Part, shapes: Shapes) -> tuple[Blendshape, ...]:
    """The shapes that move points of a part."""
    blendshapes = []
    for name, offsets_at in shapes.items():
        moves = {weight: offsets[part.points] for weight, offsets in offsets_at.items()}
        moved = np.flatnonzero(np.any([offsets.any(axis=1) for offsets in moves.values()], axis=0))
        if not len(moved):
            continue
        inbetweens = tuple(
            Inbetween(name=f"at{round(100 * weight)}", weight=weight, offsets=offsets[moved])
            for weight, offsets in moves.items()
            if weight != 1.0
        )
        points = moved.astype(np.int32)
        blendshapes.append(
            Blendshape(name=name, point_indices=points, offsets=moves[1.0][moved], inbetweens=inbetweens)
        )
    return tuple(blendshapes)


def skeleton(points: FloatArray) -> Skeleton:
    """The skeleton of a head with the points (n, 3), all joints along the axes of the world at rest."""
    head = asset()
    places = np.einsum("jk,jkc->jc", head.joint_shares, points[head.joint_points])
    world = np.tile(np.eye(4), (len(places), 1, 1))
    world[:, :3, 3] = places
    found = Skeleton(joints=head.joints, bind_transforms=world)
    rest, below = world.copy(), found.parents >= 0
    rest[below, :3, 3] -= places[found.parents[below]]
    return Skeleton(joints=head.joints, bind_transforms=world, rest_transforms=rest)


@one_thread()
def average() -> FaceParts:
    """The bare average head that modes add to, without materials: its lips are apart, where people's meet."""
    return make_head(np.zeros(IDENTITY_MODES), closed=False)


def modes() -> FloatArray:
    """(m, n, 3) offsets in centimetres of a standard deviation each, of all meshes' points one after another."""
    return np.asarray(asset().modes, dtype=np.float64)


@one_thread()
def with_parts_fitted(points: FloatArray) -> FloatArray:
    """Points (n, 3) of a person in centimetres, with eyeballs that fit the lids, a mouth's inside behind the skin."""
    return _with_parts_fitted(points)[0]


def _with_parts_fitted(points: FloatArray) -> tuple[FloatArray, Shapes]:
    """And the shapes, with blinks of theirs."""
    points, shapes = fit_eyes(fit_mouth(points), asset().shapes)
    for socket in _sockets_with_skin():
        points[socket.lids] = Eye.of(socket, points).cleared()
    return points, shapes


@one_thread()
def with_own_lids(parts: FaceParts, points: FloatArray, names: Collection[str] = LIDS) -> FaceParts:
    """A face of the built-in head's topology, whose lids fit the eyeballs of points (n, 3) in centimetres.

    :param names: of LIDS, those of its shapes that are made anew: blinks close its lids, the others keep what somebody
        has changed in them
    """
    known = {name: _changed(parts, name) or asset().shapes[name] for name in LIDS if name not in BLINKS}
    joints = parts.skeleton  # a fitted face's are not where `skeleton` puts them: 0.9 mm off those of lids
    heights = None
    if joints.joints == asset().joints:
        heights = 100.0 * parts.meters_per_unit * np.asarray(joints.bind_transforms)[:, 1, 3]
    shapes = _with_looks(points, {**fit_eyes(points, asset().shapes)[1], **known}, heights)
    own = {name: shapes[name] for name in names}
    meshes = []
    for mesh in parts.meshes:
        part = asset().parts.get(mesh.name)
        lids = {} if part is None else {shape.name: shape for shape in blendshapes_of(part, own)}
        meshes.append(replace(mesh, blendshapes=tuple(lids.get(shape.name, shape) for shape in mesh.blendshapes)))
    return replace(parts, meshes=tuple(meshes))


def _changed(parts: FaceParts, name: str) -> dict[float, FloatArray] | None:
    """A shape of a face as (n, 3) offsets by weight; None: it is the built-in head's but for lids, which people differ
    in."""
    rows = {one.name: part.points for one in parts.meshes if (part := asset().parts.get(one.name))}
    found: dict[float, FloatArray] = {}
    for mesh in parts.meshes:
        for shape in mesh.blendshapes:
            if shape.name == name and mesh.name in rows:
                for weight, offsets in ((1.0, shape.offsets), *((one.weight, one.offsets) for one in shape.inbetweens)):
                    whole = found.setdefault(weight, np.zeros_like(asset().points))
                    whole[rows[mesh.name]][shape.point_indices] = offsets
    skin = np.ones(len(asset().points), bool)
    skin[arrays("lids")["lids"]] = False
    same = found and np.abs(found[1.0] - asset().shapes[name][1.0])[skin].max() < _SAME
    return None if same or not found else found


@one_thread()
def with_own_cards(parts: FaceParts, before: FaceParts) -> FaceParts:
    """A face of the built-in head whose cards lie on its skin as `before`; those that somebody has changed stay."""
    old, new = (next(mesh for mesh in face.meshes if mesh.name == "Head") for face in (before, parts))
    cards = {mesh.name: laid_again(mesh, old, new) for mesh in before.meshes}
    meshes = []
    for mesh in parts.meshes:
        laid = cards.get(mesh.name)
        if laid is not None:
            mesh = replace(mesh, points=laid.points, normals=laid.normals, blendshapes=laid.blendshapes)
        meshes.append(mesh)
    return replace(parts, meshes=tuple(meshes))


def settled(parts: FaceParts, changed: FaceParts, *, observed: Collection[str] = ()) -> FaceParts:
    """The built-in head `parts` with other points, whose lids fit its eyeballs, and whose cards lie on its skin.

    :param observed: shapes that scans show, which stay as they are; one blink counts for both
    """
    kept = {*observed, *(BLINKS if any(name in observed for name in BLINKS) else ())}
    body = changed.meshes[: len(asset().parts)]
    points = np.concatenate([np.asarray(mesh.points, np.float64) for mesh in body])
    changed = with_own_lids(changed, points, [name for name in LIDS if name not in kept])
    return with_own_cards(changed, parts)
