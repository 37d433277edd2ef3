"""How a face is fitted to photos, and how a network for first guesses at such fits is trained."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, Self

from facepipe.core.errors import InputError
from facepipe.declare import Ranged, option

Optimiser = Literal["adam", "gradient-descent"]

# option of a network -> kind of features, and the weight of their term
MODELS: Final[Mapping[str, Literal["content", "identity", "attributes"]]] = {
    "content_model": "content",
    "identity_model": "identity",
    "attribute_model": "attributes",
}

# of a step of training: landmarks of people, renders whose truth is known, pictures on the joint loss
LANDMARK_BATCH, BATCH, JOINT_BATCH = 256, 32, 8

# What facepipe's own network says of identity and attributes is void: it takes portraits of two people for one at an
# equal error rate of 39 to 43 %, and attributes that it finds are no nearer than the mean. Networks of others do know.
_WEIGHT = 0.02
_BY_NETWORK = f"default {_WEIGHT} with a network of yours, else 0"


@dataclass(frozen=True, kw_only=True)
class PhotoTermOptions(Ranged):
    """Steps, weights of the terms of the joint loss ([0166]) but for the landmarks, and how likely values are.

    A weight of 0 switches a term off; networks whose terms are off are not run.
    """

    iterations: int = option(45, "steps of gradient descent; 0: landmarks alone", 0, 100_000)
    loss_threshold: float = option(0.0, "stop once the joint loss is below this", 0.0, 1e9)
    optimiser: Optimiser = option("adam", "adam, or plain gradient descent", choices=("adam", "gradient-descent"))
    rate: float = option(0.04, "size of a step, of a slider's range (adam), or per slope (plain)", 1e-9, 1e3)
    size: int = option(192, "pixels a side that image terms see of the head", 64, 1024)
    # neighbouring pixels show the same thing, and must not count for more than how likely a person is
    color: float = option(6.0, "weight of the colours of the pixels", 0.0, 1e6)
    content: float = option(0.1, "weight of features and semantics", 0.0, 1e6)
    identity: float | None = option(None, f"weight of the identity ({_BY_NETWORK})", 0.0, 1e6)
    attributes: float | None = option(None, f"weight of the attributes ({_BY_NETWORK})", 0.0, 1e6)
    sparsity: float = option(0.02, "weight of the sliders' distance from their defaults", 0.0, 1e6)
    expression_sparsity: float = option(0.1, "weight of the expressions", 0.0, 1e6)
    hue: float = option(10.0, "weight of the difference in hue between the key light and the light around it", 0.0, 1e6)
    landmark_sigma: float = option(
        0.02, "expected landmark error, as a share of the distance of the outer eye corners", 1e-4, 1.0
    )
    focal_sigma: float = option(
        0.2, "spread of the focal length around a portrait lens, as a natural logarithm", 1e-3, 10
    )

    def with_networks(self, given: Collection[str]) -> Self:
        """The options with weights for the terms that are void without a network of the user's.

        :param given: kinds of features that there is such a network for
        """

        def weight(kind: str, own: float | None) -> float:
            return _WEIGHT * (kind in given) if own is None else own

        return replace(
            self, identity=weight("identity", self.identity), attributes=weight("attributes", self.attributes)
        )


@dataclass(frozen=True, kw_only=True)
class LikenessOptions(Ranged):
    """What a network that judges likeness is asked for."""

    similarity_threshold: float | None = option(
        None,
        "similarity of each photo and the render of it to --identity-model (cosine), below which the exit code is 1",
        -1.0,
        1.0,
        metavar="COSINE",
    )

    def check_judge(self, model: Path | None) -> None:
        """:raises InputError: a threshold without a network"""
        if self.similarity_threshold is not None and model is None:
            raise InputError("--similarity-threshold", "given without --identity-model, expected a network that judges")

    def unlike(self, similarities: Mapping[str, float | None]) -> list[str]:
        """A line for each photo that the face is less like than the threshold."""
        least = self.similarity_threshold
        return [
            f"{name}: similarity of {'no number' if value is None else f'{value:.3f}'}, expected at least {least:g}"
            for name, value in similarities.items()
            if least is not None and (value is None or value < least)
        ]


@dataclass(frozen=True, kw_only=True)
class PhotoFitOptions(PhotoTermOptions):
    """How a face is fitted to photos and their landmarks."""

    landmarks: float = option(1.0, "weight of the landmarks", 0.0, 1e6)


@dataclass(frozen=True, kw_only=True)
class StartOptions(Ranged):
    """How long a network for first guesses is trained, and on what."""

    people: int = option(100_000, "random people to learn from first, by their landmarks alone", 0, 100_000_000)
    renders: int = option(2000, "random renders of FACE with known parameters", 0, 200_000)
    epochs: int = option(4, "passes over these renders", 0, 1000)
    steps: int = option(400, f"steps on the joint loss after that, with {JOINT_BATCH} pictures each", 0, 1_000_000)
    seed: int = option(0, "seed of people, initial weights and order", 0, 2**31 - 1)

    @property
    def landmark_batches(self) -> int:
        """Steps on landmarks alone."""
        return math.ceil(self.people / LANDMARK_BATCH)

    @property
    def batches(self) -> int:
        """Steps on renders."""
        return self.epochs * math.ceil(self.renders / BATCH)

    @property
    def total(self) -> int:
        """Renders, batches and steps, as they are counted while they are made."""
        return self.renders + self.landmark_batches + self.batches + self.steps
