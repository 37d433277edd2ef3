"""Tables of the page of a rebuild's report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from facepipe.core.markup import Markup, heading, ruled_table, tag

if TYPE_CHECKING:
    from facepipe.processors.rebuild import Rebuilt


@dataclass(frozen=True, kw_only=True)
class ShapeRow:
    """What scans show of one shape."""

    name: str
    observed: float  # 0..1, the rest being the template's
    gain: float  # motion along the template's, over the template's
    change_mm: float  # mean distance from the template's
    scans: tuple[str, ...]  # that show it
    unseen: bool = False  # scans show too little: it is the template's


def shape_rows(rebuilt: Rebuilt) -> list[ShapeRow]:
    """A row for each shape that the split of expressions reports, in the order of the face's shapes."""
    report, rows = rebuilt.reports["shapes"], []
    for name in rebuilt.shapes:
        shape, corrected = report["shapes"][name], f"shapes/{name}" in rebuilt.corrected
        rows.append(
            ShapeRow(
                name=name,
                observed=shape["observed"],
                gain=shape["gain"],
                change_mm=shape["change_mm"],
                scans=(*(["corrected by hand"] if corrected else []), *shape["scans"]),
                unseen=name in report["unseen"] and not corrected,
            )
        )
    return rows


def shapes_table(rows: Sequence[ShapeRow]) -> Iterator[Markup]:
    """One row a shape, what changed most first; those that no scan shows follow in grey, names alone."""
    from facepipe.pictures.figures import bar

    shown = sorted((row for row in rows if not row.unseen), key=lambda row: -row.change_mm)
    unseen = [row.name for row in rows if row.unseen]
    yield heading("Shapes", f"{len(shown)} of {len(rows)} shown by the scans")
    lines = [
        [row.name, bar((0.0, 1.0), 0.0, row.observed), f"{row.observed:.2f}", f"{row.gain:.2f}",
         f"{row.change_mm:.2f}", ", ".join(row.scans)]
        for row in shown
    ]  # fmt: skip
    if lines:
        yield ruled_table(
            ["", "shown by scans, 0 to 1", "", "gain", "change mm", "scans that show it"], lines, (2, 3, 4)
        )
    if unseen:
        yield tag("p", "Not shown by the scans: as the template has them", class_="muted")
        yield tag("ul", *(tag("li", name) for name in unseen), class_="names muted")


def scans_table(reports: Mapping[str, Mapping[str, Any]]) -> Markup:
    """Scan -> how the face registered to it lies on it."""
    rows: list[Sequence[object]] = []
    for name, report in reports.items():
        fit = report["fit"]
        figures = (f"{fit[key]:.3f}" for key in ("surface_mean_mm", "surface_p95_mm"))
        rows.append([name, *figures, f"{100 * fit['coverage']:.0f} %", f"{fit['landmark_mean_mm']:.2f}"])
    head = ["scan", "distance, mean mm", "95 % below, mm", "face seen", "landmarks off by, mm"]
    return ruled_table(head, rows, (1, 2, 3, 4))
