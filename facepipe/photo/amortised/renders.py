"""Random renders of a face: pictures of people whose sliders, expressions and poses are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from facepipe.core.arrays import FloatArray
from facepipe.photo.amortised.pictures import HEAD, CropSpace, Picture, Truth
from facepipe.photo.descent.fit import pose_space
from facepipe.photo.descent.joint_loss import single
from facepipe.photo.descent.landmark_rig import LandmarkRig
from facepipe.photo.descent.shadows import shadows_of_lamp
from facepipe.photo.descent.subject import FOCAL, PoseSpace, Subject
from facepipe.photo.descent.working_photo import to_srgb
from facepipe.photo.renderer.face_model import FaceModel, Look
from facepipe.photo.renderer.light import KeyLight, ambient, distant

MOVED = (0.3, 0.9)  # share of the sliders that are not at their default
NEUTRAL, MOST_SHAPES, STRONGEST = 0.25, 6, 0.85  # people without expression, shapes of an expression, weights
BOTH_SIDES = 0.7  # expressions whose left and right go together
TURN = np.radians((13.0, 20.0, 8.0))  # standard deviations of pitch, yaw and roll; at most twice that
SHARE = (0.85, 1.15)  # of the side of the picture that a head with its neck has
OFF = 0.1  # sides of the picture that a face is off its middle at most
LENS_SPREAD = 0.4  # of the logarithm of the focal length
DIM, BRIGHT = 0.12, 1.1  # white in the ambient light, and in a lamp's


@dataclass(frozen=True, kw_only=True)
class People:
    """Parameters of n people."""

    shares: FloatArray  # (n, f)
    expressions: FloatArray  # (n, e)
    poses: FloatArray  # (n, 7) as `PoseSpace`


def random_people(subject: Subject, space: PoseSpace, count: int, rng: np.random.Generator) -> People:
    """So many people, one a picture of that space."""
    default = subject.default_shares
    moved = rng.random((count, len(default))) < rng.uniform(*MOVED, (count, 1))
    shares = np.where(moved, rng.random(moved.shape), default)
    shapes = [subject.rig.shapes[i] for i in subject.expressions]
    other = {i: shapes.index(_mirrored(one)) for i, one in enumerate(shapes) if _mirrored(one) in shapes}
    expressions = np.zeros((count, len(shapes)))
    for weights in expressions:
        if not shapes or rng.random() < NEUTRAL:
            continue
        for shape in rng.permutation(len(shapes))[: rng.integers(1, MOST_SHAPES + 1)]:
            weights[shape] = rng.uniform(0.05, STRONGEST)
            if shape in other and rng.random() < BOTH_SIDES:
                weights[other[int(shape)]] = min(weights[shape] * rng.uniform(0.85, 1.15), STRONGEST)
    share = rng.uniform(*SHARE, (count, 1))
    log_focal = np.log(FOCAL) + LENS_SPREAD * rng.standard_normal((count, 1))
    turn = TURN * rng.standard_normal((count, 3)).clip(-2, 2)
    place = 0.5 + rng.uniform(-OFF, OFF, (count, 2))
    relative = np.concatenate([turn, place, np.log(share), log_focal - np.log(share)], axis=1)
    whole = CropSpace(space=space, crop=np.eye(2, 3), side=round(space.side), up_axis=subject.parts.up_axis)
    poses = np.asarray(whole.to_photo(torch.as_tensor(relative)).numpy())
    return People(shares=shares, expressions=expressions, poses=poses)


def _mirrored(name: str) -> str:
    """The name of the other side's shape; of others nothing that is one."""
    for one, other in (("Left", "Right"), ("Right", "Left")):
        if name.endswith(one):
            return name.removesuffix(one) + other
    return ""


class Portraits:
    """Draws people, and photographs them."""

    def __init__(self, subject: Subject, model: FaceModel, landmarks: LandmarkRig) -> None:
        self.subject, self.model, self.landmarks = subject, model, landmarks
        self.space = pose_space(subject, HEAD, HEAD)

    def picture(self, rng: np.random.Generator) -> Picture:
        """Somebody, somewhere."""
        person = random_people(self.subject, self.space, 1, rng)
        # (8,) as `KeyLight`: a lamp before the face
        color = rng.uniform(0.3, BRIGHT) * rng.uniform(0.8, 1.2, 3)
        shine, exponent = rng.uniform(0.2, 1.2), rng.uniform(2.0, 4.5)
        lamp = torch.as_tensor(np.array([*_way(rng, 75), *color, shine, exponent]), dtype=torch.float32)
        truth = Truth(shares=person.shares[0], expressions=person.expressions[0], pose=person.poses[0], lamp=lamp)
        sliders = torch.as_tensor(self.subject.slider_values(truth.shares), dtype=torch.float32)
        weights = torch.as_tensor(self.subject.shape_weights(truth.expressions), dtype=torch.float32)
        camera = single(self.space.camera(torch.as_tensor(truth.pose)))
        with torch.no_grad():
            points = self.model.rig(sliders, weights)
            arriving = shadows_of_lamp(self.model, points, camera, lamp)
            light, background = random_light(rng), random_background(rng, HEAD)
            # (materials, 3): dark to light, warm to cold, and each material a little apart
            materials = len(self.model.colors.names)
            common = np.exp(rng.uniform(-1.5, 0.3) + rng.normal(0, 0.12, 3))
            own = np.exp(rng.normal(0, 0.5, (materials, 1)) + rng.normal(0, 0.1, (materials, 3)))
            look = Look(
                camera=camera,
                light=light,
                key=KeyLight(numbers=lamp, arriving=arriving),
                background=background,
                tint=torch.as_tensor((common * own).clip(0.02, 3.0), dtype=torch.float32),
            )
            image = to_srgb(self.model.image(points, look, height=HEAD, width=HEAD)[..., :3])
        return Picture(
            pixels=(image * 255).round().to(torch.uint8).numpy(),
            left=0,
            top=0,
            step=1,
            landmarks=self.marks(person)[0],
            space=self.space,
            truth=truth,
        )

    def marks(self, people: People) -> FloatArray:
        """(n, 68, 2) where their landmarks are."""
        with torch.no_grad():
            sliders = torch.as_tensor(self.subject.slider_values(people.shares))
            weights = torch.as_tensor(self.subject.shape_weights(people.expressions))
            points = self.landmarks.rig(sliders, weights)
            marks, _ = self.landmarks.landmarks(points, self.space.camera(torch.as_tensor(people.poses)))
        return np.asarray(marks.numpy())


def random_light(rng: np.random.Generator) -> Tensor:
    """(9, 3) spherical harmonics of a dim room with up to two lamps from anywhere."""
    light = ambient(torch.as_tensor(rng.uniform(DIM, 0.5) * rng.uniform(0.85, 1.15, 3), dtype=torch.float32))
    for _ in range(rng.integers(0, 3)):
        way, color = _way(rng, 170), rng.uniform(0.05, 0.5) * rng.uniform(0.8, 1.2, 3)
        light = light + distant(*(torch.as_tensor(one, dtype=torch.float32) for one in (way, color)))
    return light


def _way(rng: np.random.Generator, around: float) -> FloatArray:
    """(3,) unit, to a lamp up to this many degrees to a side of the camera, mostly above it."""
    turn, up = np.radians(rng.uniform(-around, around)), np.radians(rng.uniform(-15, 60))
    return np.array([np.sin(turn) * np.cos(up), np.sin(up), np.cos(turn) * np.cos(up)])


def random_background(rng: np.random.Generator, size: int) -> Tensor:
    """(size, size, 3) linear: plain, blotted, or with rectangles too."""
    color = rng.uniform(0.02, 0.8) * rng.uniform(0.7, 1.3, 3)
    image = torch.as_tensor(color, dtype=torch.float32).expand(size, size, 3).clone()
    if rng.random() < 0.7:
        for cells, strength in ((3, 0.5), (12, 0.25)):
            noise = torch.as_tensor(rng.normal(0, strength, (1, 3, cells, cells)), dtype=torch.float32)
            noise = functional.interpolate(noise, (size, size), mode="bilinear", align_corners=False)
            image = image * noise[0].permute(1, 2, 0).exp()
    for _ in range(rng.integers(0, 6) if rng.random() < 0.4 else 0):
        top, left = rng.integers(0, size, 2)
        height, width = rng.integers(size // 16, size // 2, 2)
        image[top : top + height, left : left + width] = torch.as_tensor(rng.uniform(0.01, 0.9, 3), dtype=torch.float32)
    return image.clamp(0, 1)
