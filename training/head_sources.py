"""Random heads as points on fixed topologies: ICT-FaceKit's and the sample's.

Every head also tells where its points are in one common frame, that of ICT-FaceKit's neutral (about centimetres, Y up,
looking along +Z): what is painted there, brows, lips, a hairline, lands where it belongs on all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from scipy.interpolate import RBFInterpolator

from facepipe.geometry.polygons import triangulate
from facepipe.heads import make
from facepipe.learn.normals import PointNormals
from facepipe.learn.rig import DifferentiableRig
from facepipe.parts import FaceParts
from facepipe.rig import build

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

_TEXTURES = 16  # texels: brows and lashes come with textures, which are not looked at here

SKIN, EYE, TEETH, MOUTH, SOCKET, STRANDS, BROW, CLOTH = range(8)  # what a triangle shows

# Shapes that seldom show alone; expressions are drawn from groups that go together.
_PAIRS = ("browDown", "browInnerUp", "browOuterUp", "cheekSquint", "eyeSquint", "eyeWide", "mouthSmile", "mouthFrown")
_PAIRS += ("mouthDimple", "mouthLowerDown", "mouthPress", "mouthStretch", "mouthUpperUp", "noseSneer", "cheekPuff")
_SINGLES = (
    "jawOpen",
    "mouthFunnel",
    "mouthPucker",
    "mouthRollLower",
    "mouthRollUpper",
    "mouthShrugLower",
    "jawForward",
)
_SIDEWAYS = (("jawLeft", "jawRight"), ("mouthLeft", "mouthRight"))
_GAZE = (("eyeLookIn_L", "eyeLookOut_R"), ("eyeLookOut_L", "eyeLookIn_R"), ("eyeLookUp_L", "eyeLookUp_R"))
_GAZE += (("eyeLookDown_L", "eyeLookDown_R"),)


@dataclass(frozen=True, kw_only=True)
class Topology:
    """What all heads of one source share."""

    triangles: torch.Tensor  # (t, 3)
    kinds: IntArray  # (t,) what each triangle shows
    canonical: FloatArray  # (n, 3) in the common frame
    landmarks: IntArray  # (68,)
    rows: tuple[IntArray, ...]  # (17,) points on which each contour landmark may slide, itself first
    normals: PointNormals


class Subject(Protocol):
    """One person."""

    topology: Topology
    attributes: FloatArray  # (a,) 0..1; NaN where the source has none

    def pose(self, rng: np.random.Generator) -> torch.Tensor:
        """(n, 3) points with a random expression."""


class Source(Protocol):
    """A maker of persons."""

    def draw(self, rng: np.random.Generator) -> Subject:
        """A random person."""


def expression(rng: np.random.Generator) -> dict[str, float]:
    """Weights by ICT-FaceKit's names: nothing, a smile, an open mouth, or a mixture."""
    found: dict[str, float] = {}
    mood = rng.choice(["neutral", "smile", "open", "mixed"], p=[0.2, 0.35, 0.1, 0.35])

    def both(name: str, amount: float) -> None:
        for side in ("_L", "_R"):
            found[name + side] = float(np.clip(amount + rng.normal(0, 0.06), 0, 1))

    if mood == "smile":
        both("mouthSmile", rng.uniform(0.3, 1.0))
        both("cheekSquint", rng.uniform(0, 0.6))
        if rng.random() < 0.65:
            both("mouthUpperUp", rng.uniform(0.1, 0.6))
            both("mouthLowerDown", rng.uniform(0, 0.5))
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
    if rng.random() < 0.5:
        for name in _GAZE[rng.integers(len(_GAZE))]:
            found[name] = rng.uniform(0, 0.6)
    blink = rng.random()
    if blink < 0.25:
        both("eyeBlink", rng.uniform(0, 0.4) if blink < 0.17 else rng.uniform(0.7, 1))
    return found


def contour_rows(canonical: FloatArray, landmarks: IntArray, skin: IntArray) -> tuple[IntArray, ...]:
    """The points on which each of landmarks 0-16 may slide where the head is turned away: rows towards the face."""
    center = np.array([0.0, 2.0])
    offset = canonical[skin, :2] - center
    angle, radius = np.arctan2(offset[:, 1], offset[:, 0]), np.hypot(*offset.T)
    rows = []
    for point in landmarks[:17]:
        place = canonical[point, :2] - center
        turn = np.abs((angle - np.arctan2(place[1], place[0]) + np.pi) % (2 * np.pi) - np.pi)
        length = np.hypot(*place)
        near = (turn < 0.05) & (radius > 0.5 * length) & (radius < 1.03 * length)
        near &= canonical[skin, 2] >= canonical[point, 2] - 0.2
        rows.append(np.concatenate([[point], skin[near]]))
    return tuple(rows)


class IctSource:
    """Persons of ICT-FaceKit's identity modes (MIT, Copyright (c) 2020 USC Institute for Creative Technologies)."""

    def __init__(self, path: Path) -> None:
        """:param path: ict_facekit.npz"""
        with np.load(path) as data:
            arrays = {name: data[name] for name in data.files}
        kept = {"Face": SKIN, "Head and Neck": SKIN, "Mouth socket": MOUTH, "Gums and tongue": MOUTH, "Teeth": TEETH}
        kept |= {"Eye socket left": SOCKET, "Eye socket right": SOCKET}
        corners, faces = triangulate(arrays["face_vertex_counts"])
        triangles = arrays["face_vertex_indices"][corners].astype(np.int64)
        part = np.array([kept.get(str(name), -1) for name in arrays["part_names"]])
        kinds = part[arrays["face_part"]][faces]
        of_face = np.zeros(len(arrays["face_part"]), bool)
        for name, (start, end) in zip(arrays["eye_part_names"], arrays["eye_part_face_range"], strict=True):
            of_face[start:end] = str(name).startswith("Sclera")  # its cornea covers the iris
        kinds[of_face[faces]] = EYE
        triangles, kinds = triangles[kinds >= 0], kinds[kinds >= 0]
        used, flat = np.unique(triangles, return_inverse=True)
        triangles = flat.reshape(-1, 3)
        place = np.full(len(arrays["neutral"]), -1)
        place[used] = np.arange(len(used))
        canonical = arrays["neutral"][used].astype(np.float64)
        landmarks = place[arrays["landmarks_multipie68"]]
        skin = place[: arrays["part_vertex_range"][0, 1]]
        self.topology = Topology(
            triangles=torch.as_tensor(triangles),
            kinds=kinds,
            canonical=canonical,
            landmarks=landmarks,
            rows=contour_rows(canonical, landmarks, skin[skin >= 0]),
            normals=PointNormals(triangles, len(used)),
        )
        self.neutral = torch.as_tensor(canonical, dtype=torch.float32).reshape(-1)
        self.identities = torch.as_tensor(arrays["identity_deltas"][:, used]).reshape(100, -1)
        self.expressions = torch.as_tensor(arrays["expression_deltas"][:, used]).reshape(53, -1)
        self.names = [str(name) for name in arrays["expression_names"]]

    def draw(self, rng: np.random.Generator) -> Subject:
        """A random person."""
        modes = np.clip(rng.normal(0, 1, 100) * rng.choice([0.7, 1.0, 1.2]), -2.5, 2.5)
        points = self.neutral + torch.as_tensor(modes, dtype=torch.float32) @ self.identities
        return IctSubject(self, points, np.zeros(0))


class IctSubject:
    """A person of `IctSource`."""

    def __init__(self, source: IctSource, points: torch.Tensor, attributes: FloatArray) -> None:
        self.topology, self.attributes = source.topology, attributes
        self._source, self._points = source, points

    def pose(self, rng: np.random.Generator) -> torch.Tensor:
        """(n, 3) points with a random expression."""
        weights = torch.zeros(len(self._source.names))
        for name, value in expression(rng).items():
            if name in self._source.names:
                weights[self._source.names.index(name)] = value
        return (self._points + weights @ self._source.expressions).reshape(-1, 3)


class SampleSource:
    """Persons of the built-in sample: one seed's head under random sliders."""

    def __init__(self, seed: int, frame: Topology) -> None:
        """:param frame: ICT-FaceKit's, for the common frame"""
        parts = make(seed, textures=_TEXTURES, controls="bones")
        rig = build(parts)
        self.expressive = np.array([bool(one.shapes) for one in parts.sliders])
        self.rig = DifferentiableRig(rig, parts.sliders)
        self.names = self.rig.sliders.names
        triangles, kinds = _pieces(parts)
        landmarks = parts.meshes[0].landmarks["multipie68"].indices.astype(np.int64)
        rest = self.rig().numpy().astype(np.float64)
        warp = RBFInterpolator(rest[landmarks], frame.canonical[frame.landmarks], smoothing=0.05, degree=1)
        canonical = warp(rest)
        skin = np.arange(len(parts.meshes[0].points))
        self.topology = Topology(
            triangles=torch.as_tensor(triangles),
            kinds=kinds,
            canonical=canonical,
            landmarks=landmarks,
            rows=contour_rows(canonical, landmarks, skin),
            normals=PointNormals(triangles, len(rest)),
        )

    def draw(self, rng: np.random.Generator) -> Subject:
        """A random person: about two thirds of the sliders away from their defaults."""
        lower, upper, default = (
            one.numpy() for one in (self.rig.sliders.lower, self.rig.sliders.upper, self.rig.sliders.default)
        )
        values = np.where(rng.random(len(lower)) < 0.7, rng.uniform(lower, upper), default)
        return SampleSubject(self, values, lower, upper)


class SampleSubject:
    """A person of `SampleSource`."""

    def __init__(self, source: SampleSource, values: FloatArray, lower: FloatArray, upper: FloatArray) -> None:
        self.topology = source.topology
        expressive = source.expressive
        defaults = source.rig.sliders.default.numpy()
        self._values = np.where(expressive, defaults, values)
        self.attributes = np.where(expressive, np.nan, (self._values - lower) / (upper - lower))
        self._rig = source.rig

    def pose(self, rng: np.random.Generator) -> torch.Tensor:
        """(n, 3) points with a random expression."""
        weights = torch.zeros(len(self._rig.shapes))
        for name, value in expression(rng).items():
            plain = name.replace("_L", "Left").replace("_R", "Right")
            for one in (plain, name[:-2]):
                if one in self._rig.shapes:
                    weights[self._rig.shapes.index(one)] = value
                    break
        return self._rig(torch.as_tensor(self._values, dtype=torch.float32), weights)


def sample_attribute_names() -> tuple[str, ...]:
    """The sliders of the sample."""
    return tuple(slider.name for slider in make(0, controls="bones").sliders)


def _pieces(parts: FaceParts) -> tuple[IntArray, IntArray]:
    """Triangles of all meshes but the hair, and what each shows."""
    kinds = {"Head": SKIN, "GumsAndTongue": MOUTH, "Teeth": TEETH, "Brows": BROW, "Lashes": STRANDS}
    triangles: list[IntArray] = []
    shown: list[IntArray] = []
    first = 0
    for mesh in parts.meshes:
        corners, _ = triangulate(mesh.face_vertex_counts)
        kind = EYE if mesh.name.startswith("Eye") else kinds.get(mesh.name)
        if kind is not None:
            triangles.append(np.asarray(mesh.face_vertex_indices, np.int64)[corners] + first)
            shown.append(np.full(len(corners), kind))
        first += len(mesh.points)
    return np.concatenate(triangles), np.concatenate(shown)


def all_sources(ict: Path, seeds: Sequence[int]) -> tuple[IctSource, list[SampleSource]]:
    """ICT-FaceKit, and the sample with each of its seeds."""
    first = IctSource(ict)
    return first, [SampleSource(seed, first.topology) for seed in seeds]
