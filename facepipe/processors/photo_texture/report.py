"""What was baked from photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from facepipe.core.reports import Report, table


@dataclass(frozen=True, kw_only=True)
class BakePhotoReport(Report):
    """What was baked."""

    textures: Mapping[str, tuple[str, ...]]  # file -> the materials that show it
    photos: Mapping[str, float]  # file name -> share of the face that it shows
    seen: float  # share of the face that some photo shows
    hidden: tuple[str, ...] = ()  # materials of brow cards that are transparent now
    seconds: float = 0.0


def as_text(out: Path, report: BakePhotoReport) -> str:
    """The textures, and what each photo gave."""
    rows = [("photo", "face that it shows"), *((name, f"{share:.0%}") for name, share in report.photos.items())]
    return f"{out}: {', '.join(report.textures)} in {report.seconds:.1f} s\n{table(rows)}"
