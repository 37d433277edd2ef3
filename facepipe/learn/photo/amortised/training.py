"""Trains a network that guesses where a photo fit should start ([0180]-[0184])."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from facepipe.core.errors import InputError
from facepipe.learn.face_model import FaceModel
from facepipe.learn.one_thread import one_thread
from facepipe.learn.photo.amortised.descent import NetworkDescent
from facepipe.learn.photo.amortised.losses import PictureLoss
from facepipe.learn.photo.amortised.network import StartNetwork
from facepipe.learn.photo.amortised.pictures import HEAD, Picture
from facepipe.learn.photo.amortised.renders import Portraits
from facepipe.learn.photo.amortised.warm_up import WarmUp
from facepipe.learn.photo.landmark_rig import LandmarkRig
from facepipe.learn.photo.subject import Subject
from facepipe.parts import FaceParts
from facepipe.photo_options import PhotoFitOptions
from facepipe.start_options import StartOptions

HELD_OUT = 24  # pictures by which networks are judged, of few a quarter


@dataclass(frozen=True, kw_only=True)
class Trained:
    """A network, and what it is worth on pictures that it has not seen."""

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
    # A step has to be quick, and light is found for each guess: its hue says nothing of the guess.
    terms = PhotoFitOptions(content=0.0, identity=0.0, attributes=0.0, hue=0.0)
    with one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        model, landmarks = FaceModel(parts, largest_texture=HEAD), LandmarkRig.of(subject)
        portraits = Portraits(subject, model, landmarks)
        renders = _renders(portraits, options, done)
        learnt, judged = _parted(photos or renders, options.seed)
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


def _renders(portraits: Portraits, options: StartOptions, done: Callable[[], object]) -> list[Picture]:
    """Each the same however many there are."""
    pictures = []
    for number in range(options.renders):
        pictures.append(portraits.picture(np.random.default_rng([options.seed, 1, number])))
        done()
    return pictures


def _parted(pictures: Sequence[Picture], seed: int) -> tuple[list[Picture], list[Picture]]:
    """To learn from, and to judge by."""
    judged = min(HELD_OUT, len(pictures) // 4)
    if not judged:
        raise InputError("training", f"{len(pictures)} pictures, expected 4 or more (photos, or renders)")
    order = np.random.default_rng([seed, 0]).permutation(len(pictures))
    return [pictures[i] for i in order[judged:]], [pictures[i] for i in order[:judged]]
