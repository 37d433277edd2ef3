"""Put a person's face on the scan of an expression: the whole expression as one shape over the personal template.

SCAN is a mesh or a cloud of points, of any pose and unit. --weights says what it shows, or the name of a composite does
(default: SCAN's name): jaw_open, smile, laugh, brows_up ... as docs/rebuild.md lists them. From there the weights are
found anew. Landmarks are read from --landmarks, else from SCAN's name with .landmarks.json, else found on the scan.
With the neutral's scan, painted markers that both have are followed, and scans of one size stay so.

OUT is an override layer over --personal with the expression as a shape called --name; `facepipe split-shapes` takes
it, as it is or corrected by hand. Exit code 1: done, but the face lies on the scan worse than the quality gate of
`facepipe database add` asks for, or the scan shows less of it.

examples:
  facepipe register-scan smile.ply --personal personal.usdc -o work/smile.usda --picture smile.png
  facepipe register-scan take7.ply --personal personal.usdc --name grin -o grin.usda \\
      --weights mouthSmileLeft=1 mouthSmileRight=1 jawOpen=0.2 --neutral-scan anna.ply
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.core.reports import table
from facepipe.declare import beside, named_numbers, option, source
from facepipe.kinds import Job, action
from facepipe.scanning.rebuild.declared import RegisterScansOptions, ScanAction, landmark_file

if TYPE_CHECKING:
    from facepipe.scanning.rebuild.register_scans import RegisterScanReport
    from facepipe.stage import Face

_STEPS = 18  # of a registration, at most
_WEIGHTS: Any = {"parse": named_numbers, "metavar": "SHAPE=WEIGHT", "words": True}


@action("register-scan", "put a person's face on the scan of an expression")
@dataclass(frozen=True, kw_only=True)
class RegisterScanAction(RegisterScansOptions, ScanAction["RegisterScanReport"]):
    """The action."""

    personal: Path = source("what `facepipe personal-template` made", flag="--personal", metavar="FACE")
    scan: Path = source("scan of an expression: .ply .obj .stl .off .glb .gltf or USD")
    landmarks: Path | None = source(
        "landmarks of the scan (default SCAN's .landmarks.json)", default=None, flag="--landmarks", metavar="JSON"
    )
    neutral_scan: Path | None = source(
        "scan that the neutral was fitted to", default=None, flag="--neutral-scan", metavar="SCAN"
    )
    neutral_landmarks: Path | None = source(
        "its landmarks (default its .landmarks.json)", default=None, flag="--neutral-landmarks", metavar="JSON"
    )
    composite: str = option("", "what the scan shows, as the table of composites has it", metavar="NAME", kept=False)
    weights: Mapping[str, float] = option(dict, "what the scan shows: shapes, weights above 0 up to 2", **_WEIGHTS)
    neutral_weights: Mapping[str, float] = option(
        dict, "what the neutral's scan shows besides, as `facepipe fit-neutral` found it", **_WEIGHTS
    )
    name: str = option("", "of the shape to author (default SCAN's name)")
    picture: Path | None = beside("draw scan, face and their distance", ".png", "draw")

    def __post_init__(self) -> None:
        super().__post_init__()
        from facepipe.core.names import identifier

        stem = Path(self.scan).stem
        values: dict[str, Any] = {"landmarks": landmark_file(self.scan, self.landmarks)}
        values["name"] = self.name or identifier(stem)
        if self.weights and self.composite and self.weights != self._composite(self.composite):
            raise InputError(f"--composite {self.composite}", "given with --weights, expected one of them")
        if not self.weights:
            values |= {"composite": self.composite or stem, "weights": self._composite(self.composite or stem)}
        if self.neutral_scan is not None:
            values["neutral_landmarks"] = landmark_file(self.neutral_scan, self.neutral_landmarks)
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _composite(self, name: str) -> dict[str, float]:
        from facepipe.scanning.rebuild.template import DEFAULT_COMPOSITES

        if name not in DEFAULT_COMPOSITES:
            where = f"--composite {name}" if self.composite else str(self.scan)
            expected = f"--weights, or --composite with one of {', '.join(DEFAULT_COMPOSITES)}"
            raise InputError(where, f"no composite of that name, expected {expected}")
        return dict(DEFAULT_COMPOSITES[name])

    @classmethod
    def line_values(cls, arguments: Any, values: dict[str, Any]) -> dict[str, Any]:
        if hasattr(arguments, "composite") and not hasattr(arguments, "weights"):
            values.pop("weights", None)  # of the recipe
        return super().line_values(arguments, values)

    def check(self) -> None:
        from facepipe.core.names import identifier

        super().check()
        for flag, value in (("landmarks", self.neutral_landmarks), ("weights", self.neutral_weights)):
            if value and self.neutral_scan is None:
                raise InputError(f"--neutral-{flag}", "expected --neutral-scan beside it")
        if self.name != identifier(self.name):
            raise InputError(f"--name {self.name}", "expected letters, digits and underscores, no digit first")

    def author(self, face: Face, job: Job) -> RegisterScanReport:
        import numpy as np

        from facepipe.core.tokens import SCANNED
        from facepipe.importers.scan_file import read_scan
        from facepipe.scanning.database import Quality, QualityLimits, misses
        from facepipe.scanning.rebuild.fit_neutral import NeutralScan
        from facepipe.scanning.rebuild.register_scans import ExpressionScan, placed_neutral, register_scan
        from facepipe.scanning.rebuild.scan_fit import draw_face_on_scan, landmarks_of, named
        from facepipe.scanning.rebuild.template import Template, expression_of, resolved
        from facepipe.verbs.author_neutral import AuthorNeutral
        from facepipe.verbs.whole_faces import whole_face

        parts = face.parts()
        whole, template = whole_face(parts, str(self.personal)), Template.of(parts, str(self.personal))
        if self.name in whole.deltas:
            raise InputError(f"{self.personal} -> {self.name}", "the face has such a shape, expected another --name")
        where = f"composite {self.composite}" if self.composite else "--weights"
        weights = resolved(self.weights, tuple(whole.deltas), where)
        scan = read_scan(self.scan)
        landmarks, landmark_notes = landmarks_of(self.landmarks, scan)
        neutral, notes, besides = NeutralScan(points=whole.points), tuple[str, ...](), None
        if self.neutral_scan is not None:
            if self.neutral_weights:
                shown = resolved(self.neutral_weights, tuple(whole.deltas), "--neutral-weights")
                besides = expression_of(whole.deltas, shown, len(whole.points))
            own_scan = read_scan(self.neutral_scan)
            own_landmarks, notes = landmarks_of(self.neutral_landmarks, own_scan)
            with named(self.neutral_scan):
                neutral = placed_neutral(template, whole.points, own_scan, own_landmarks, besides)
        given = ExpressionScan(scan=scan, landmarks=landmarks, weights=weights)
        with named(self.scan), job.watch("register", _STEPS) as bar:
            found, place, report = register_scan(
                template, neutral, whole.deltas, given, self, lambda step: bar.update()
            )
        fit = report.fit
        # What splitting asks for stands beside the shape: points that the scan showed, and in the recipe the weights.
        recipe = job.recipe(weights=found.weights, fit=asdict(fit))
        shapes, seen = {self.name: found.points - whole.points}, {SCANNED: found.matched.astype(np.float32)}
        authored = AuthorNeutral(shapes=shapes, primvars=seen)(face, whole.points, recipe=recipe)
        unused = ("markers are ignored without --neutral-scan",) if landmarks.markers and neutral.place is None else ()
        numbers = {name: getattr(fit, name) for name in ("surface_mean_mm", "surface_p95_mm", "coverage")}
        # triangles that turn over are counted of shapes, not of what is to be split into them
        missed = misses(Quality(**numbers, flipped_triangles=0), QualityLimits())
        return replace(
            report,
            warnings=(*landmark_notes, *notes, *unused, *report.warnings, *authored.warnings, *missed),
            missed=missed,
            picture=partial(draw_face_on_scan, template=template, points=found.points, scan=scan, place=place),
            name=self.name,
        )

    def text(self, report: RegisterScanReport, out: Path) -> str:
        from facepipe.scanning.rebuild.scan_fit import fit_rows

        beyond = f"mean {report.beyond_template_mean_mm:.2f} mm, at most {report.beyond_template_max_mm:.2f} mm"
        rows = [
            ("shape", report.name),
            ("weights", ", ".join(f"{shape} {weight:.2f}" for shape, weight in report.weights.items())),
            *fit_rows(report.fit),
            ("from the personal template's", beyond),
            ("steps", f"{report.fit.steps}"),
        ]
        return "\n".join([str(out), table(rows)])
