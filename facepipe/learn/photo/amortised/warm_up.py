"""What a network learns from people whose parameters are known, before it looks at a joint loss."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import FitError
from facepipe.geometry.landmarks import eye_distance
from facepipe.learn.features.crops import face_crop, to_crop
from facepipe.learn.photo.amortised.losses import Taught, TaughtLoss
from facepipe.learn.photo.amortised.network import SIZE, StartNetwork
from facepipe.learn.photo.amortised.people import People, random_people
from facepipe.learn.photo.amortised.pictures import Picture
from facepipe.learn.photo.amortised.pose import CropSpace
from facepipe.learn.photo.amortised.renders import Portraits
from facepipe.learn.photo.amortised.varied import batch, noisy_landmarks, varied
from facepipe.start_options import BATCH, LANDMARK_BATCH, StartOptions

_RATE, _DECAY, _STEEPEST = 2e-3, 1e-4, 5.0


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
        batches = self._batches(renders)
        self._descend(self._options.batches, lambda: self._pictures(next(batches)), done)

    def _batches(self, renders: Sequence[Picture]) -> Iterator[list[Picture]]:
        """Endless, each render once in a round."""
        waiting: list[int] = []
        while renders:
            while len(waiting) < BATCH:
                waiting += self._rng.permutation(len(renders)).tolist()
            yield [renders[i] for i in waiting[:BATCH]]
            waiting = waiting[BATCH:]

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
        exact = self._portraits.marks(people)
        marks = np.stack([one + self._noise(one) for one in exact])
        matrices = np.stack([face_crop(one, SIZE) for one in marks])
        places = np.stack([to_crop(*one) for one in zip(marks, matrices, strict=True)]) / SIZE
        crops = CropSpace(space=space, crop=matrices, side=SIZE, up_axis=subject.parts.up_axis)
        return None, torch.as_tensor(places, dtype=torch.float32), Taught.of(people, crops)

    def _noise(self, marks: FloatArray) -> FloatArray:
        return np.asarray(
            self._sigma * self._rng.uniform() * eye_distance(marks) * self._rng.standard_normal(marks.shape)
        )

    def _pictures(self, chosen: Sequence[Picture]) -> tuple[Tensor, Tensor, Taught]:
        crops = [one.crop(noisy_landmarks(one, self._sigma, self._rng)) for one in chosen]
        truths = [one.truth for one in chosen if one.truth is not None]
        people = People(
            shares=np.stack([one.shares for one in truths]),
            expressions=np.stack([one.expressions for one in truths]),
            poses=np.stack([one.pose for one in truths]),
        )
        space = CropSpace(
            space=self._portraits.space,
            crop=np.stack([one.matrix for one in crops]),
            side=SIZE,
            up_axis=self._portraits.subject.parts.up_axis,
        )
        images, marks = batch(crops)
        return varied(images, self._rng), marks, Taught.of(people, space)
