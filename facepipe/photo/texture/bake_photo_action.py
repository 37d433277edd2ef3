"""Bake the colours of photos to the textures of a fitted face, without the photos' light.

STAGE is what `facepipe fit-photo` wrote: it has the camera, the light and the pose of each photo. Every texel of the
skin's colours is looked up in the photos that see it, and divided by the light that falls there. Hair, glasses, hands,
clothes and what is behind stay off, as do the insides of mouth and eyes; highlights and shadows are evened. What no
photo shows is taken from the other side of the face, else from the texture that the face had, without a seam.

OUT is an override layer over STAGE, with PNGs beside it for the materials of the skin. The light of the photos on it is
that which the colours were found with, as bright and as white as photos are exposed. Cards of brows are made
transparent where the photos' brows are on the skin. Cards of hair, and the scalp below them, get the colour of the hair
that the photos show, and hair of the built-in head gets the style that comes nearest to it.

--report makes a folder: report.html with each photo beside the textured face in its camera and light, the neutral in
studio light from three sides and the textures; report.json; and these renders. With an --identity-model the report says
how like its photo each render is to that network. Exit code 1: done, but that misses the threshold.

examples:
  facepipe bake-photo person.usdc portrait.jpg -o textured.usdc
  facepipe bake-photo person.usdc front.jpg left.jpg right.jpg -o textured.usdc --size 1024
  facepipe bake-photo person.usdc portrait.jpg -o textured.usdc --report textured --identity-model arcface.onnx
  facepipe export textured.usdc -o person.glb
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.core.reports import table
from facepipe.declare import beside, option, source
from facepipe.kinds import Job, StageAction, action
from facepipe.photo.options import LikenessOptions

if TYPE_CHECKING:
    from facepipe.photo.texture.author import BakePhotoReport
    from facepipe.stage import Face

_REPORT = r"report\.(html|json)|[^/]+\.render\.png"


@action("bake-photo", "bake the colours of photos to a fitted face", remote=True)
@dataclass(frozen=True, kw_only=True)
class BakePhoto(LikenessOptions, StageAction["BakePhotoReport"]):
    """The action."""

    stage: Path = source("face stage that was fitted to the photos")
    photos: tuple[Path, ...] = source("photos that it was fitted to, one or more")
    size: int | None = option(None, "size of the textures (default that of those they replace)", 64, 4096, "texels")

    identity_model: Path | None = source(
        "recognition network that judges how like the photos the result is, .onnx or .pt2",
        default=None,
        flag="--identity-model",
        metavar="FILE",
    )
    report: Path | None = beside("folder to make: report and pictures", "", "write_report", holds=_REPORT)

    def check(self) -> None:
        super().check()
        self.check_judge(self.identity_model)
        names = [photo.name for photo in self.photos]
        if not names:
            raise InputError("PHOTO", "none given, expected one or more")
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InputError("PHOTO", f"two called {twice}, expected photos of different names")

    def author(self, face: Face, job: Job) -> BakePhotoReport:
        from facepipe.photo.texture.author import author_textures, bake_sheet

        begin, recipe = time.perf_counter(), job.recipe()  # with the digests that files have before they are read
        network = None
        if self.identity_model is not None:
            from facepipe.photo.features.extractor import load_extractor, similarity

            network = load_extractor(self.identity_model, "identity")
        pairs = []
        for photo in self.photos:
            view = next((view for view in face.photos if view.image == photo.name), None)
            if view is None:
                known = ", ".join(view.image for view in face.photos) or "none"
                raise InputError(photo, f"no photo that {face.where} was fitted to, expected one of {known}")
            pairs.append((view, photo))
        report = author_textures(face, pairs, self.size, recipe, job.watch)
        if network is not None or self.report is not None:
            report = replace(report, sheet=bake_sheet(face, pairs))
        if network is not None:
            alike = {
                shown.view.image: similarity(network, shown.photo, shown.render, shown.landmarks)
                for shown in report.sheet.photos
            }
            report = replace(report, similarities=alike)
        warnings = (*report.warnings, *self.unlike(report.similarities))
        return replace(report, warnings=warnings, seconds=time.perf_counter() - begin)

    def missed(self, report: BakePhotoReport) -> bool:
        return bool(self.unlike(report.similarities))

    def write_report(self, face: Face, report: BakePhotoReport, path: Path) -> None:
        """The folder of the report."""
        from facepipe.photo.texture.author import write_folder

        write_folder(path, report)

    def text(self, report: BakePhotoReport, out: Path) -> str:
        alike = {name: "none" if value is None else f"{value:.3f}" for name, value in report.similarities.items()}
        rows = [("photo", "face that it shows", *(["similarity"] if alike else []))]
        rows += [(name, f"{share:.0%}", *([alike[name]] if alike else [])) for name, share in report.photos.items()]
        hair = "" if report.hair_style is None else f"\nhair: {report.hair_style}"
        return f"{out}: {', '.join(report.textures)} in {report.seconds:.1f} s\n{table(rows)}{hair}"
