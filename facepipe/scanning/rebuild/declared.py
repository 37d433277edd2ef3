"""What the actions of a rebuild declare: options of each step, landmarks beside scans, reports held against limits."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

from facepipe.core.reading import file_beside
from facepipe.core.reports import Report, not_in_json
from facepipe.declare import Ranged, option
from facepipe.geometry.example_rigging import SplitOptions
from facepipe.geometry.registration import RegistrationOptions
from facepipe.kinds import StageAction

if TYPE_CHECKING:
    from facepipe.geometry.local_refinement import RefinementOptions
    from facepipe.stage import Face

J = TypeVar("J", bound="Judged")
UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}  # mm


@dataclass(frozen=True, kw_only=True)
class FitNeutralOptions(Ranged):
    """How a neutral is fitted.

    :raises InputError: a number out of range
    """

    unit: Literal["auto", "mm", "cm", "m", "in"] = option(
        "auto", "unit of the scan: auto fits the size with the rest, a unit holds it"
    )
    prior: float = option(
        0.03, "weight of the squared identity coefficients, in standard deviations, against the scan", 1e-6, 1e9
    )
    membrane: float = option(6.0, "stiffness of what the identity model can't show", 1e-6, 1e9)
    landmark_sigma_mm: float = option(0.16, "smaller ones hold landmarks harder against the surface", 1e-3, 1e3, "mm")
    reach_mm: float = option(4.0, "points further from the scan don't follow it", 0.1, 1e3, "mm")
    weight_sigma: float = option(
        0.05, "how far the weight of a shape that the scan shows may be from the given one", 1e-3, 10.0
    )

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
class RefineNeutralOptions(Ranged):
    """How a neutral is refined.

    :raises InputError: a number out of range
    """

    detail_mm: float = option(
        10.0, "waves of this length in the scan are followed by half, shorter ones less", 0.1, 1e3, "mm"
    )
    drift_mm: float = option(
        5.0, "how far points may be off along the surface: smaller ones keep them where they are", 1e-3, 1e3, "mm"
    )
    landmark_sigma_mm: float = option(0.3, "smaller ones hold landmarks harder against the surface", 1e-3, 1e3, "mm")
    reach_mm: float = option(4.0, "points further from the scan don't follow it", 0.1, 1e3, "mm")

    @property
    def refinement(self) -> RefinementOptions:
        """The same for the solver."""
        from facepipe.geometry.local_refinement import RefinementOptions

        matching = RegistrationOptions(anchor_sigma_mm=self.landmark_sigma_mm, reach_mm=self.reach_mm)
        return RefinementOptions(detail_mm=self.detail_mm, drift_mm=self.drift_mm, matching=matching)


@dataclass(frozen=True, kw_only=True)
class PersonalTemplateOptions(Ranged):
    """Where starting shapes come from.

    :raises InputError: none of the choices
    """

    shapes_from: Literal["auto", "database", "template"] = option(
        "auto",
        "database: its mean person's and what its people have in common, auto where it has shapes; "
        "template: the template's own, carried over by deformation transfer",
    )


@dataclass(frozen=True, kw_only=True)
class RegisterScansOptions(Ranged):
    """How expressions are registered.

    :raises InputError: a number out of range
    """

    weight_sigma: float = option(0.2, "how far a shape's weight may be from the given one", 1e-3, 10.0)
    variation: float = option(0.25, "how far people's own motion is from the template's, as a share of it", 1e-3, 10.0)
    still_mm: float = option(0.1, "motion of what the expression does not move", 1e-3, 10.0, "mm")
    membrane: float = option(3.0, "stiffness of what the shapes can't show", 1e-6, 1e9)
    landmark_sigma_mm: float = option(0.3, "smaller ones hold landmarks and markers harder", 1e-3, 1e3, "mm")
    reach_mm: float = option(4.0, "points further from the scan don't follow it", 0.1, 1e3, "mm")

    def registration(self, *, scale: bool) -> RegistrationOptions:
        """The same for the solver, which finds the scan's scale too or not."""
        return RegistrationOptions(
            membrane=self.membrane, anchor_sigma_mm=self.landmark_sigma_mm, reach_mm=self.reach_mm, scale=scale
        )


@dataclass(frozen=True, kw_only=True)
class SplitExpressionsOptions(SplitOptions):
    """How registered expressions are split.

    They are off by about 0.2 mm in each coordinate, and over longer distances than `noise_length`: points slide along
    the surface together. More noise stands for that: on seven simulated people errors of shapes are 0.562 of those of
    the template's with 0.6, and 0.575 with 0.2.

    :raises InputError: a number out of range
    """

    noise: float = field(default=0.6, metadata=SplitOptions.__dataclass_fields__["noise"].metadata)


@dataclass(frozen=True, kw_only=True)
class BakeScanOptions(Ranged):
    """How the colours of a scan are baked.

    :raises InputError: an option out of range
    """

    colors: bool = option(True, "give the skin's textures the scan's colours, where both have some")
    even: float = option(1.0, "how much of the light in the scan's colours is taken out; 0: as scanned", 0.0, 1.0)
    relief: bool = option(True, "give the skin's normal maps the scan's detail, where it is finer than the mesh")
    texture_size: int | None = option(
        None, "size of the skin's textures (default that of the template's)", 64, 4096, "texels"
    )


@dataclass(frozen=True, kw_only=True)
class Judged(Report):
    """The report of a fit, and of the action around it, held against limits."""

    missed: tuple[str, ...] = ()  # a line for each limit
    picture: Callable[[Path], None] | None = not_in_json()  # draws scan, face and their distance

    of_action: ClassVar[tuple[str, ...]] = ()  # fields that the action fills, beside `missed`

    def of_fit(self) -> dict[str, Any]:
        """Its JSON without what the action fills: as the work folder of a rebuild keeps it."""
        return {name: value for name, value in self.to_dict().items() if name not in ("missed", *self.of_action)}


class ScanAction(StageAction[J]):
    """Base of the actions that put a face on a scan."""

    @classmethod
    def replaced(cls, arguments: Any) -> Collection[str]:
        """Landmarks of a scan in whose place the line gives another."""
        of_scans = (("scan", "landmarks"), ("head", "landmarks"), ("neutral_scan", "neutral_landmarks"))
        return [landmarks for scan, landmarks in of_scans if getattr(arguments, scan, None)]

    def draw(self, face: Face, report: J, path: Path) -> None:
        """The picture of scan, face and their distance."""
        if report.picture is not None:
            report.picture(path)


def landmark_file(scan: Path, given: Path | None) -> Path | None:
    """The landmarks given, or those that lie beside a scan's file.

    :raises InputError: a link beside it leads outside the roots
    """
    if given is not None or Path(scan).is_dir():
        return None if given is None else Path(given)
    return file_beside(Path(scan), f"{Path(scan).stem}.landmarks.json")
