"""What was baked from photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.reports import Report, not_in_json, table

if TYPE_CHECKING:
    from facepipe.photo.texture.report_folder import BakeSheet


@dataclass(frozen=True, kw_only=True)
class BakePhotoReport(Report):
    """What was baked."""

    textures: Mapping[str, tuple[str, ...]]  # file -> the materials that show it
    photos: Mapping[str, float]  # file name -> share of the face that it shows
    seen: float  # share of the face that some photo shows
    hidden: tuple[str, ...] = ()  # materials of cards that are transparent now
    hair: tuple[float, float, float] | None = None  # linear colour, where photos show it
    hair_style: str | None = None  # of the built-in head, the nearest to the photos'
    similarities: Mapping[str, float | None] = field(default_factory=dict)  # file name -> of photo and render, cosine
    seconds: float = 0.0
    sheet: BakeSheet = not_in_json()  # where a report or a similarity is asked for


def as_text(out: Path, report: BakePhotoReport) -> str:
    """The textures, and what each photo gave."""
    alike = {name: "none" if value is None else f"{value:.3f}" for name, value in report.similarities.items()}
    rows = [("photo", "face that it shows", *(["similarity"] if alike else []))]
    rows += [(name, f"{share:.0%}", *([alike[name]] if alike else [])) for name, share in report.photos.items()]
    hair = "" if report.hair_style is None else f"\nhair: {report.hair_style}"
    return f"{out}: {', '.join(report.textures)} in {report.seconds:.1f} s\n{table(rows)}{hair}"
