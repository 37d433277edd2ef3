"""People who are known, whom the head's modes of identity show all but a part of, and photos of them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import support_modules  # noqa: F401  (finds the modules of tests/support)
from narrow_face import NARROW
from recovery_looks import camera_of, random_backdrop, random_pose, random_studio
from recovery_targets import head_without_neck, posed, random_expression
from scipy.spatial import cKDTree

from facepipe.core.arrays import FloatArray
from facepipe.heads.assembly import average, modes, with_own_lids, with_parts_fitted
from facepipe.heads.asset import asset
from facepipe.heads.people import draw
from facepipe.heads.surfaces import dressed
from facepipe.parts import FaceParts
from facepipe.pictures import PictureOptions, picture
from facepipe.rig import build
from facepipe.verbs.author_neutral import AuthorNeutral

MM = 10.0  # a centimetre, in which the head is
RESIDUAL_MM = 0.5  # RMS over the narrow face of what no modes hold
SIDES = np.radians([(-30.0, -10.0), (-10.0, 10.0), (10.0, 30.0)])  # of the yaw of a person's photos
_WAVELENGTH = 80.0  # mm, of the residual
_FADE = 30.0  # mm, over which it ends off the narrow face: its modes would bend ears and neck by far more
_TEXELS = 512  # a side of the skin's textures
_SAMPLES = 2  # of a pixel in each direction
_SEEDS = 1 << 31  # of looks
_TESTS = Path(__file__).resolve().parents[1] / "tests" / "support"


@dataclass(frozen=True, kw_only=True)
class Person:
    """Someone with a shape, a skin and hair of their own."""

    parts: FaceParts
    narrow: FloatArray  # (m, 3) mm, the neutral
    nearest: FloatArray  # (m, 3) the same without the residual
    look: str


@dataclass(frozen=True, kw_only=True)
class Portrait:
    """A photo of someone."""

    image: npt.NDArray[np.uint8]  # (size, size, 3) sRGB
    yaw: float  # degrees, the camera to the person's left
    lens_mm: float


def person(number: int, seed: int) -> Person:
    """The person `number`; the same whatever the count.

    Weights of the modes are of a standard normal. The residual is orthogonal to the modes, and to moving, turning and
    scaling, on the narrow face: the nearest person that the modes hold is the one without it.
    """
    shape, colors = (np.random.default_rng([seed, number, stream]) for stream in range(2))
    within = asset().points + np.tensordot(shape.standard_normal(len(modes())), modes(), axes=1)
    points, nearest = (with_parts_fitted(one) for one in (within + _residual(shape) / MM, within))
    bare = with_own_lids(AuthorNeutral().changed(average(), MM * points), points)
    look = draw(int(colors.integers(1, _SEEDS))).look
    return Person(
        parts=dressed(bare, look, _TEXELS),
        narrow=MM * points[:NARROW],
        nearest=MM * nearest[:NARROW],
        look=f"skin {look.tone:.1f}, hair {look.hair} {look.style}, eyes {look.eyes}",
    )


def portraits(who: Person, number: int, seed: int, size: int) -> Iterator[Portrait]:
    """Photos from each of the sides, in any order, each with an expression, a lens, a light and a background."""
    rng = np.random.default_rng([seed, number, 2])
    rig, neutral = build(who.parts), posed(who.parts, build(who.parts), {}, {})
    bare = replace(who.parts, meshes=who.parts.meshes[:1])  # hair may be cut by the border
    head = neutral[: len(bare.meshes[0].points)][head_without_neck(bare)]
    for low, high in rng.permutation(SIDES):
        pose = replace(random_pose(rng), yaw=float(rng.uniform(low, high)))
        points = posed(who.parts, rig, {}, random_expression(rng))
        options = PictureOptions(
            size=size,
            samples=_SAMPLES,
            camera=camera_of(pose, head, size),
            studio=random_studio(rng),
            backdrop=random_backdrop(rng, size),
        )
        image = np.asarray(picture(who.parts, points, options))
        yield Portrait(image=image, yaw=float(np.degrees(pose.yaw)), lens_mm=pose.lens_mm)


def _residual(rng: np.random.Generator) -> FloatArray:
    """(n, 3) millimetres: a smooth field, less what modes and similarity hold of it on the narrow face."""
    sys.path.append(str(_TESTS))
    from smooth_fields import smooth_field

    wanted = smooth_field(MM * asset().points, _WAVELENGTH, 3, rng)
    held, (span, back) = _held(), _span()
    shares = back @ (span @ wanted[:NARROW].ravel())
    left = wanted - np.tensordot(shares, held, axes=1)
    rms = np.sqrt((left[:NARROW] ** 2).sum(axis=1).mean())
    return np.asarray(RESIDUAL_MM / rms * left * _fading()[:, None])


@cache
def _held() -> FloatArray:
    """(k, n, 3) millimetres of modes, and of what a similarity does to a head."""
    points = asset().points - asset().points[:NARROW].mean(axis=0)
    turned = np.cross(np.eye(3)[:, None], points[None])
    moved = np.broadcast_to(np.eye(3)[:, None], turned.shape)
    return np.concatenate([MM * modes(), moved, turned, points[None]])


@cache
def _span() -> tuple[FloatArray, FloatArray]:
    """(k, 3 m) those on the narrow face, and (k, k) the inverse of their products."""
    span = _held()[:, :NARROW].reshape(len(_held()), -1)
    return span, np.linalg.inv(span @ span.T)


@cache
def _fading() -> FloatArray:
    """(n,) 1 on the narrow face, less the farther off it."""
    points = MM * asset().points
    away, _ = cKDTree(points[:NARROW]).query(points)
    return np.asarray(np.exp(-((away / _FADE) ** 2)))
