"""Trains a network that guesses where a photo fit should start ([0180]-[0184]).

It learns from people whose parameters are known first, then from the joint loss of pictures.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from facepipe.core.errors import FitError, InputError
from facepipe.geometry.face_crops import face_crop, to_crop
from facepipe.parts import FaceParts
from facepipe.photo.amortised.network import (
    KIND,
    MEAN,
    POSE_MEAN,
    POSE_STD,
    SIZE,
    STD,
    Output,
    StartNetwork,
    controls,
    held,
    short,
)
from facepipe.photo.amortised.pictures import (
    HEAD,
    Crop,
    CropSpace,
    People,
    Picture,
    Portraits,
    batch,
    noisy_landmarks,
    random_people,
    varied,
)
from facepipe.photo.descent.descent import Unknowns
from facepipe.photo.descent.fit import pose_space, priors_of
from facepipe.photo.descent.joint_loss import JointLoss, single
from facepipe.photo.descent.landmark_fit import LandmarkFit
from facepipe.photo.descent.landmark_rig import CONTOUR, LandmarkRig, front_axes, landmark_points
from facepipe.photo.descent.lighting import SeenSurface, relight
from facepipe.photo.descent.shadows import Shadows, shadows_of_lamp
from facepipe.photo.descent.subject import Subject
from facepipe.photo.options import BATCH, JOINT_BATCH, LANDMARK_BATCH, PhotoFitOptions, StartOptions
from facepipe.photo.renderer.face_model import FaceModel
from facepipe.photo.renderer.light import DARK, basis
from facepipe.rig.torch.one_thread import one_thread
from facepipe.rig.torch.rig import DifferentiableRig

_SHARES, _EXPRESSIONS, _POSE = 0.1, 0.3, 0.03  # weights of parameters, beside pixels
_OUTSIDE = 1.0  # of squares beyond 0..1
_POINTS = 400  # of the front of the face
_RATE, _DECAY, _STEEPEST = 2e-3, 1e-4, 5.0
_JOINT_RATE, _SLOWEST, _JOINT_STEEPEST = 5e-4, 0.1, 20.0
_CHECK = 25  # steps between two looks at the held-out pictures
_NOT_FINITE = "the joint loss was not finite at step {}: the best network of the steps before is kept"
_CONVENTIONS = {
    "image": "(b, 3, size, size) RGB, sRGB 0..1 less mean over std, the crop 'face' by the 68 landmarks",
    "landmarks": "(b, 68, 2) x right, y down, in sides of the crop from its top left corner",
    "shares": "0..1 of the sliders' ranges, in their order",
    "expressions": "weights 0..1 of the expressions, in their order",
    "pose": "rotation vector (3, radians) from facing the viewer, along the line of sight; middle of the head (2) and "
    "logarithm of its size in sides of the crop; logarithm of its distance in head heights",
}
HELD_OUT = 24  # pictures by which networks are judged, of few a quarter


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
        marks, _ = landmark_points(subject.parts)
        z = front_axes(subject.parts, subject.rig)[2]
        front = np.flatnonzero(z > z[marks[CONTOUR]].mean())
        chosen = np.unique(np.concatenate([marks, front[:: max(1, len(front) // _POINTS)]]))
        parts = subject.parts
        self._rig = DifferentiableRig(subject.rig.part(chosen), parts.sliders, network=parts.slider_network)
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
        # in harmonics, and a lamp where one is known: to look for it takes longer than all else
        lamp, photo = None if picture.truth is None else picture.truth.lamp, loss.photos[0]
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
        return loss(replace(at, light=light[None, :9], key=key[None], tint=tint.log()))


class WarmUp:
    """Adam on the distance from the truth, its rate rising and falling once in each part."""

    def __init__(self, network: StartNetwork, portraits: Portraits, sigma: float, options: StartOptions) -> None:
        """:param sigma: noise of landmarks, of the distance of the outer eye corners"""
        self._network, self._portraits, self._sigma, self._options = network, portraits, sigma, options
        self._loss = TaughtLoss(portraits.subject)
        self._rng = np.random.default_rng([options.seed, 2])

    def landmarks(self, done: Callable[[], object]) -> None:
        """From the landmarks of ever new people alone: nothing has to be rendered for it."""
        self._descend(self._options.landmark_batches, self._people, done)

    def renders(self, renders: Sequence[Picture], done: Callable[[], object]) -> None:
        """From pictures and landmarks together."""
        waiting: list[int] = []

        def example() -> tuple[Tensor, Tensor, Taught]:
            """A batch of pictures; each render comes once in a round."""
            while len(waiting) < BATCH:
                waiting.extend(self._rng.permutation(len(renders)).tolist())
            chosen = [renders[i] for i in waiting[:BATCH]]
            del waiting[:BATCH]
            crops = [one.crop(noisy_landmarks(one.landmarks, self._sigma, self._rng)) for one in chosen]
            truths = [one.truth for one in chosen if one.truth is not None]
            people = People(
                shares=np.stack([truth.shares for truth in truths]),
                expressions=np.stack([truth.expressions for truth in truths]),
                poses=np.stack([truth.pose for truth in truths]),
            )
            matrices, up_axis = np.stack([crop.matrix for crop in crops]), self._portraits.subject.parts.up_axis
            space = CropSpace(space=self._portraits.space, crop=matrices, side=SIZE, up_axis=up_axis)
            images, marks = batch(crops)
            return varied(images, self._rng), marks, Taught.from_people(people, space)

        self._descend(self._options.batches, example, done)

    def _descend(
        self, steps: int, example: Callable[[], tuple[Tensor | None, Tensor, Taught]], done: Callable[[], object]
    ) -> None:
        if not steps:
            return
        network = self._network.train()
        optimiser = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=_DECAY)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, _RATE, total_steps=steps + 1, pct_start=0.1)
        for step in range(steps):
            images, marks, right = example()
            loss = self._loss(network(images, marks), right)
            if not bool(loss.detach().isfinite()):
                raise FitError("training", f"a loss that is not finite in batch {step}, expected a number")
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), _STEEPEST)
            optimiser.step()
            schedule.step()
            done()
        network.eval()

    def _people(self) -> tuple[None, Tensor, Taught]:
        subject, space, rng = self._portraits.subject, self._portraits.space, self._rng
        people = random_people(subject, space, LANDMARK_BATCH, rng)
        marks = [noisy_landmarks(one, self._sigma, rng) for one in self._portraits.marks(people)]
        matrices = np.stack([face_crop(mark, SIZE) for mark in marks])
        places = np.stack([to_crop(*one) for one in zip(marks, matrices, strict=True)]) / SIZE
        crops = CropSpace(space=space, crop=matrices, side=SIZE, up_axis=subject.parts.up_axis)
        return None, torch.as_tensor(places, dtype=torch.float32), Taught.from_people(people, crops)


class NetworkDescent:
    """A network, and its best state by pictures that it does not learn from."""

    def __init__(self, network: StartNetwork, loss: PictureLoss, judged: Sequence[Picture], seed: int) -> None:
        self.network, self.best = network, dict[str, float]()
        self._loss = loss
        rng = np.random.default_rng([seed, 4])
        self._marks = [noisy_landmarks(one.landmarks, loss.options.landmark_sigma, rng) for one in judged]
        self._judged = judged
        self._state = copy.deepcopy(network.state_dict())
        self.judge()

    def judge(self) -> None:
        """Look at the held-out pictures; the network with the least joint loss is kept."""
        crops = [one.crop(marks) for one, marks in zip(self._judged, self._marks, strict=True)]
        network = self.network.eval()
        with torch.no_grad():
            found = network(*batch(crops))
            views = enumerate(zip(self._judged, crops, self._marks, strict=True))
            rows = [self._loss(*view, row(found, i)) for i, view in views]
        terms = {name: float(np.mean([float(one[name]) for one in rows])) for name in rows[0]}
        if math.isfinite(terms["total"]) and (not self.best or terms["total"] < self.best["total"]):
            self.best, self._state = terms, copy.deepcopy(network.state_dict())

    def keep_best(self) -> StartNetwork:
        """The network, back in its best state."""
        self.network.load_state_dict(self._state)
        self.network.eval()
        return self.network

    def descend(
        self, pictures: Sequence[Picture], options: StartOptions, done: Callable[[], object]
    ) -> tuple[str, ...]:
        """Adam from the best so far, normalisation held; a loss that is not finite ends it with a warning."""
        network, rng = self.keep_best(), np.random.default_rng([options.seed, 3])
        optimiser = torch.optim.Adam(network.parameters(), lr=_JOINT_RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(options.steps, 1), _SLOWEST * _JOINT_RATE)
        for step in range(options.steps):
            optimiser.zero_grad()
            chosen = [pictures[i] for i in rng.integers(len(pictures), size=JOINT_BATCH)]
            marks = [noisy_landmarks(one.landmarks, self._loss.options.landmark_sigma, rng) for one in chosen]
            crops = [picture.crop(each) for picture, each in zip(chosen, marks, strict=True)]
            images, places = batch(crops)
            outputs = network(varied(images, rng), places)
            leaves = Output(*(output.detach().requires_grad_() for output in outputs))
            # squares of what is beyond 0..1, mean over the crops: keeps cut values from drifting away
            values = torch.cat([leaves.shares, leaves.expressions], dim=1)
            (_OUTSIDE * ((values - values.clamp(0, 1)) ** 2).sum(dim=1).mean()).backward()
            # picture by picture: the graphs of all at once would take their memory together
            for i, view in enumerate(zip(chosen, crops, marks, strict=True)):
                loss = self._loss(*view, row(leaves, i))["total"] / len(chosen)
                if not bool(loss.detach().isfinite()):
                    return (_NOT_FINITE.format(step),)
                loss.backward()
            slopes = [leaf.grad for leaf in leaves]
            if not all(slope is not None and bool(slope.isfinite().all()) for slope in slopes):
                return (_NOT_FINITE.format(step),)
            torch.autograd.backward(list(outputs), slopes)
            torch.nn.utils.clip_grad_norm_(network.parameters(), _JOINT_STEEPEST)
            optimiser.step()
            schedule.step()
            done()
            if (step + 1) % _CHECK == 0 or step + 1 == options.steps:
                self.judge()
        return ()


def row(found: Output, number: int) -> Output:
    """The guess for one of a batch, as a batch of one."""
    return Output(*(one[number : number + 1] for one in found))


@dataclass(frozen=True, kw_only=True)
class Trained:
    """A network, and how good it is on pictures that it never saw."""

    network: StartNetwork
    subject: Subject
    before: dict[str, float]  # terms of the joint loss at the defaults, means over the held-out pictures
    after: dict[str, float]
    held_out: int
    photos: int  # 0: renders alone
    warnings: tuple[str, ...] = ()


def train_start(
    parts: FaceParts,
    options: StartOptions,
    *,
    photos: Sequence[Picture] = (),
    expressions: Sequence[str] | None = None,
    done: Callable[[], object] = lambda: None,
) -> Trained:
    """A network for first guesses about photos of people as the face can show them.

    First it learns the parameters of random people from their landmarks and renders, then the joint loss of pictures
    without them: of photos, or where there are none of the renders. On one thread, so that the same call gives the
    same network.

    :param photos: of people; some are held out
    :param expressions: as for `fit_photos`
    :param done: called after each of `options.total`
    :raises InputError: a face without the landmarks or without sliders, or hardly any picture
    :raises FitError: a loss of renders that is not finite
    """
    subject = Subject.of(parts, expressions)
    # a step has to be quick, and light is found for each guess: its hue says nothing of the guess.
    terms = PhotoFitOptions(content=0.0, identity=0.0, attributes=0.0, hue=0.0)
    with one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        model, landmarks = FaceModel(parts, largest_texture=HEAD), LandmarkRig.from_subject(subject)
        portraits = Portraits(subject, model, landmarks)
        renders = []
        for number in range(options.renders):  # each the same however many there are
            renders.append(portraits.picture(np.random.default_rng([options.seed, 1, number])))
            done()
        pictures = photos or renders
        count = min(HELD_OUT, len(pictures) // 4)
        if not count:
            raise InputError("training", f"{len(pictures)} pictures, expected 4 or more (photos, or renders)")
        order = np.random.default_rng([options.seed, 0]).permutation(len(pictures))
        learnt, judged = [pictures[i] for i in order[count:]], [pictures[i] for i in order[:count]]
        network = StartNetwork(torch.as_tensor(subject.default_shares, dtype=torch.float32), len(subject.expressions))
        network = network.to(memory_format=torch.channels_last)
        descent = NetworkDescent(network, PictureLoss(subject, model, landmarks, terms), judged, options.seed)
        before = descent.best
        warm_up = WarmUp(network, portraits, terms.landmark_sigma, options)
        warm_up.landmarks(done)
        warm_up.renders(renders if photos else learnt, done)
        descent.judge()
        warnings = descent.descend(learnt, options, done)
    return Trained(
        network=descent.keep_best(),
        subject=subject,
        before=before,
        after=descent.best,
        held_out=len(judged),
        photos=len(photos),
        warnings=warnings,
    )


def start_metadata(trained: Trained, options: StartOptions) -> dict[str, Any]:
    """As JSON; how it was trained without the names of files."""
    flags = {name: getattr(options, name) for name in ("people", "renders", "epochs", "steps", "seed")}
    photos = f"{trained.photos} photos without labels, after " if trained.photos else ""
    images = "--images DIR " if trained.photos else ""
    return {
        "kind": KIND,
        "face": trained.subject.parts.name,
        **controls(trained.subject),
        "size": SIZE,
        "crop": "face",
        "mean": [MEAN] * 3,
        "std": [STD] * 3,
        "order": "RGB",
        "conventions": _CONVENTIONS,
        "trained_on": f"{photos}{options.renders} renders of FACE",
        "training": f"facepipe train-photo FACE -o OUT {images}"
        + " ".join(f"--{name} {value}" for name, value in flags.items()),
        **flags,
        "held_out": {
            "pictures": trained.held_out,
            "before": {name: short(value) for name, value in trained.before.items()},
            "after": {name: short(value) for name, value in trained.after.items()},
        },
    }
