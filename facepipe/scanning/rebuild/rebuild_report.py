"""The report of a rebuild, and the same as a folder: figures, and pictures of what they stand for."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.atomic import write_bytes
from facepipe.core.markup import Markup, heading, page, ruled_table, tag
from facepipe.core.reports import Report, not_in_json, table

if TYPE_CHECKING:
    from PIL.Image import Image

    from facepipe.core.arrays import FloatArray
    from facepipe.kinds import Job
    from facepipe.scanning.rebuild import ProjectScan, Rebuilt
    from facepipe.scans import Scan

_BELOW_CHIN = 0.1  # of the landmarks' height: what pictures show below the lowest chin
_NAMED = 8  # weights of an expression that the page gives
_SHOWN = 10  # shapes that a rebuild's text names
_SCAN_PIXELS = 420


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
    rebuilt: Rebuilt | None = not_in_json()  # what the folder shows
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


def shapes_table(
    report: Mapping[str, Any], names: Collection[str], corrected: Collection[str] = ()
) -> Iterator[Markup]:
    """One row a shape, what changed most first; those that no scan shows follow in grey, names alone.

    :param report: `SplitShapesReport` as JSON
    :param names: of the face's shapes, in their order
    :param corrected: steps and shapes in whose place an artist put a mesh
    """
    from facepipe.pictures.figures import bar

    by_hand = {name for name in names if f"shapes/{name}" in corrected}
    shapes, left = report["shapes"], {*report["unseen"], *report["undecided"]} - by_hand
    shown = sorted((name for name in names if name not in left), key=lambda name: -shapes[name]["change_mm"])
    yield heading("Shapes", f"{len(shown)} of {len(names)} shown by the scans")
    lines = []
    for name in shown:
        shape = shapes[name]
        observed, gain, change = shape["observed"], f"{shape['gain']:.2f}", f"{shape['change_mm']:.2f}"
        scans = ", ".join([*(["corrected by hand"] if name in by_hand else []), *shape["scans"]])
        share = bar((0.0, 1.0), 0.0, observed)
        lines.append([name, share, f"{observed:.2f}", gain, change, scans, ", ".join(shape["alike"])])
    if lines:
        yield ruled_table(
            ["", "shown by scans, 0 to 1", "", "gain", "change mm", "scans that show it", "not distinguished from"],
            lines,
            (2, 3, 4),
        )
    unseen = [name for name in names if name in left]
    for what, alike in (("Not shown by the scans, or hardly", False), ("Not distinguished by the scans", True)):
        found = [name for name in unseen if bool(shapes[name]["alike"]) == alike]
        if found:
            yield tag("p", f"{what}: as the template has them", class_="muted")
            yield tag("ul", *(tag("li", name) for name in found), class_="names muted")


def report_steps(rebuilt: Rebuilt) -> int:
    """Steps of `write_report`."""
    return 2 * len(_scans(rebuilt)) + 2


def write_report(
    rebuilt: Rebuilt,
    folder: Path,
    result: Mapping[str, Any],
    drawn: Callable[[], object] = lambda: None,
    size: int = _SCAN_PIXELS,
) -> None:
    """Write report.html, report.json, neutral.png and expressions/NAME.png into `folder`.

    :param result: JSON
    :param drawn: called after each step
    :param size: of a picture of a scan
    :raises FacepipeError: a scan that can't be read any more, or files that can't be written
    """
    from facepipe.pictures import save_png
    from facepipe.pictures.figures import color_scale, figure
    from facepipe.scanning.rebuild_pictures import stacked

    title = f"Rebuild: {rebuilt.project.path.stem}"
    parts = [tag("h1", title), *(tag("p", line, class_="bad") for line in result.get("missed", ()))]
    reports, scans = rebuilt.reports, _scans(rebuilt)
    head = ["scan", "distance, mean mm", "95 % below, mm", "face seen", "landmarks off by, mm"]
    rows = [[scan.name, *_fit_figures(reports[step]["fit"])] for step, (scan, _) in scans.items()]
    parts.append(ruled_table(head, rows, (1, 2, 3, 4)))
    for step, images, largest_mm in _turntables(rebuilt, drawn, size):
        path = folder / f"{step}.png"
        path.parent.mkdir(exist_ok=True)
        scan, _ = scans[step]
        save_png(stacked([*images.values()]), path)
        parts += [heading(scan.name, scan.scan.name), *(tag("p", note) for note in _notes(rebuilt, step))]
        parts.append(tag("div", *(figure(image, name) for name, image in images.items()), class_="grid"))
        parts.append(
            color_scale((0.0, largest_mm), "distance of the registered face from the scan", "no place on the scan")
        )
        drawn()
    if "shapes" in reports:
        parts += shapes_table(reports["shapes"], rebuilt.shapes, rebuilt.corrected)
    drawn()
    parts += _changed_shapes(rebuilt)
    drawn()
    text = json.dumps(result, sort_keys=True, indent=2, default=str)
    write_bytes(folder / "report.json", f"{text}\n".encode())
    write_bytes(folder / "report.html", page(title, *parts))


def _scans(rebuilt: Rebuilt) -> dict[str, tuple[ProjectScan, FloatArray]]:
    """Step -> its scan, and the whole points (n, 3) that were found."""
    found = {"neutral": (rebuilt.project.neutral, rebuilt.shown)}
    return found | {
        f"expressions/{one.name}": (one, rebuilt.composites[one.name]) for one in rebuilt.project.expressions
    }


def _turntables(
    rebuilt: Rebuilt, drawn: Callable[[], object], size: int
) -> Iterator[tuple[str, dict[str, Image], float]]:
    """Step, its pictures, and the end of the scale of distances (mm): scans are read twice, as all are measured before
    the first is drawn, for one scale of colours."""
    import numpy as np

    from facepipe.importers.scan_file import read_scan
    from facepipe.scanning.rebuild.scan_fit import in_place, scan_distances
    from facepipe.scanning.rebuild_pictures import round_above, turntable
    from facepipe.verbs.whole_faces import whole_parts

    def read(scan: ProjectScan) -> Scan:
        return replace(read_scan(scan.scan), name=str(scan.scan))

    distances, places, template = {}, rebuilt.places, rebuilt.template
    for step, (scan, points) in _scans(rebuilt).items():
        distances[step] = scan_distances(template, points, read(scan), places[step])
        drawn()
    together = np.concatenate(list(distances.values()))
    largest_mm, framing = round_above(together[np.isfinite(together)]), _framing(rebuilt)
    for step, (scan, points) in _scans(rebuilt).items():
        face, placed = whole_parts(template.parts, points), in_place(read(scan), places[step])
        yield step, turntable(face, placed, distances[step], largest_mm, framing, size), largest_mm


def _framing(rebuilt: Rebuilt) -> FloatArray:
    """(k, 3) points of the neutral's head, and of all expressions' landmarks: a chin goes down with the jaw."""
    import numpy as np

    rows = rebuilt.template.rows
    skin, marks = rebuilt.neutral[rows], rows[rebuilt.template.landmarks]
    seen = np.concatenate([points[marks] for points in (rebuilt.neutral, *rebuilt.composites.values())])
    height = np.ptp(rebuilt.neutral[marks, 1])
    return np.concatenate([skin[skin[:, 1] >= seen[:, 1].min() - _BELOW_CHIN * height], seen])


def _notes(rebuilt: Rebuilt, step: str) -> tuple[str, ...]:
    from facepipe.scanning.rebuild.scan_fit import slid_text

    report = rebuilt.reports[step]
    fit = report["fit"]
    lines = [
        f"distance from the scan: mean {fit['surface_mean_mm']:.3f} mm, 95 % below {fit['surface_p95_mm']:.3f} mm; "
        f"{100 * fit['coverage']:.0f} % of the face seen; landmarks {fit['landmark_mean_mm']:.2f} mm off"
    ]
    if slid := fit.get("slid_mm"):  # not of steps that were done before it was measured
        lines.append(f"slid along the surface: {slid_text(slid)}")
    if (name := step.removeprefix("expressions/")) in rebuilt.left_out:
        lines.append(f"left out: {rebuilt.left_out[name]}")
    if fit["outliers"]:
        lines.append(f"ignored as outliers: {', '.join(fit['outliers'])}")
    if step == "neutral" and "refined" in rebuilt.reports:
        lines.append(refined_line(rebuilt.reports["refined"]))
    if report["weights"]:
        weights = sorted(report["weights"].items(), key=lambda one: -one[1])
        more = f" and {len(weights) - _NAMED} more" if len(weights) > _NAMED else ""
        lines.append(", ".join(f"{name} {weight:.2f}" for name, weight in weights[:_NAMED]) + more)
    if step in rebuilt.corrected or (step == "neutral" and "refined" in rebuilt.corrected):
        lines.append("corrected by hand: numbers are of the mesh before, colours of the corrected one")
    return tuple(lines)


def _changed_shapes(rebuilt: Rebuilt) -> Iterator[Markup]:
    import numpy as np

    from facepipe.pictures.figures import color_scale, figure
    from facepipe.scanning.rebuild_pictures import changed_pictures, most_changed
    from facepipe.verbs.whole_faces import whole_parts

    template, shapes, before = rebuilt.template, rebuilt.shapes, rebuilt.personal
    distances = {name: np.linalg.norm(shapes[name] - before[name], axis=1) for name in shapes}
    counted = template.rows[template.seen]
    far = most_changed({name: float(one[counted].max(initial=0.0)) for name, one in distances.items()})
    if far:
        parts, framing = whole_parts(template.parts, rebuilt.neutral), _framing(rebuilt)
        faces = {name: (rebuilt.neutral + shapes[name], distances[name]) for name in far}
        images, limits = changed_pictures(parts, faces, counted, framing)
        figures = [figure(images[name], name, f"to {mm:.1f} mm") for name, mm in far.items()]
        yield heading("Shapes that changed most", "at weight 1")
        yield tag("div", *figures, class_="grid", style="grid-template-columns:repeat(4,minmax(0,1fr))")
        yield color_scale(limits, "distance from the personal template's shape; the last colour stands for more too")
