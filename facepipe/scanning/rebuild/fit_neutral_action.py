"""Fit a template's neutral to the scan of a person: the person's own face on the template's topology.

SCAN is a mesh or a cloud of points (.ply .obj .stl .off .glb .gltf or USD), of any pose and unit, whole or in part.
A folder of photos around a face is scanned first, as `facepipe scan` does by default (`pip install 'facepipe[scan]'`).
Without --template it becomes the built-in head, textured and ready for use: with -o person.glb for the engine at once.
Eyes, teeth and what no scan shows follow the model of the database and the skin around. Landmarks (multipie68, in the
scan's own coordinates) are read from --landmarks, else from SCAN's name with .landmarks.json, else found on the scan.
{"points": [[x, y, z] | null, ... 68]} names 6 or more of them.

The neutral has open eyes and a mouth at rest. Shut eyes are seen by their landmarks and opened. Where SCAN shows
something else, --weights says so with the template's shapes; the neutral is without them, the picture with them.

OUT is an override layer over the template, whose blendshapes, rig, regions, materials and sliders it keeps; joints
move with the skin. --flatten writes a standalone file, as one on the built-in head is. --picture shows scan, face and
their distance. Exit code 1: done, but a limit of the quality gate of `facepipe database add` is missed.

examples:
  facepipe fit-neutral anna.glb -o anna_face.glb
  facepipe fit-neutral photos/ -o anna.glb
  facepipe fit-neutral anna.ply --template head.usdc --database faces.fpdb -o anna.usdc --picture anna.png
  facepipe fit-neutral ben.ply -o ben.usdc --unit cm --weights mouthSmileLeft=0.5 mouthSmileRight=0.5
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.core.reports import table
from facepipe.declare import beside, named_numbers, option, source, to_json
from facepipe.kinds import Job, action
from facepipe.scanning.rebuild.declared import BakeScanOptions, FitNeutralOptions, ScanAction, landmark_file

if TYPE_CHECKING:
    from facepipe.parts import FaceParts
    from facepipe.scanning.rebuild.fit_neutral import FitNeutralReport
    from facepipe.scanning.rebuild.scan_fit import Given
    from facepipe.stage import Face

_STEPS = 18  # of a fit, at most
_TEXTURES = 2048  # texels a side of the built-in head's


@dataclass(frozen=True, kw_only=True)
class TemplateAction(FitNeutralOptions, BakeScanOptions, ScanAction["FitNeutralReport"]):
    """Base of the actions that put a template's neutral on something."""

    template: Path | None = source(
        "face stage; landmarks that it lacks are found on it (default the built-in head)",
        default=None,
        flag="--template",
        metavar="FACE",
    )


@dataclass(frozen=True, kw_only=True)
class FittingAction(TemplateAction):
    """Base of the actions that fit it to what is scanned or modelled, whose field comes after the template's."""

    database: Path | None = source(
        "faces of the template's topology: .fpdb (default how people differ from the built-in head)",
        default=None,
        flag="--database",
        metavar="FPDB",
    )
    landmarks: Path | None = source(
        "landmarks of the scan (default SCAN's .landmarks.json)", default=None, flag="--landmarks", metavar="JSON"
    )
    weights: Mapping[str, float] = option(
        dict,
        "shapes that the scan shows besides the neutral, weights above 0 up to 2",
        parse=named_numbers,
        metavar="SHAPE=WEIGHT",
        words=True,
    )
    open_eyes: bool = option(True, "open eyes whose lids the landmarks show shut, where no --weights are given")
    close_lips: bool = option(True, "close lips whose landmarks meet: of their rims, scans show nothing")
    picture: Path | None = beside("draw scan, face and their distance", ".png", "draw")

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "landmarks", landmark_file(self.fitted, self.landmarks))

    @property
    @abstractmethod
    def fitted(self) -> Path:
        """The file or folder that the template is fitted to."""

    @abstractmethod
    def given(self, job: Job) -> Given:
        """The scan, its landmarks, what is to be said of both, and what photos of it say."""

    @property
    def base(self) -> Path:
        return self.fitted if self.template is None else Path(self.template)

    def made_base(self) -> tuple[FaceParts, tuple[str, ...]] | None:
        from facepipe.heads import make

        return (make(textures=_TEXTURES), ()) if self.template is None else None

    def author(self, face: Face, job: Job) -> FitNeutralReport:
        from facepipe.heads.assembly import settled
        from facepipe.scanning.database import QualityLimits, load_database, misses
        from facepipe.scanning.rebuild.built_in_head import bare_head, with_inside_fitted
        from facepipe.scanning.rebuild.fit_neutral import are_sealed, fit_neutral, shut_eyes, with_sealed_lips
        from facepipe.scanning.rebuild.scan_fit import draw_face_on_scan, named
        from facepipe.scanning.rebuild.template import Template
        from facepipe.scanning.texture import author_scan_textures
        from facepipe.scanning.transfer.marks import with_landmarks
        from facepipe.scanning.transfer.people import people_of
        from facepipe.verbs.author_neutral import AuthorNeutral

        where = str(self.template or face.where)
        with job.watch("template", 1) as bar:
            parts, found = with_landmarks(face.parts(), where)
            bar.update()
        template, own = Template.of(parts, where), bare_head(parts)
        # Fitted without hair and lashes, which go with the skin after it.
        body, database = people_of(template, None if self.database is None else load_database(self.database), own)
        scan, landmarks, notes, photos = self.given(job)
        weights = self.weights or (shut_eyes(landmarks, parts.shapes) if self.open_eyes else {})
        with named(self.fitted), job.watch("fit", _STEPS) as bar:
            fit, place, report = fit_neutral(body, scan, landmarks, database, self, lambda step: bar.update(), weights)
        points = fit.points
        if self.close_lips and are_sealed(landmarks):
            points = with_sealed_lips(body, points)
        points = template.dressed(body, points if own is None else with_inside_fitted(points))
        shown = template.dressed(body, fit.shown)
        recipe = job.recipe(quality=to_json(report.quality), weights=report.weights)
        author = AuthorNeutral() if own is None else AuthorNeutral(settled=partial(settled, parts))
        authored = author(face, points, recipe=recipe)
        with named(self.fitted), job.watch("textures", 1) as bar:
            baked = author_scan_textures(face, parts, shown, scan, place, self)
            bar.update()
        neutral = points if report.weights else None
        missed = misses(report.quality, QualityLimits())
        return replace(
            report,
            warnings=(*found, *notes, *report.warnings, *authored.warnings, *baked.warnings, *missed),
            missed=missed,
            picture=partial(
                draw_face_on_scan, template=template, points=shown, scan=scan, place=place, neutral=neutral
            ),
            textures=baked.textures,
            colored=baked.colored,
            hidden=baked.hidden,
            photos=photos,
            place=place,
        )

    def text(self, report: FitNeutralReport, out: Path) -> str:
        from facepipe.scanning.rebuild.scan_fit import fit_rows, slid_text

        fit, photos = report.fit, report.photos
        unit = f"{fit.mm_per_unit:.4g} mm" + (f" ({fit.unit})" if fit.unit and fit.unit != "mm" else "")
        besides = ", ".join(f"{shape} {weight:.2f}" for shape, weight in report.weights.items())
        rows = [
            *([("photos", f"{len(photos['photos_used'])} used")] if photos else []),
            *fit_rows(fit),
            *([("slid along the surface", slid_text(fit.slid_mm))] if fit.slid_mm else []),
            *([("shows besides", besides)] if besides else []),
            ("beyond the model", f"mean {report.residual_mean_mm:.2f} mm, at most {report.residual_max_mm:.2f} mm"),
            *([("shapes of its own", f"{len(report.own_shapes)}")] if report.own_shapes else []),
            ("flipped triangles", f"{report.quality.flipped_triangles}"),
            ("a unit of the scan", unit),
            ("steps", f"{fit.steps}"),
            *([("skin in the scan's colours", f"{100 * report.colored:.1f} %")] if report.textures else []),
        ]
        return "\n".join([str(out), table(rows)])


@dataclass(frozen=True, kw_only=True)
class _OfScan(TemplateAction):
    """A recipe names its scan before the database, as it did before there was `facepipe conform`."""

    scan: Path = source("scan of the neutral: .ply .obj .stl .off .glb .gltf or USD; or a folder of 5 or more photos")


@action("fit-neutral", "fit a face to the scan of a person", remote=True)
@dataclass(frozen=True, kw_only=True)
class FitNeutralAction(FittingAction, _OfScan):
    """The action."""

    @property
    def fitted(self) -> Path:
        return Path(self.scan)

    def check(self) -> None:
        from facepipe.scanning.photos import photo_files

        super().check()
        if Path(self.scan).is_dir():
            photo_files(Path(self.scan))
            if self.unit != "auto":
                raise InputError(f"--unit {self.unit}", "photos have no unit, expected auto")

    def given(self, job: Job) -> Given:
        from facepipe.scanning.rebuild.scan_fit import scan_input

        return scan_input(Path(self.scan), self.landmarks, job.watch)
