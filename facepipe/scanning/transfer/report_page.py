"""What a head got, as a folder: pictures of all shapes, and what was measured of each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.atomic import write_bytes
from facepipe.core.markup import Markup, heading, page, ruled_table, tag

if TYPE_CHECKING:
    from facepipe.parts import FaceParts
    from facepipe.scanning.transfer.transfer import TransferReport


def write_report(folder: Path, parts: FaceParts, report: TransferReport, size: int = 220) -> None:
    """Write index.html, report.json and shapes.png into `folder`.

    :param size: of each picture
    :raises FacepipeError: files that can't be written
    """
    from facepipe.pictures import save_png
    from facepipe.scanning.transfer.pictures import shape_sheet

    made = [name for name in report.shapes if name not in report.not_made]
    sheet = shape_sheet(parts, made, report.shown, report.place, report.framing, size)
    save_png(sheet, folder / "shapes.png")
    write_bytes(folder / "report.json", f"{report.to_json()}\n".encode())
    picture = tag("img", src="shapes.png", alt="every shape at weight 1", style="max-width:100%")
    write_bytes(
        folder / "index.html", page(f"Transfer: {parts.name}", *_content(parts.name, report, len(made)), picture)
    )


def _content(name: str, report: TransferReport, made: int) -> Iterator[Markup]:
    """All but the pictures."""
    yield tag("h1", f"Transfer: {name}")
    fit = f"mean {report.fit_mean_mm:.2f} mm, 95 % below {report.fit_p95_mm:.2f} mm"
    facts = [f"landmarks: {report.landmarks}", f"face from the fitted template: {fit}"]
    lips: Any = report.shapes.get("mouthClose", {}).get("lips")
    if lips is not None:
        gaps = f"{lips['gap_mean']:.2f} mm, largest {lips['gap_most']:.2f}"
        facts.append(f"lips with jawOpen and mouthClose: mean gap {gaps}, crossing {lips['over_most']:.2f}")
    if report.still:
        facts.append(f"moved by no shape: {', '.join(report.still)}")
    yield tag("p", "  ·  ".join(facts), class_="muted")
    yield from (tag("p", warning, class_="bad") for warning in report.warnings)
    yield heading("Shapes", f"{made} made, {len(report.not_made)} can't be made, {len(report.kept)} the head's own")
    head = ["", "verdict", "largest motion, mm", "turned over", "lids: mean gap, mm", "largest", "in the eyeball"]
    rows = [[shape, *_figures(row)] for shape, row in report.shapes.items()]
    rows += [[shape, f"the head's own: {own}", *[""] * 5] for shape, own in report.kept.items()]
    yield ruled_table(head, rows, (2, 3, 4, 5, 6))
    turned = "turned over: triangles of the skin that are seen in the neutral, of mouthClose with jawOpen"
    yield tag("p", f"{turned}; in the eyeball: at rest, to the deepest at weight 1", class_="muted")
    yield heading("Pictures", "weight 1, from the front and from between front and side")


def _figures(row: Mapping[str, Any]) -> list[str]:
    verdict = str(row["verdict"])
    if "largest_mm" not in row:
        return [verdict, *[""] * 5]
    cells, lids = [verdict, f"{row['largest_mm']:.1f}", str(row["flips"])], row.get("lids")
    if lids is None:
        return [*cells, *[""] * 3]
    inside = f"{lids['in_ball_neutral']:.2f} to {lids['in_ball']:.2f}"
    return [*cells, f"{lids['gap_mean']:.2f}", f"{lids['gap_most']:.2f}", inside]
