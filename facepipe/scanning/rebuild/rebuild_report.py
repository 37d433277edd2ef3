"""The report of a rebuild, and the same as a folder: figures, and pictures of what they stand for."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.atomic import write_bytes
from facepipe.core.markup import Markup, heading, page, ruled_table, tag
from facepipe.core.reports import Report, not_in_json, table

if TYPE_CHECKING:
    from facepipe.core.arrays import FloatArray
    from facepipe.kinds import Job
    from facepipe.scanning.rebuild import Project, ProjectScan, Rebuilt, Template
    from facepipe.scanning.rebuild_pictures import Turntable
    from facepipe.scans import Scan

_BELOW_CHIN = 0.1  # of the landmarks' height: what pictures show below the lowest chin
_NAMED = 8  # weights of an expression that the page gives
_SHOWN = 10  # shapes that a rebuild's text names


@dataclass(frozen=True, kw_only=True)
class RebuildReport(Report):
    """What a rebuild did."""

    stages: Mapping[str, Any] = field(default_factory=dict)  # step -> its report
    quality: Mapping[str, Any] = field(default_factory=dict)  # how the neutral lies on its scan
    reused: tuple[str, ...] = ()  # steps whose results were there
    corrected: tuple[str, ...] = ()  # steps in whose place an artist put a mesh
    checks: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # expression -> whether its scan belongs
    left_out: Mapping[str, str] = field(default_factory=dict)  # expression -> why its scan does not belong
    mouth: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # shape -> how its inside comes through skin
    missed: tuple[str, ...] = ()  # a line for each limit, and each scan that was left out
    textures: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # file -> the materials that show it
    colored: float = 0.0  # share of the skin's outside whose colours the neutral's scan shows
    pictures: RebuildPictures | None = not_in_json()
    job: Job | None = not_in_json()

    def as_text(self, out: Path) -> str:
        """Tables of scans and shapes, and a line for each thing besides."""
        rows: list[tuple[str, ...]] = [("scan", "mean mm", "p95 mm", "face seen", "landmarks mm")]
        rows += (
            (name.removeprefix("expressions/"), *_fit_figures(step["fit"]))
            for name, step in self.stages.items()
            if "fit" in step
        )
        lines = [str(out), table(rows)]
        if "refined" in self.stages:
            lines.append(refined_line(self.stages["refined"]))
        if "shapes" in self.stages:
            report = self.stages["shapes"]
            shapes, unseen = report["shapes"], {*report["unseen"], *report["undecided"]}
            seen = len(shapes) - len(unseen)
            lines.append(f"{seen} of {len(shapes)} shapes shown by the scans, the others are the template's")
            shown = sorted(set(shapes) - unseen, key=lambda name: (-shapes[name]["change_mm"], name))[:_SHOWN]
            rows = [("changed most", "observed", "gain", "change mm", "scans")]
            for name in shown:
                numbers = (f"{shapes[name][key]:.2f}" for key in ("observed", "gain", "change_mm"))
                rows.append((name, *numbers, " ".join(shapes[name]["scans"])))
            if shown:
                lines.append(table(rows))
            if report["undecided"]:
                lines.append(
                    f"hardly shown or not distinguished by the scans, the template's: {', '.join(report['undecided'])}"
                )
        if self.left_out:
            lines.append(f"left out: {', '.join(self.left_out)}")
        if self.textures:
            lines.append(f"skin in the scan's colours: {100 * self.colored:.1f} %")
        if self.reused:
            lines.append(f"reused: {', '.join(self.reused)}")
        if self.corrected:
            lines.append(f"corrected by hand: {', '.join(self.corrected)}")
        return "\n".join(lines)


def refined_line(report: Mapping[str, Any]) -> str:
    """What a refinement did to the neutral."""
    return (
        f"neutral refined at {report['points']} points: {report['before_mean_mm']:.3f} mm from the scan before (mean), "
        f"{report['surface_mean_mm']:.3f} mm now; moved {report['moved_mean_mm']:.2f} mm, at most "
        f"{report['moved_max_mm']:.2f} mm"
    )


def _fit_figures(fit: Mapping[str, Any]) -> tuple[str, ...]:
    """How a face lies on a scan, `ScanFit` as JSON: mean and 95th percentile of distances, share seen, landmarks."""
    distances = (f"{fit[key]:.3f}" for key in ("surface_mean_mm", "surface_p95_mm"))
    return (*distances, f"{100 * fit['coverage']:.0f} %", f"{fit['landmark_mean_mm']:.2f}")


@dataclass(frozen=True, kw_only=True)
class ShapeRow:
    """What scans show of one shape."""

    name: str
    observed: float  # 0..1, the rest being the template's
    gain: float  # motion along the template's, over the template's
    change_mm: float  # mean distance from the template's
    scans: tuple[str, ...]  # that show it
    alike: tuple[str, ...] = ()  # shapes that the scans don't separate from it, where both move
    unseen: bool = False  # scans show it not or hardly, or as one with another: it is the template's


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
                alike=tuple(shape["alike"]),
                unseen=name in (*report["unseen"], *report["undecided"]) and not corrected,
            )
        )
    return rows


def shapes_table(rows: Sequence[ShapeRow]) -> Iterator[Markup]:
    """One row a shape, what changed most first; those that no scan shows follow in grey, names alone."""
    from facepipe.pictures.figures import bar

    shown = sorted((row for row in rows if not row.unseen), key=lambda row: -row.change_mm)
    unseen = [row for row in rows if row.unseen]
    yield heading("Shapes", f"{len(shown)} of {len(rows)} shown by the scans")
    lines = [
        [row.name, bar((0.0, 1.0), 0.0, row.observed), f"{row.observed:.2f}", f"{row.gain:.2f}",
         f"{row.change_mm:.2f}", ", ".join(row.scans), ", ".join(row.alike)]
        for row in shown
    ]  # fmt: skip
    if lines:
        yield ruled_table(
            ["", "shown by scans, 0 to 1", "", "gain", "change mm", "scans that show it", "not distinguished from"],
            lines,
            (2, 3, 4),
        )
    for what, names in (
        ("Not shown by the scans, or hardly", [row.name for row in unseen if not row.alike]),
        ("Not distinguished by the scans", [row.name for row in unseen if row.alike]),
    ):
        if names:
            yield tag("p", f"{what}: as the template has them", class_="muted")
            yield tag("ul", *(tag("li", name) for name in names), class_="names muted")


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
        """Write report.html, report.json, neutral.png and expressions/NAME.png into `folder`.

        :param result: JSON
        :param drawn: called after each step
        :raises FacepipeError: a scan that can't be read any more, or files that can't be written
        """
        from facepipe.pictures import save_png
        from facepipe.pictures.figures import color_scale, figure
        from facepipe.scanning.rebuild_pictures import stacked, turntable

        title = f"Rebuild: {self.project.path.stem}"
        parts = [tag("h1", title), *(tag("p", line, class_="bad") for line in result.get("missed", ()))]
        reports, scans = self.rebuilt.reports, self._scans()
        head = ["scan", "distance, mean mm", "95 % below, mm", "face seen", "landmarks off by, mm"]
        rows = [[scan.name, *_fit_figures(reports[step]["fit"])] for step, (scan, _) in scans.items()]
        parts.append(ruled_table(head, rows, (1, 2, 3, 4)))
        for step, shown in self._turntables(drawn):
            path = folder / f"{step}.png"
            path.parent.mkdir(exist_ok=True)
            images, (scan, _) = turntable(shown), scans[step]
            save_png(stacked([*images.values()]), path)
            parts += [heading(scan.name, scan.scan.name), *(tag("p", note) for note in self._notes(step))]
            parts.append(tag("div", *(figure(image, name) for name, image in images.items()), class_="grid"))
            what = "distance of the registered face from the scan"
            parts.append(color_scale((0.0, shown.largest_mm), what, "no place on the scan"))
            drawn()
        parts += self._shapes(drawn)
        text = json.dumps(result, sort_keys=True, indent=2, default=str)
        write_bytes(folder / "report.json", f"{text}\n".encode())
        write_bytes(folder / "report.html", page(title, *parts))

    def _scans(self) -> dict[str, tuple[ProjectScan, FloatArray]]:
        """Step -> its scan, and the whole points (n, 3) that were found."""
        found = {"neutral": (self.project.neutral, self.rebuilt.shown)}
        composites = self.rebuilt.composites
        return found | {f"expressions/{one.name}": (one, composites[one.name]) for one in self.project.expressions}

    def _turntables(self, drawn: Callable[[], object]) -> Iterator[tuple[str, Turntable]]:
        """Scans are read twice: all are measured before the first is drawn, for one scale of colours."""
        import numpy as np

        from facepipe.scanning.rebuild.scan_fit import in_place, scan_distances
        from facepipe.scanning.rebuild_pictures import Turntable, round_above
        from facepipe.verbs.whole_faces import whole_parts

        distances, places = {}, self.rebuilt.places
        for step, (scan, points) in self._scans().items():
            distances[step] = scan_distances(self.template, points, _read(scan), places[step])
            drawn()
        together = np.concatenate(list(distances.values()))
        largest, framing = round_above(together[np.isfinite(together)]), self._framing()
        for step, (scan, points) in self._scans().items():
            yield (
                step,
                Turntable(
                    parts=whole_parts(self.template.parts, points),
                    scan=in_place(_read(scan), places[step]),
                    distances=distances[step],
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
        seen = np.concatenate(
            [self.rebuilt.neutral[marks], *(composite[marks] for composite in self.rebuilt.composites.values())]
        )
        height = np.ptp(self.rebuilt.neutral[marks, 1])
        return np.concatenate([skin[skin[:, 1] >= seen[:, 1].min() - _BELOW_CHIN * height], seen])

    def _notes(self, step: str) -> tuple[str, ...]:
        from facepipe.scanning.rebuild.scan_fit import slid_text

        report = self.rebuilt.reports[step]
        fit = report["fit"]
        lines = [
            f"distance from the scan: mean {fit['surface_mean_mm']:.3f} mm, 95 % below {fit['surface_p95_mm']:.3f} mm; "
            f"{100 * fit['coverage']:.0f} % of the face seen; landmarks {fit['landmark_mean_mm']:.2f} mm off"
        ]
        if slid := fit.get("slid_mm"):  # not of steps that were done before it was measured
            lines.append(f"slid along the surface: {slid_text(slid)}")
        if (name := step.removeprefix("expressions/")) in self.rebuilt.left_out:
            lines.append(f"left out: {self.rebuilt.left_out[name]}")
        if fit["outliers"]:
            lines.append(f"ignored as outliers: {', '.join(fit['outliers'])}")
        if step == "neutral" and "refined" in self.rebuilt.reports:
            lines.append(refined_line(self.rebuilt.reports["refined"]))
        if report["weights"]:
            weights = sorted(report["weights"].items(), key=lambda one: -one[1])
            more = f" and {len(weights) - _NAMED} more" if len(weights) > _NAMED else ""
            lines.append(", ".join(f"{name} {weight:.2f}" for name, weight in weights[:_NAMED]) + more)
        if step in self.rebuilt.corrected or (step == "neutral" and "refined" in self.rebuilt.corrected):
            lines.append("corrected by hand: numbers are of the mesh before, colours of the corrected one")
        return tuple(lines)

    def _shapes(self, drawn: Callable[[], object]) -> Iterator[Markup]:
        from facepipe.pictures.figures import color_scale, figure
        from facepipe.scanning.rebuild_pictures import ChangedShapes, change_mm, changed_pictures, most_changed
        from facepipe.verbs.whole_faces import whole_parts

        rebuilt, template = self.rebuilt, self.template
        if "shapes" in rebuilt.reports:
            yield from shapes_table(shape_rows(rebuilt))
        drawn()
        changed = ChangedShapes(
            parts=whole_parts(template.parts, rebuilt.neutral),
            neutral=rebuilt.neutral,
            shapes=rebuilt.shapes,
            before=rebuilt.personal,
            counted=template.rows[template.seen],
            framing=self._framing(),
        )
        names = most_changed(changed)
        if names:
            images, limits = changed_pictures(changed, names)
            figures = [
                figure(image, name, f"to {change_mm(changed, name):.1f} mm")
                for name, image in zip(names, images, strict=True)
            ]
            yield heading("Shapes that changed most", "at weight 1")
            yield tag("div", *figures, class_="grid", style="grid-template-columns:repeat(4,minmax(0,1fr))")
            yield color_scale(
                limits, "distance from the personal template's shape; the last colour stands for more too"
            )
        drawn()


def _read(scan: ProjectScan) -> Scan:
    from facepipe.importers.scan_file import read_scan

    return replace(read_scan(scan.scan), name=str(scan.scan))
