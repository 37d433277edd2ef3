"""Portraits of known people: what a fit is given, and what it should find.

Every person is the built-in sample face with other sliders: 30 of the 57 that a fit may move have values drawn evenly
from their range, the others and those of expressions keep their defaults. `facepipe.pictures` draws them, which
shares no code with the renderer of the fit: lamps with shadows, highlights and soft shade instead of spherical
harmonics, skin and hair in other colours, backgrounds plain to cluttered.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
from recovery_landmarks import FaceLandmarks
from recovery_looks import camera_of, random_backdrop, random_pose, random_studio, recolored

from facepipe.heads import make
from facepipe.parts import FaceParts
from facepipe.photo.descent.subject import Subject
from facepipe.pictures import PictureOptions, picture
from facepipe.pictures.camera import Camera
from facepipe.rig import Rig, build, slide

FloatArray = npt.NDArray[np.floating]

ACTIVE = 30  # sliders that are not at their default
SAMPLES = 3  # of a pixel in each direction
# A person makes one of the faces of each place; both sides together or, where there are two, one of them.
PLACES: tuple[tuple[str, ...], ...] = (
    ("browDown*", "browOuterUp*", "browInnerUp"),
    ("eyeBlink*", "eyeSquint*", "eyeWide*"),
    ("mouthSmile*", "mouthFrown*", "mouthStretch*", "mouthUpperUp*", "mouthLowerDown*", "mouthPucker", "mouthFunnel",
     "mouthDimple*", "mouthLeft", "mouthRight"),
    ("jawOpen", "jawForward"),
    ("noseSneer*", "cheekSquint*", "cheekPuff"),
)  # fmt: skip
WEIGHTS = (0.2, 0.8)


@dataclass(frozen=True, kw_only=True)
class RecoveryTarget:
    """A portrait, and the truth about it."""

    number: int
    image: npt.NDArray[np.uint8]  # (size, size, 3) sRGB
    landmarks: FloatArray  # (68, 2) pixels with noise: all that a fit is given besides the image
    exact: FloatArray  # (68, 2) pixels without
    sliders: Mapping[str, float]  # every slider of the face
    expressions: Mapping[str, float]  # shape -> weight, those that are not 0
    camera: Camera
    points: FloatArray  # (n, 3) world points of all meshes
    neutral: FloatArray  # (n, 3) by the sliders alone


@dataclass(frozen=True, kw_only=True)
class Sample:
    """The face that all portraits show, with what is worth computing once."""

    parts: FaceParts
    rig: Rig
    landmarks: FaceLandmarks


@cache
def sample() -> Sample:
    """The built-in sample of seed 0."""
    parts = make(0)
    return Sample(parts=parts, rig=build(parts), landmarks=FaceLandmarks.of(parts))


def targets(
    count: int, seed: int, *, size: int = 256, expressions: bool = True, noise: float = 1.0
) -> Iterator[RecoveryTarget]:
    """Portraits 0 to `count` - 1 of a seed; each is the same whatever the count.

    :param expressions: False: the same people, cameras, lights and noise without expressions
    :param noise: standard deviation of the landmarks' noise in pixels, of x and of y
    """
    for number in range(count):
        yield target(number, seed, size=size, expressions=expressions, noise=noise)


def target(number: int, seed: int, *, size: int = 256, expressions: bool = True, noise: float = 1.0) -> RecoveryTarget:
    """One of the `targets`."""
    parts, rig = sample().parts, sample().rig
    person, looks, face, errors = (np.random.default_rng([seed, number, stream]) for stream in range(4))
    sliders = random_sliders(parts, person)
    weights = random_expression(face) if expressions else {}
    neutral, points = posed(parts, rig, sliders, {}), posed(parts, rig, sliders, weights)
    camera = camera_of(random_pose(looks), neutral[head_without_neck(parts)], size)
    options = PictureOptions(
        size=size,
        samples=SAMPLES,
        camera=camera,
        studio=random_studio(looks),
        backdrop=random_backdrop(looks, size),
    )
    exact = sample().landmarks.project(points, camera)
    return RecoveryTarget(
        number=number,
        image=np.asarray(picture(recolored(parts, looks), points, options)),
        landmarks=exact + noise * errors.normal(size=exact.shape),
        exact=exact,
        sliders=sliders,
        expressions=weights,
        camera=camera,
        points=points,
        neutral=neutral,
    )


def posed(parts: FaceParts, rig: Rig, sliders: Mapping[str, float], expressions: Mapping[str, float]) -> FloatArray:
    """(n, 3) world points of all meshes."""
    coefficients, weights = slide(parts.sliders, rig.joints, sliders)
    for shape, weight in expressions.items():
        weights[shape] = weights.get(shape, 0.0) + weight
    return rig.evaluate(weights, coefficients=coefficients)


def random_sliders(parts: FaceParts, rng: np.random.Generator) -> dict[str, float]:
    """A value of every slider: `ACTIVE` of those of a person drawn from their ranges, the others at their defaults."""
    values = {slider.name: slider.default for slider in parts.sliders}
    own = Subject.of(parts).free_sliders
    for index in rng.permutation(len(own))[:ACTIVE]:
        values[own[index].name] = float(rng.uniform(own[index].minimum, own[index].maximum))
    return values


def random_expression(rng: np.random.Generator) -> dict[str, float]:
    """Weights of three to five shapes in different places of the face."""
    wanted = int(rng.integers(3, 6))
    weights: dict[str, float] = {}
    for place in rng.permutation(len(PLACES)):
        name = PLACES[place][rng.integers(len(PLACES[place]))]
        weight = float(rng.uniform(*WEIGHTS))
        sides: tuple[str, ...] = ("",)
        if name.endswith("*"):
            both = rng.random() < 0.7 and wanted - len(weights) > 1
            sides = ("Left", "Right") if both else (("Left",), ("Right",))[rng.integers(2)]
        for side in sides:
            weights[name.removesuffix("*") + side] = min(weight * float(rng.uniform(0.85, 1.15)), WEIGHTS[1])
        if len(weights) == wanted:
            break
    return weights


def head_without_neck(parts: FaceParts) -> npt.NDArray[np.bool_]:
    """(n,) points of the head: all meshes but what hangs below the chin."""
    neck = [np.asarray(mesh.regions["neck"]) > 0.5 for mesh in parts.meshes]
    return ~np.concatenate(neck)
