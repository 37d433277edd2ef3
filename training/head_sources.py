"""Random people of the head in the box: their shapes, looks and expressions."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt

from facepipe.heads.assembly import bone_sliders, make_head
from facepipe.heads.asset import asset
from facepipe.heads.people import MODES, Look, draw
from facepipe.heads.surfaces import dressed
from facepipe.parts import FaceParts, Material, Mesh
from facepipe.rig import build, slide

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

CLOTHES = "Clothes"
_TEXELS = 256  # a side of the skin's textures
_SEEDS = 1 << 31  # people to draw from

# Shapes that seldom show alone; expressions are drawn from groups that go together.
_PAIRS = ("browDown", "browOuterUp", "cheekSquint", "eyeSquint", "eyeWide", "mouthSmile", "mouthFrown", "mouthDimple")
_PAIRS += ("mouthLowerDown", "mouthPress", "mouthStretch", "mouthUpperUp", "noseSneer")
_SINGLES = ("jawOpen", "mouthFunnel", "mouthPucker", "mouthRollLower", "mouthRollUpper", "mouthShrugLower")
_SINGLES += ("jawForward", "browInnerUp", "cheekPuff")
_SIDEWAYS = (("jawLeft", "jawRight"), ("mouthLeft", "mouthRight"))


def expression(rng: np.random.Generator) -> dict[str, float]:
    """Weights of ARKit's shapes: nothing, a smile, an open mouth, or a mixture."""
    found: dict[str, float] = {}
    mood = rng.choice(["neutral", "smile", "open", "mixed"], p=[0.2, 0.35, 0.1, 0.35])

    def both(name: str, amount: float) -> None:
        for side in ("Left", "Right"):
            found[name + side] = float(np.clip(amount + rng.normal(0, 0.06), 0, 1))

    if mood == "smile":
        both("mouthSmile", rng.uniform(0.3, 1.0))
        both("cheekSquint", rng.uniform(0, 0.6))
        if rng.random() < 0.65:
            both("mouthUpperUp", rng.uniform(0.1, 0.8))
            both("mouthLowerDown", rng.uniform(0, 0.8))
            found["jawOpen"] = rng.uniform(0, 0.15)
        both("mouthStretch", rng.uniform(0, 0.4) * (rng.random() < 0.5))
    elif mood == "open":
        found["jawOpen"] = rng.uniform(0.1, 0.8)
    elif mood == "mixed":
        for name in _PAIRS:
            if rng.random() < 0.3:
                both(name, abs(rng.normal(0, 0.45)))
        for name in _SINGLES:
            if rng.random() < 0.18:
                found[name] = min(abs(rng.normal(0, 0.4)), 1)
        for names in _SIDEWAYS:
            if rng.random() < 0.15:
                found[names[rng.integers(2)]] = rng.uniform(0, 0.5)
    blink = rng.random()
    if blink < 0.25:
        both("eyeBlink", rng.uniform(0, 0.4) if blink < 0.17 else rng.uniform(0.7, 1))
    return found


def gaze(rng: np.random.Generator) -> dict[str, float]:
    """Values of the sliders that turn the eyes: straight ahead half of the time."""
    if rng.random() < 0.5:
        return {}
    return {"lookLeft": rng.uniform(-0.6, 0.6), "lookDown": rng.uniform(-0.5, 0.5)}


class Subject:
    """A face that can be posed."""

    def __init__(self, face: FaceParts, values: dict[str, float]) -> None:
        """:param values: of the sliders that shape the person"""
        self.face = face
        self._rig, self._values = build(face), values

    def pose(self, rng: np.random.Generator, squints: float = 0.0) -> FloatArray:
        """(n, 3) points of all meshes with a random expression.

        :param squints: share of expressions whose eyes are narrowed too
        """
        weights = expression(rng)
        if squints and rng.random() < squints:
            amounts = {
                "eyeBlink": rng.uniform(0, 0.6),
                "eyeSquint": rng.uniform(0, 1),
                "cheekSquint": rng.uniform(0, 1),
            }
            weights |= {name + side: amount for name, amount in amounts.items() for side in ("Left", "Right")}
        return self._points(weights, gaze(rng))

    def neutral(self) -> FloatArray:
        """(n, 3) points of all meshes without an expression."""
        return self._points({}, {})

    def _points(self, weights: dict[str, float], eyes: dict[str, float]) -> FloatArray:
        coefficients, slid = slide(self.face.sliders, self._rig.joints, self._values | eyes)
        weights = {name: weights.get(name, 0.0) + slid.get(name, 0.0) for name in {**weights, **slid}}
        return self._rig.evaluate(weights, coefficients=coefficients)


class Person:
    """A random person: drawn from the modes of identity, or the average head under random sliders of bones."""

    def __init__(self, rng: np.random.Generator, *, by_sliders: bool, spread: float = 1.0) -> None:
        """:param spread: of the weights of the modes"""
        who = draw(int(rng.integers(1, _SEEDS)))
        self.look = who.look
        self._bare = make_head(np.zeros(MODES) if by_sliders else spread * who.identity, "bones")
        values = np.where(rng.random(len(slider_names())) < 0.7, rng.uniform(-1, 1, len(slider_names())), 0.0)
        self._values = dict(zip(slider_names(), values.tolist(), strict=True)) if by_sliders else {}
        self.attributes = values / 2 + 0.5 if by_sliders else np.full(len(values), np.nan)  # (a,) 0..1, NaN: unknown

    def bare(self) -> Subject:
        """The head alone."""
        return Subject(self._bare, self._values)

    def dressed(self, look: Look, rng: np.random.Generator) -> Subject:
        """The head with skin, hair and clothes."""
        face = dressed(self._bare, look, _TEXELS)
        cloth = Material(name=CLOTHES, diffuse_color=tuple(rng.uniform(0.02, 0.8) * rng.uniform(0.3, 1, 3)))
        return Subject(
            replace(face, meshes=(*face.meshes, _shoulders(rng)), materials=(*face.materials, cloth)), self._values
        )

    def scanned(self, look: Look, rng: np.random.Generator) -> Subject:
        """The head alone with its skin, or in one grey."""
        face, names = dressed(self._bare, look, _TEXELS), {mesh.name for mesh in self._bare.meshes}
        materials = face.materials
        if rng.random() < 0.5:
            grey = (rng.uniform(0.1, 0.7),) * 3
            materials = tuple(replace(material, diffuse_color=grey) for material in materials)
        meshes = tuple(mesh for mesh in face.meshes if mesh.name in names)
        return Subject(replace(face, meshes=meshes, materials=materials), self._values)


def random_look(rng: np.random.Generator) -> Look:
    """The look of someone."""
    return draw(int(rng.integers(1, _SEEDS))).look


@cache
def slider_names() -> tuple[str, ...]:
    """Sliders of bones, whose values are a person's attributes."""
    return tuple(slider.name for slider in bone_sliders())


@cache
def contour_rows() -> tuple[IntArray, ...]:
    """(17,) the points on which each contour landmark may slide where the head is turned away, itself first."""
    head = asset()
    places = head.points[: head.parts["Head"].points.stop]
    center = np.array([0.0, 2.0])
    offset = places[:, :2] - center
    angle, radius = np.arctan2(offset[:, 1], offset[:, 0]), np.hypot(*offset.T)
    rows = []
    for point in head.landmarks[:17]:
        place = places[point, :2] - center
        turn = np.abs((angle - np.arctan2(place[1], place[0]) + np.pi) % (2 * np.pi) - np.pi)
        length = np.hypot(*place)
        near = (turn < 0.05) & (radius > 0.5 * length) & (radius < 1.03 * length)
        near &= places[:, 2] >= places[point, 2] - 0.2
        rows.append(np.concatenate([[point], np.flatnonzero(near)]))
    return tuple(rows)


def _shoulders(rng: np.random.Generator) -> Mesh:
    """A collar and what is below it, as rings."""
    levels, angle = np.linspace(0, 1, 9)[:, None], np.linspace(-np.pi, np.pi, 33)[None]
    y = rng.uniform(-17, -9) - 22 * levels + 0 * angle
    wide = 6.6 + 1.5 * levels + 17 * np.clip((levels - 0.2) / 0.8, 0, 1) ** 0.7
    deep = 6.6 + 1.2 * levels + 6 * np.clip((levels - 0.2) / 0.8, 0, 1)
    points = np.stack([wide * np.sin(angle), y - 1.2 * np.cos(angle), deep * np.cos(angle) - 1.0], axis=-1)
    number = np.arange(9 * 33).reshape(9, 33)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    return Mesh(
        name=CLOTHES,
        points=points.reshape(-1, 3),
        face_vertex_counts=np.full(len(quads), 4, np.int32),
        face_vertex_indices=quads.ravel().astype(np.int32),
        material=CLOTHES,
        double_sided=True,
    )
