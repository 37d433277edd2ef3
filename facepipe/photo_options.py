"""How a face is fitted to photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from facepipe.options import check_ranges

Optimiser = Literal["adam", "gradient-descent"]

# option of a network -> kind of features, and the weight of their term
MODELS: Final[Mapping[str, Literal["content", "identity", "attributes"]]] = {
    "content_model": "content",
    "identity_model": "identity",
    "attribute_model": "attributes",
}


@dataclass(frozen=True, kw_only=True)
class PhotoFitOptions:
    """Steps, weights of the terms of the joint loss ([0166]) and what is likely.

    A weight of 0 switches a term off; networks whose terms are off are not run.

    :raises InputError: a number out of range
    """

    iterations: int = field(
        default=200, metadata={"help": "steps of gradient descent; 0: landmarks alone", "range": (0, 100_000)}
    )
    loss_threshold: float = field(
        default=0.0, metadata={"help": "stop where the joint loss is below it", "range": (0.0, 1e9)}
    )
    optimiser: Optimiser = field(
        default="adam",
        metadata={"help": "adam, or the plain descent of the document", "choices": ("adam", "gradient-descent")},
    )
    rate: float = field(
        default=0.04,
        metadata={"help": "size of a step, of a slider's range (adam), or per slope (plain)", "range": (1e-9, 1e3)},
    )
    size: int = field(
        default=256, metadata={"help": "pixels a side that image terms see of the head", "range": (64, 1024)}
    )
    landmarks: float = field(default=1.0, metadata={"help": "weight of the landmarks", "range": (0.0, 1e6)})
    color: float = field(default=60.0, metadata={"help": "weight of the colours of the pixels", "range": (0.0, 1e6)})
    content: float = field(default=1.0, metadata={"help": "weight of features and semantics", "range": (0.0, 1e6)})
    identity: float = field(default=0.2, metadata={"help": "weight of the identity", "range": (0.0, 1e6)})
    attributes: float = field(default=0.0, metadata={"help": "weight of the attributes", "range": (0.0, 1e6)})
    sparsity: float = field(
        default=0.043, metadata={"help": "weight of the sliders' distance from their defaults", "range": (0.0, 1e6)}
    )
    expression_sparsity: float = field(default=0.1, metadata={"help": "weight of the expressions", "range": (0.0, 1e6)})
    hue: float = field(
        default=10.0,
        metadata={"help": "weight of another hue of the key light than around it", "range": (0.0, 1e6)},
    )
    landmark_sigma: float = field(
        default=0.02,
        metadata={"help": "how far landmarks are off, of the distance of the outer eye corners", "range": (1e-4, 1.0)},
    )
    focal_sigma: float = field(
        default=0.35,
        metadata={"help": "how far the focal length may be from a portrait lens, as a logarithm", "range": (1e-3, 10)},
    )

    def __post_init__(self) -> None:
        check_ranges(self)
