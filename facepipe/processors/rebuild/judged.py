"""What the actions of a rebuild report beside what their fits report: limits that were missed, and what is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

from facepipe.core.reports import Report, unsaid
from facepipe.processors.rebuild.fit_neutral import NeutralReport
from facepipe.processors.rebuild.scan_picture import FaceOnScan

J = TypeVar("J", bound="Judged")


@dataclass(frozen=True, kw_only=True)
class Judged(Report):
    """A report held against limits."""

    missed: tuple[str, ...] = ()  # a line for each limit
    picture: FaceOnScan | None = unsaid()

    @classmethod
    def of(cls: type[J], report: Report, warnings: tuple[str, ...], missed: tuple[str, ...], **more: Any) -> J:
        """`report` with what it lacks.

        :param warnings: all but the lines of what was missed
        """
        return cls(**{**vars(report), "warnings": (*warnings, *missed), "missed": missed, **more})


@dataclass(frozen=True, kw_only=True)
class FitNeutralReport(Judged, NeutralReport):
    """What `facepipe fit-neutral` did."""
