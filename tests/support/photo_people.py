"""Portraits of the sample that the renderer of photo fits makes itself, and all that is true about them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from small_head import make
from with_torch import torch

from facepipe.parts import FaceParts
from facepipe.photo.descent.descent import Unknowns
from facepipe.photo.descent.fit import priors_of
from facepipe.photo.descent.joint_loss import JointLoss, single
from facepipe.photo.descent.landmark_fit import LandmarkFit, Priors, State
from facepipe.photo.descent.landmark_rig import front_axes, landmark_points
from facepipe.photo.descent.shadows import Shadows
from facepipe.photo.descent.subject import FOCAL, PoseSpace, Subject
from facepipe.photo.descent.working_photo import WorkingPhoto, to_srgb
from facepipe.photo.options import PhotoFitOptions
from facepipe.photo.renderer.face_model import FaceModel, Look
from facepipe.photo.renderer.light import DARK, KeyLight, ambient, distant

SMILE = {"jawOpen": 0.3, "mouthSmileLeft": 0.5, "mouthSmileRight": 0.4}


@cache
def sample() -> FaceParts:
    """The built-in sample of seed 0."""
    return make(0)


@cache
def subject() -> Subject:
    """What may move of it."""
    return Subject.of(sample())


@cache
def model() -> FaceModel:
    """Its renderer."""
    return FaceModel(sample(), largest_texture=128)


@dataclass(frozen=True, kw_only=True)
class Portrait:
    """Photos of one person."""

    truth: Unknowns  # poses of the photos, light and colours too
    state: State
    spaces: tuple[PoseSpace, ...]
    images: tuple[np.ndarray, ...]  # (size, size, 3) sRGB
    landmarks: tuple[np.ndarray, ...]  # (68, 2)
    shadows: tuple[Shadows | None, ...]


def photo_space(own: Subject, size: int) -> PoseSpace:
    """Poses in square photos."""
    points, _ = landmark_points(own.parts)
    axes = np.stack(front_axes(own.parts, own.rig), axis=1)
    return PoseSpace(
        middle=axes[points].mean(axis=0), size=float(np.ptp(axes[:, 1])), center=(size / 2, size / 2), side=float(size)
    )


def random_state(seed: int, views: int) -> State:
    """Sliders over most of their ranges, a smile, cameras near a portrait's."""
    rng, own = np.random.default_rng(seed), subject()
    names = [own.rig.shapes[i] for i in own.expressions]
    expressions = np.zeros((views, len(names)))
    for name, weight in SMILE.items():
        expressions[:, names.index(name)] = weight
    poses = np.zeros((views, 7))
    poses[:, :3] = rng.uniform(-1, 1, (views, 3)) * (0.1, 0.35, 0.1)
    poses[:, 3:5] = rng.uniform(0.47, 0.53, (views, 2))
    poses[:, 5] = np.log(0.62)
    poses[:, 6] = np.log(FOCAL) - poses[:, 5] + rng.uniform(-0.1, 0.1, views)
    return State(shares=rng.uniform(0.2, 0.8, len(own.sliders)), expressions=expressions, poses=poses)


def random_light(rng: np.random.Generator) -> torch.Tensor:
    """A lamp from before the face, and some from all around."""
    direction = rng.normal(size=3) * 0.5 + (0.0, 0.3, 1.0)
    lamp = distant(
        torch.tensor(direction / np.linalg.norm(direction), dtype=torch.float32),
        torch.tensor(rng.uniform(0.3, 0.6, 3), dtype=torch.float32),
    )
    return lamp + ambient(torch.tensor(rng.uniform(0.15, 0.3, 3), dtype=torch.float32))


@cache
def portrait(
    seed: int = 0, size: int = 96, views: int = 1, shadows: bool = False, lamp: tuple[float, ...] | None = None
) -> Portrait:
    """Photos of a random person in random light before grey.

    :param shadows: that the face casts on itself
    :param lamp: (8,) beside that light, as `KeyLight`; with shadows
    """
    rng, face = np.random.default_rng([seed, 1]), model()
    state, space = random_state(seed, views), photo_space(subject(), size)
    tint = torch.tensor(rng.uniform(0.7, 1.2, (len(face.colors.names), 3)), dtype=torch.float32).log()
    lamps = [torch.tensor(lamp or DARK)] * views
    truth = Unknowns.from_state(state, [random_light(rng) for _ in range(views)], tint, lamps)
    blank = LandmarkFit(subject(), [np.zeros((68, 2))] * views, [space] * views, Priors())
    landmarks = blank.landmarks(state)
    images, shades = [], []
    for view in range(views):
        camera = single(space.camera(torch.as_tensor(state.poses[view])))
        sliders = torch.as_tensor(subject().slider_values(state.shares), dtype=torch.float32)
        weights = torch.as_tensor(subject().shape_weights(state.expressions[view]), dtype=torch.float32)
        with torch.no_grad():
            points = face.rig(sliders, weights)
            shade = Shadows.from_lamp(face, points, camera, lamps[view]) if shadows or lamp else None
            look = Look(
                camera=camera,
                light=truth.light[view].detach(),
                background=torch.full((3,), 0.2),
                tint=tint.exp(),
                shadow=shade and shade.transfer,
                key=shade and KeyLight(numbers=lamps[view], arriving=shade.arriving),
            )
            image = to_srgb(face.image(points, look, height=size, width=size)[..., :3])
        images.append(image.numpy())
        shades.append(shade)
    return Portrait(
        truth=truth,
        state=state,
        spaces=(space,) * views,
        images=tuple(images),
        landmarks=tuple(landmarks),
        shadows=tuple(shades),
    )


def joint_loss(own: Portrait, extractors: dict[str, object] | None = None, **options: float) -> JointLoss:
    """The joint loss of those photos, with the shadows that are true."""
    wanted = PhotoFitOptions(**{"size": 128, **options})  # type: ignore[arg-type]
    fit = LandmarkFit(subject(), own.landmarks, own.spaces, priors_of(wanted))
    photos = [
        WorkingPhoto.from_photo(image, marks, wanted.size)
        for image, marks in zip(own.images, own.landmarks, strict=True)
    ]
    loss = JointLoss(model(), fit, photos, extractors or {}, wanted)  # type: ignore[arg-type]
    loss.shadows = list(own.shadows)
    return loss


def moved(at: Unknowns, name: str, change: torch.Tensor) -> Unknowns:
    """The unknowns with one of them changed, to differentiate."""
    numbers = {one: getattr(at, one).detach().clone() for one in Unknowns.__dataclass_fields__}
    numbers[name] = numbers[name] + change
    return replace(at, **{one: value.requires_grad_() for one, value in numbers.items()})
