"""A network that descends on the joint loss of pictures without labels ([0182]-[0183])."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch

from facepipe.learn.photo.amortised.losses import PictureLoss, outside
from facepipe.learn.photo.amortised.network import Output, StartNetwork
from facepipe.learn.photo.amortised.pictures import Picture
from facepipe.learn.photo.amortised.varied import batch, noisy_landmarks, varied
from facepipe.start_options import JOINT_BATCH, StartOptions

_RATE, _SLOWEST, _STEEPEST = 5e-4, 0.1, 20.0
_CHECK = 25  # steps between two looks at the held-out pictures
_NOT_FINITE = "the joint loss was not finite at step {}: the best network of the steps before is kept"


class NetworkDescent:
    """A network, and its best state by pictures that it does not learn from."""

    def __init__(self, network: StartNetwork, loss: PictureLoss, judged: Sequence[Picture], seed: int) -> None:
        self.network, self.best = network, dict[str, float]()
        self._loss = loss
        rng = np.random.default_rng([seed, 4])
        self._marks = [noisy_landmarks(one, loss.options.landmark_sigma, rng) for one in judged]
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
        self,
        pictures: Sequence[Picture],
        options: StartOptions,
        done: Callable[[], object],
    ) -> tuple[str, ...]:
        """Adam from the best so far, normalisation held; a loss that is not finite ends it with a warning."""
        network, rng = self.keep_best(), np.random.default_rng([options.seed, 3])
        optimiser = torch.optim.Adam(network.parameters(), lr=_RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(options.steps, 1), _SLOWEST * _RATE)
        for step in range(options.steps):
            optimiser.zero_grad()
            if not self._slopes([pictures[i] for i in rng.integers(len(pictures), size=JOINT_BATCH)], rng):
                return (_NOT_FINITE.format(step),)
            torch.nn.utils.clip_grad_norm_(network.parameters(), _STEEPEST)
            optimiser.step()
            schedule.step()
            done()
            if (step + 1) % _CHECK == 0 or step + 1 == options.steps:
                self.judge()
        return ()

    def _slopes(self, pictures: Sequence[Picture], rng: np.random.Generator) -> bool:
        """Add the gradients of the mean joint loss to the network's, picture by picture; whether they are finite."""
        marks = [noisy_landmarks(one, self._loss.options.landmark_sigma, rng) for one in pictures]
        crops = [picture.crop(each) for picture, each in zip(pictures, marks, strict=True)]
        images, places = batch(crops)
        found = self.network(varied(images, rng), places)
        leaves = Output(*(one.detach().requires_grad_() for one in found))
        outside(leaves).backward()
        for i, view in enumerate(zip(pictures, crops, marks, strict=True)):
            loss = self._loss(*view, row(leaves, i))["total"] / len(pictures)
            if not bool(loss.detach().isfinite()):
                return False
            loss.backward()
        slopes = [one.grad for one in leaves]
        if not all(one is not None and bool(one.isfinite().all()) for one in slopes):
            return False
        torch.autograd.backward(list(found), slopes)
        return True


def row(found: Output, number: int) -> Output:
    """The guess for one of a batch, as a batch of one."""
    return Output(*(one[number : number + 1] for one in found))
