"""Options of what rebuild does, stage by stage."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from facepipe.geometry.example_rigging import SplitOptions
from facepipe.geometry.registration import RegistrationOptions
from facepipe.options import check_ranges

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}  # mm


@dataclass(frozen=True, kw_only=True)
class FitNeutralOptions:
    """How a neutral is fitted.

    :raises InputError: a number out of range
    """

    unit: Literal["auto", "mm", "cm", "m", "in"] = field(
        default="auto",
        metadata={
            "help": "unit of the scan: auto fits the size with the rest, a unit holds it",
            "choices": ("auto", *UNITS),
        },
    )
    prior: float = field(
        default=0.03,
        metadata={
            "help": "weight of the squared identity coefficients, in standard deviations, against the scan",
            "range": (1e-6, 1e9),
        },
    )
    membrane: float = field(
        default=6.0,
        metadata={"help": "stiffness of what the identity model can't show", "range": (1e-6, 1e9)},
    )
    landmark_sigma_mm: float = field(
        default=0.16,
        metadata={"help": "smaller ones hold landmarks harder against the surface", "unit": "mm", "range": (1e-3, 1e3)},
    )
    reach_mm: float = field(
        default=4.0,
        metadata={"help": "points further from the scan don't follow it", "unit": "mm", "range": (0.1, 1e3)},
    )
    weight_sigma: float = field(
        default=0.05,
        metadata={
            "help": "how far the weight of a shape that the scan shows may be from the given one",
            "range": (1e-3, 10.0),
        },
    )

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def registration(self) -> RegistrationOptions:
        """The same for the solver."""
        return RegistrationOptions(
            membrane=self.membrane,
            anchor_sigma_mm=self.landmark_sigma_mm,
            reach_mm=self.reach_mm,
            scale=self.unit == "auto",
        )


@dataclass(frozen=True, kw_only=True)
class RefineNeutralOptions:
    """How a neutral is refined.

    :raises InputError: a number out of range
    """

    detail_mm: float = field(
        default=10.0,
        metadata={
            "help": "waves of this length in the scan are followed by half, shorter ones less",
            "unit": "mm",
            "range": (0.1, 1e3),
        },
    )
    drift_mm: float = field(
        default=5.0,
        metadata={
            "help": "how far points may be off along the surface: smaller ones keep them where they are",
            "unit": "mm",
            "range": (1e-3, 1e3),
        },
    )
    landmark_sigma_mm: float = field(
        default=0.3,
        metadata={"help": "smaller ones hold landmarks harder against the surface", "unit": "mm", "range": (1e-3, 1e3)},
    )
    reach_mm: float = field(
        default=4.0,
        metadata={"help": "points further from the scan don't follow it", "unit": "mm", "range": (0.1, 1e3)},
    )

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class PersonalTemplateOptions:
    """Where starting shapes come from.

    :raises InputError: none of the choices
    """

    shapes_from: Literal["auto", "database", "template"] = field(
        default="auto",
        metadata={
            "help": "database: its mean person's and what its people have in common, auto where it has shapes; "
            "template: the template's own, carried over by deformation transfer",
            "choices": ("auto", "database", "template"),
        },
    )

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class RegisterScansOptions:
    """How expressions are registered.

    :raises InputError: a number out of range
    """

    weight_sigma: float = field(
        default=0.2,
        metadata={"help": "how far a shape's weight may be from the given one", "range": (1e-3, 10.0)},
    )
    variation: float = field(
        default=0.25,
        metadata={
            "help": "how far people's own motion is from the template's, as a share of it",
            "range": (1e-3, 10.0),
        },
    )
    still_mm: float = field(
        default=0.1,
        metadata={"help": "motion of what the expression does not move", "unit": "mm", "range": (1e-3, 10.0)},
    )
    membrane: float = field(
        default=3.0, metadata={"help": "stiffness of what the shapes can't show", "range": (1e-6, 1e9)}
    )
    landmark_sigma_mm: float = field(
        default=0.3,
        metadata={"help": "smaller ones hold landmarks and markers harder", "unit": "mm", "range": (1e-3, 1e3)},
    )
    reach_mm: float = field(
        default=4.0,
        metadata={"help": "points further from the scan don't follow it", "unit": "mm", "range": (0.1, 1e3)},
    )

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class SplitExpressionsOptions(SplitOptions):
    """How registered expressions are split: they lie a little worse than what `SplitOptions` expects.

    :raises InputError: a number out of range
    """

    noise: float = field(default=0.2, metadata=dict(SplitOptions.__dataclass_fields__["noise"].metadata))
