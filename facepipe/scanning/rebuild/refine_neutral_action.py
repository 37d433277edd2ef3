"""Draw a neutral, or regions of it, closer to its scan.

NEUTRAL is a face stage of `facepipe fit-neutral`, corrected by hand or not; SCAN is the scan that it was fitted to. The
scan is placed on the neutral by landmarks, then by the surface; landmarks are read from --landmarks, else from SCAN's
name with .landmarks.json, else found on the scan. Then points go to the scan, each triangle changed like its
neighbours.

--region names soft masks of the face (`facepipe regions` lists them): points outside stay exactly where they are, those
at the border go part of the way. Without it all of the face may follow. Eyes and teeth go with the skin around them
where they are in the region. What SCAN shows besides the neutral, such as closed eyes, is in NEUTRAL's recipe where
`facepipe fit-neutral --weights` had it; else --weights says so.

OUT is an override layer over NEUTRAL; --flatten writes a standalone file. Exit code 1: done, but a limit of the quality
gate of `facepipe database add` is missed.

examples:
  facepipe refine-neutral anna.usdc anna.ply -o refined.usdc --region nose --picture refined.png
  facepipe refine-neutral anna.usdc anna.ply -o refined.usdc --region nose mouth --detail-mm 6
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.reports import table
from facepipe.declare import beside, named_numbers, option, source, to_json
from facepipe.kinds import Job, action
from facepipe.scanning.rebuild.declared import RefineNeutralOptions, ScanAction, landmark_file

if TYPE_CHECKING:
    from facepipe.scanning.rebuild.refine_neutral import RefineNeutralReport
    from facepipe.stage import Face

_STEPS = 16  # of a refinement, at most


@action("refine-neutral", "draw a neutral, or regions of it, closer to its scan")
@dataclass(frozen=True, kw_only=True)
class RefineNeutralAction(RefineNeutralOptions, ScanAction["RefineNeutralReport"]):
    """The action."""

    neutral: Path = source("face stage with the person's neutral")
    scan: Path = source("its scan: .ply .obj .stl .off .glb .gltf or USD")
    landmarks: Path | None = source(
        "landmarks of the scan (default SCAN's .landmarks.json)", default=None, flag="--landmarks", metavar="JSON"
    )
    regions: tuple[str, ...] = option((), "what may follow (default all)", flag="--region", metavar="NAME", words=True)
    weights: Mapping[str, float] = option(
        dict,
        "shapes that the scan shows besides the neutral, weights above 0 up to 2 (default as NEUTRAL was fitted)",
        parse=named_numbers,
        metavar="SHAPE=WEIGHT",
        words=True,
    )
    picture: Path | None = beside("draw scan, face and their distance", ".png", "draw")

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "landmarks", landmark_file(self.scan, self.landmarks))

    def author(self, face: Face, job: Job) -> RefineNeutralReport:
        from facepipe.importers.scan_file import read_scan
        from facepipe.scanning.database import QualityLimits, misses
        from facepipe.scanning.rebuild.refine_neutral import flipped_before, refine_neutral
        from facepipe.scanning.rebuild.scan_fit import draw_face_on_scan, landmarks_of, named
        from facepipe.scanning.rebuild.template import Template, expression_of, region_weights, resolved, shown_before
        from facepipe.verbs.author_neutral import AuthorNeutral
        from facepipe.verbs.whole_faces import whole_face

        parts, where = face.parts(), str(self.neutral)
        weights = region_weights(parts, self.regions, where)
        template, scan = Template.of(parts, where), read_scan(self.scan)
        landmarks, notes = landmarks_of(self.landmarks, scan)
        # The face is refined as the scan shows it; what it shows besides is taken off again.
        own, besides = whole_face(parts, where), self.weights or shown_before(parts.recipe)
        shown = resolved(besides, tuple(own.deltas), f"{where} -> --weights") if besides else {}
        expression = expression_of(own.deltas, shown, len(template.points))
        with named(self.scan), job.watch("refine", _STEPS) as bar:
            points, place, report = refine_neutral(
                template,
                template.points,
                scan,
                landmarks,
                weights=weights,
                expression=expression,
                options=self,
                flipped=flipped_before(parts.recipe),
                progress=lambda step: bar.update(),
            )
        recipe = job.recipe(quality=to_json(report.quality), weights=shown)
        authored, missed = AuthorNeutral()(face, points, recipe=recipe), misses(report.quality, QualityLimits())
        return replace(
            report,
            warnings=(*notes, *report.warnings, *authored.warnings, *missed),
            missed=missed,
            picture=partial(
                draw_face_on_scan,
                template=template,
                points=points + expression,
                scan=scan,
                place=place,
                neutral=points if expression.any() else None,
            ),
            regions=self.regions,
        )

    def text(self, report: RefineNeutralReport, out: Path) -> str:
        off = f", {len(report.outliers)} of them outliers" if report.outliers else ""
        rows = [
            ("refined", f"{', '.join(report.regions) or 'all'}: {report.points} points"),
            ("distance before", f"mean {report.before_mean_mm:.3f} mm, 95 % below {report.before_p95_mm:.3f} mm"),
            ("distance now", f"mean {report.surface_mean_mm:.3f} mm, 95 % below {report.surface_p95_mm:.3f} mm"),
            ("shown by the scan", f"{100 * report.coverage:.1f} % of its outside"),
            ("moved", f"mean {report.moved_mean_mm:.2f} mm, at most {report.moved_max_mm:.2f} mm"),
            ("flipped triangles", f"{report.flipped_triangles}"),
            ("steps", f"{report.steps}"),
        ]
        if report.landmark_mean_mm is not None:
            rows.insert(4, ("landmarks", f"{report.landmark_mean_mm:.2f} mm off (mean){off}"))
        return "\n".join([str(out), table(rows)])
