"""The report folder of a rebuild: its figures, and pictures of what they stand for."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.reports import Report, unsaid

if TYPE_CHECKING:
    from facepipe.core.arrays import FloatArray
    from facepipe.kinds import Job
    from facepipe.pictures.shapes_table import ShapeRow
    from facepipe.pictures.turntable import Turntable
    from facepipe.processors.rebuild import Project, ProjectScan, Rebuilt, Template
    from facepipe.scans import Scan

_BELOW_CHIN = 0.1  # of the landmarks' height: what pictures show below the lowest chin
_NAMED = 8  # weights of an expression that its picture tells


@dataclass(frozen=True, kw_only=True)
class RebuildReport(Report):
    """What a rebuild did."""

    stages: Mapping[str, Any] = field(default_factory=dict)  # stage -> its report
    quality: Mapping[str, Any] = field(default_factory=dict)  # how the neutral lies on its scan
    reused: tuple[str, ...] = ()  # stages whose results were there
    corrected: tuple[str, ...] = ()  # stages in whose place an artist put a mesh
    missed: tuple[str, ...] = ()  # a line for each limit
    pictures: RebuildPictures | None = unsaid()
    job: Job | None = unsaid()


def refined_line(report: Mapping[str, Any]) -> str:
    """What a refinement did to the neutral."""
    return (
        f"neutral refined at {report['points']} points: {report['before_mean_mm']:.3f} mm from the scan before (mean), "
        f"{report['surface_mean_mm']:.3f} mm now; moved {report['moved_mean_mm']:.2f} mm, at most "
        f"{report['moved_max_mm']:.2f} mm"
    )


@dataclass(frozen=True, kw_only=True)
class RebuildPictures:
    """What a report shows."""

    project: Project
    template: Template
    rebuilt: Rebuilt
    size: int = 420  # pixels of a picture of a scan

    @property
    def count(self) -> int:
        """Steps of `write`."""
        return 2 * len(self._scans()) + 2

    def write(self, folder: Path, result: Mapping[str, Any], drawn: Callable[[], object] = lambda: None) -> None:
        """Write report.json, neutral.png, expressions/NAME.png, shapes.png and shapes_heat.png into `folder`.

        :param result: JSON
        :param drawn: called after each step
        :raises FacepipeError: a scan that can't be read any more, or files that can't be written
        """
        from facepipe.core.atomic import write_bytes
        from facepipe.pictures import save_png
        from facepipe.pictures.turntable import turntable

        for stage, shown in self._turntables(drawn):
            path = folder / f"{stage}.png"
            path.parent.mkdir(exist_ok=True)
            save_png(turntable(shown), path)
            drawn()
        self._draw_shapes(folder, drawn)
        text = json.dumps(result, sort_keys=True, indent=2, default=str)
        write_bytes(folder / "report.json", f"{text}\n".encode())

    def _scans(self) -> dict[str, tuple[ProjectScan, FloatArray]]:
        """Stage -> its scan, and the whole points (n, 3) that were found."""
        found = {"neutral": (self.project.neutral, self.rebuilt.shown)}
        composites = self.rebuilt.composites
        return found | {f"expressions/{one.name}": (one, composites[one.name]) for one in self.project.expressions}

    def _turntables(self, drawn: Callable[[], object]) -> Iterator[tuple[str, Turntable]]:
        """Scans are read twice: all are measured before the first is drawn, for one scale of colours."""
        import numpy as np

        from facepipe.pictures.fit_sheet import round_above
        from facepipe.pictures.turntable import Turntable
        from facepipe.processors.database.whole_faces import whole_parts
        from facepipe.processors.rebuild.scan_distances import in_place, scan_distances

        distances, places = {}, self.rebuilt.places
        for stage, (one, points) in self._scans().items():
            distances[stage] = scan_distances(self.template, points, _read(one), places[stage])
            drawn()
        together = np.concatenate(list(distances.values()))
        largest, framing = round_above(together[np.isfinite(together)]), self._framing()
        for stage, (one, points) in self._scans().items():
            yield (
                stage,
                Turntable(
                    title=one.name,
                    source=one.scan.name,
                    notes=self._notes(stage),
                    parts=whole_parts(self.template.parts, points),
                    scan=in_place(_read(one), places[stage]),
                    distances=distances[stage],
                    largest_mm=largest,
                    framing=framing,
                    size=self.size,
                ),
            )

    def _framing(self) -> FloatArray:
        """(k, 3) points of the neutral's head, and of all expressions' landmarks: a chin goes down with the jaw."""
        import numpy as np

        rows = self.template.rows
        skin, marks = self.rebuilt.neutral[rows], rows[self.template.landmarks]
        seen = np.concatenate([self.rebuilt.neutral[marks], *(one[marks] for one in self.rebuilt.composites.values())])
        height = np.ptp(self.rebuilt.neutral[marks, 1])
        return np.concatenate([skin[skin[:, 1] >= seen[:, 1].min() - _BELOW_CHIN * height], seen])

    def _notes(self, stage: str) -> tuple[str, ...]:
        report = self.rebuilt.reports[stage]
        fit = report["fit"]
        lines = [
            f"distance from the scan: mean {fit['surface_mean_mm']:.3f} mm, 95 % below {fit['surface_p95_mm']:.3f} mm; "
            f"{100 * fit['coverage']:.0f} % of the face seen; landmarks {fit['landmark_mean_mm']:.2f} mm off"
        ]
        if fit["outliers"]:
            lines.append(f"lie off, and don't count: {', '.join(fit['outliers'])}")
        if stage == "neutral" and "refined" in self.rebuilt.reports:
            lines.append(refined_line(self.rebuilt.reports["refined"]))
        if report["weights"]:
            weights = sorted(report["weights"].items(), key=lambda one: -one[1])
            more = f" and {len(weights) - _NAMED} more" if len(weights) > _NAMED else ""
            lines.append(", ".join(f"{name} {weight:.2f}" for name, weight in weights[:_NAMED]) + more)
        if stage in self.rebuilt.corrected or (stage == "neutral" and "refined" in self.rebuilt.corrected):
            lines.append("corrected by hand: numbers are of the mesh before, colours of the corrected one")
        return tuple(lines)

    def _draw_shapes(self, folder: Path, drawn: Callable[[], object]) -> None:
        from facepipe.pictures import save_png
        from facepipe.pictures.shapes_sheet import ChangedShapes, most_changed, shapes_sheet
        from facepipe.pictures.shapes_table import shapes_table
        from facepipe.processors.database.whole_faces import whole_parts

        rebuilt, template = self.rebuilt, self.template
        if "shapes" in rebuilt.reports:
            save_png(shapes_table(shape_rows(rebuilt)), folder / "shapes.png")
        drawn()
        changed = ChangedShapes(
            title="Shapes that changed most",
            parts=whole_parts(template.parts, rebuilt.neutral),
            neutral=rebuilt.neutral,
            shapes=rebuilt.shapes,
            before=rebuilt.personal,
            counted=template.rows[template.seen],
            framing=self._framing(),
        )
        names = most_changed(changed)
        if names:
            save_png(shapes_sheet(changed, names), folder / "shapes_heat.png")
        drawn()


def shape_rows(rebuilt: Rebuilt) -> list[ShapeRow]:
    """A row for each shape that the split of expressions reports, in the order of the face's shapes."""
    from facepipe.pictures.shapes_table import ShapeRow

    report, rows = rebuilt.reports["shapes"], []
    for name in rebuilt.shapes:
        one, corrected = report["shapes"][name], f"shapes/{name}" in rebuilt.corrected
        rows.append(
            ShapeRow(
                name=name,
                observed=one["observed"],
                gain=one["gain"],
                change_mm=one["change_mm"],
                scans=(*(["corrected by hand"] if corrected else []), *one["scans"]),
                unseen=name in report["unseen"] and not corrected,
            )
        )
    return rows


def _read(one: ProjectScan) -> Scan:
    from facepipe.importers.scan_file import read_scan

    return replace(read_scan(one.scan), name=str(one.scan))
