"""What training lowers: how far guesses are from the truth where it is known, and their joint loss."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from facepipe.core.arrays import IntArray
from facepipe.photo.amortised.network import SIZE, Output, held
from facepipe.photo.amortised.pictures import Crop, Picture
from facepipe.photo.amortised.pose import CropSpace
from facepipe.photo.amortised.renders import People
from facepipe.photo.descent.descent import Unknowns
from facepipe.photo.descent.fit import pose_space, priors_of
from facepipe.photo.descent.joint_loss import JointLoss, single
from facepipe.photo.descent.landmark_fit import LandmarkFit
from facepipe.photo.descent.landmark_rig import CONTOUR, LandmarkRig, front_axes, landmark_points, part_of
from facepipe.photo.descent.lighting import relight
from facepipe.photo.descent.seen_surface import SeenSurface
from facepipe.photo.descent.shadows import Shadows, shadows_of_lamp
from facepipe.photo.descent.subject import Subject
from facepipe.photo.options import PhotoFitOptions
from facepipe.photo.renderer.face_model import FaceModel
from facepipe.photo.renderer.light import DARK, basis
from facepipe.rig.torch.rig import DifferentiableRig

POSE_MEAN = (0.0, 0.0, 0.0, 0.5, 0.485, 0.29, 0.85)  # relative to the crop
POSE_STD = (0.2, 0.35, 0.05, 0.01, 0.01, 0.03, 0.35)
_SHARES, _EXPRESSIONS, _POSE = 0.1, 0.3, 0.03  # weights of parameters, beside pixels
_OUTSIDE = 1.0  # of squares beyond 0..1
_POINTS = 400  # of the front of the face


@dataclass(frozen=True, kw_only=True)
class Taught:
    """What is right for a batch of crops."""

    shares: Tensor  # (b, f)
    expressions: Tensor  # (b, e)
    pose: Tensor  # (b, 7) in standard deviations

    @classmethod
    def from_people(cls, people: People, space: CropSpace) -> Taught:
        """For the crops of people."""
        pose = space.to_crop(torch.as_tensor(people.poses))
        scaled = (pose - pose.new_tensor(POSE_MEAN)) / pose.new_tensor(POSE_STD)
        shares, expressions = (torch.as_tensor(one, dtype=torch.float32) for one in (people.shares, people.expressions))
        return cls(shares=shares, expressions=expressions, pose=scaled.float())


class TaughtLoss:
    """How far guesses are from the truth: in pixels of the crop, over the front of the face, and in parameters."""

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        chosen = _front_points(subject)
        parts = subject.parts
        self._rig = DifferentiableRig(part_of(subject.rig, chosen), parts.sliders, network=parts.slider_network)
        space = replace(pose_space(subject, SIZE, SIZE), side=float(SIZE))
        self._crop = CropSpace(space=space, crop=np.eye(2, 3), side=SIZE, up_axis=parts.up_axis)
        self._lower, self._reach = (
            torch.as_tensor(one, dtype=torch.float32) for one in (subject.lower, subject.upper - subject.lower)
        )

    def __call__(self, guess: Output, right: Taught) -> Tensor:
        """Mean over a batch."""
        with torch.no_grad():
            there = self._places(right.shares, right.expressions, right.pose)
        off = self._places(held(guess.shares), held(guess.expressions), guess.pose) - there
        pixels = ((off * off).sum(dim=-1) + 1e-2).sqrt().mean()
        shares, expressions, pose = (
            (getattr(guess, name) - getattr(right, name)).abs().sum(dim=1).mean() for name in Output._fields
        )
        return pixels + _SHARES * shares + _EXPRESSIONS * expressions + _POSE * pose

    def _places(self, shares: Tensor, expressions: Tensor, pose: Tensor) -> Tensor:
        """(b, m, 2) pixels of the crop."""
        own = self._rig.sliders.value.expand(len(shares), -1)
        sliders = own.index_copy(1, torch.as_tensor(self._subject.sliders), self._lower + shares * self._reach)
        weights = shares.new_zeros((len(shares), len(self._rig.shapes)))
        weights = weights.index_copy(1, torch.as_tensor(self._subject.expressions, dtype=torch.int64), expressions)
        camera = single(self._crop.space.camera(self._crop.to_photo(relative_pose(pose))))
        return camera.project(self._rig(sliders, weights))[..., :2]


def _front_points(subject: Subject) -> IntArray:
    """Points evenly over what is before the contour of the face, landmarks among them."""
    marks, _ = landmark_points(subject.parts)
    z = front_axes(subject.parts, subject.rig)[2]
    front = np.flatnonzero(z > z[marks[CONTOUR]].mean())
    return np.unique(np.concatenate([marks, front[:: max(1, len(front) // _POINTS)]]))


def outside(found: Output) -> Tensor:
    """Squares of what is beyond 0..1, mean over the crops: keeps cut values from drifting away."""
    values = torch.cat([found.shares, found.expressions], dim=1)
    return _OUTSIDE * ((values - values.clamp(0, 1)) ** 2).sum(dim=1).mean()


def relative_pose(scaled: Tensor) -> Tensor:
    """(..., 7) as `CropSpace`, in float64, of poses in standard deviations."""
    return scaled.double() * scaled.new_tensor(POSE_STD).double() + scaled.new_tensor(POSE_MEAN).double()


class PictureLoss:
    """The joint loss of a guess, in the light that suits it best."""

    def __init__(self, subject: Subject, model: FaceModel, landmarks: LandmarkRig, options: PhotoFitOptions) -> None:
        self.subject, self.model, self.landmarks, self.options = subject, model, landmarks, options

    def __call__(self, picture: Picture, crop: Crop, marks: np.ndarray, guess: Output) -> dict[str, Tensor]:
        """The terms of the joint loss of what was found (1, ...) for one picture."""
        fit = LandmarkFit(self.subject, [marks], [picture.space], priors_of(self.options), self.landmarks)
        loss = JointLoss(self.model, fit, [picture.working()], {}, self.options)
        pose = crop.space(picture.space, self.subject.parts.up_axis).to_photo(relative_pose(guess.pose))
        at = Unknowns(
            shares=held(guess.shares[0]),
            expressions=held(guess.expressions),
            poses=pose,
            light=torch.zeros((1, 9, 3)),
            key=torch.tensor([DARK]),
            tint=torch.zeros((len(self.model.colors.names), 3)),
        )
        lamp = None if picture.truth is None else picture.truth.lamp
        return loss(self._lit(loss, at, lamp))

    def _lit(self, loss: JointLoss, at: Unknowns, lamp: Tensor | None) -> Unknowns:
        """In harmonics, and a lamp where one is known: to look for it takes longer than all else."""
        photo = loss.photos[0]
        with torch.no_grad():
            points = self.model.rig(loss.sliders(at.shares), loss.weights(at.expressions[0]))
            camera = single(photo.camera(loss.fit.spaces[0].camera(at.poses[0])))
            surface = SeenSurface.from_camera(self.model, points, camera, photo.face)
            shape, key = basis(surface.normals), at.key[0]
            if lamp is not None:
                arriving = shadows_of_lamp(self.model, points, camera, lamp)
                loss.shadows[0] = Shadows(transfer=points.new_zeros((len(points), 9)), arriving=arriving)
                facing = (surface.normals @ normalize(lamp[:3], dim=0)).clamp(min=0)
                shape = torch.cat([shape, (facing * surface.at_pixels(arriving))[:, None]], dim=1)
            seen, count = photo.linear.reshape(-1, 3)[surface.raster.pixels], len(self.model.colors.names)
            light, tint = relight(surface, seen, shape, count)
            if lamp is not None:
                key = torch.cat([lamp[:3], light[9].clamp(min=0), lamp[6:]])
        return replace(at, light=light[None, :9], key=key[None], tint=tint.log())
