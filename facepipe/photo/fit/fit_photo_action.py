"""Fit a face to photos of a person: slider values, and the expression, camera and light of each photo.

FACE has sliders and the 68 landmarks `multipie68` (`facepipe sliders`, `facepipe landmarks`). Several photos show the
same person and share the sliders. First landmarks are fitted, then the picture, by gradient descent on the joint loss;
that needs `pip install 'facepipe[train]'`.

The photos' landmarks come from JSON files (--landmarks, one a photo, in order; 68 places or MediaPipe's 478), from
MediaPipe (--landmarker) or, with neither, from facepipe's own network. Where a photo shows several faces, --face says
which: from 0, the largest first; of a JSON file in its order.

Who a person may be: where FACE has modes of identity, those of the built-in head or of the faces of --database, the fit
is over these, and what no photo shows stays what is likeliest. FACE's own sliders then have the values that stand for
most of the person, and its neutral what they leave. Other faces, and those with --start, are fitted by their sliders.

Features that photo and render are compared by come from facepipe's own networks, trained on synthetic heads, or from
models of yours: ONNX, or torch.export programs from people you trust. With an --identity-model the report says how
like each photo the render in its camera and light is to that network, where both show the face; --identity 0 keeps it
out of the fit, as a judge.

OUT is an override layer over FACE and needs that file; hand on what --flatten writes. It holds the slider values, which
can be set further (`facepipe sliders`), the neutral, which its skeleton plays, and for each photo a camera and the pose
with the photo's expression. --report makes a folder: report.html, report.json, and for each photo the render from its
camera, the overlay of mesh and landmarks, and the landmarks as JSON for --landmarks, to be mended by hand. Exit code 1:
done, but landmarks or similarity miss their threshold, the person is like hardly anyone, or the loss was not finite and
the best until then is kept.

The recipe stays on the result. --edit fits again from it with what the line changes: FACE alone is another face, PHOTO
... FACE also other photos. Without -o that is in place (with --force), and anything else authored in that file is lost.

examples:
  facepipe fit-photo portrait.jpg head.usda -o person.usda --report person
  facepipe fit-photo front.jpg side.jpg head.usda --landmarks front.json --landmarks side.json -o person.usda
  facepipe fit-photo --edit person.usda --iterations 400 --sparsity 0.1 --force
"""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.declare import beside, option, source
from facepipe.kinds import Job, StageAction, action
from facepipe.photo.options import LikenessOptions, PhotoFitOptions, PhotoTermOptions

if TYPE_CHECKING:
    from facepipe.photo.fit.report import PhotoFitReport
    from facepipe.stage import Face

_NETWORK = "network for {}, .onnx or .pt2 (default facepipe's own)"
_REPORT = r"report\.(html|json)|[^/]+\.(landmarks\.json|render\.png|overlay\.png)"


def _indices(words: Sequence[str]) -> tuple[int, ...]:
    if not all(word.isascii() and word.isdecimal() and len(word) < 7 for word in words):
        raise InputError(" ".join(words), "expected whole numbers from 0")
    return tuple(map(int, words))


@action("fit-photo", "find a person's sliders in photos")
@dataclass(frozen=True, kw_only=True)
class FitPhoto(PhotoTermOptions, LikenessOptions, StageAction["PhotoFitReport"]):
    """The action."""

    face: Path = source("face stage, after the photos")
    photos: tuple[Path, ...] = source("photos of one person, before the face", flag="PHOTO")
    landmarks: tuple[Path, ...] = source(
        "landmarks of a photo, in the order of the photos", default=(), flag="--landmarks", metavar="JSON"
    )
    landmarker: Path | None = source(
        "find landmarks by MediaPipe: its model face_landmarker.task",
        default=None,
        flag="--landmarker",
        metavar="TASK",
    )
    database: Path | None = source(
        "faces of FACE's topology: who a person may be (default for the built-in head its own modes)",
        default=None,
        flag="--database",
        metavar="FPDB",
    )
    content_model: Path | None = source(
        _NETWORK.format("content"), default=None, flag="--content-model", metavar="FILE"
    )
    identity_model: Path | None = source(
        _NETWORK.format("identity"), default=None, flag="--identity-model", metavar="FILE"
    )
    attribute_model: Path | None = source(
        _NETWORK.format("attributes"), default=None, flag="--attribute-model", metavar="FILE"
    )
    start: Path | None = source(
        "network of `facepipe train-photo` for FACE, which guesses where to start",
        default=None,
        flag="--start",
        metavar="FILE",
    )
    faces: tuple[int, ...] = option(
        (), "which of several faces, from 0; once, or for each photo", flag="--face", metavar="INDEX", parse=_indices
    )
    expressions: tuple[str, ...] | None = option(
        None, "shape that is an expression (default those with ARKit's names)", flag="--expression", metavar="NAME"
    )
    landmark_threshold: float = option(
        8.0,
        "mean error, percent of the distance of the outer eye corners, above which the exit code is 1",
        1e-6,
        1e6,
        metavar="PERCENT",
    )
    landmark_weight: float = option(1.0, "weight of the landmarks", 0.0, 1e6)
    report: Path | None = beside("folder to make: report, pictures, landmarks", "", "write_report", holds=_REPORT)

    own_flags = ("face", "photos")  # words without a flag, of which the last is the face

    @classmethod
    def add_flags(cls, parser: Any) -> None:
        text = "photos of one person, then the face stage"
        parser.add_argument("files", nargs="*", type=Path, metavar="PHOTO ... FACE", help=text)

    @classmethod
    def replaced(cls, arguments: Any) -> Collection[str]:
        names = ["face"] if arguments.files else []
        names += ["photos", "landmarks", "faces"] if len(arguments.files) > 1 else []
        for one, other in (("landmarks", "landmarker"), ("landmarker", "landmarks")):
            names += [other] if getattr(arguments, one, None) else []
        return names

    @classmethod
    def line_values(cls, arguments: Any, values: dict[str, Any]) -> dict[str, Any]:
        if not arguments.files:
            return values
        *photos, face = arguments.files
        return {**values, "face": face, **({"photos": tuple(photos)} if photos else {})}

    @property
    def options(self) -> PhotoFitOptions:
        """The options of the fit."""
        terms = {field.name: getattr(self, field.name) for field in fields(PhotoTermOptions)}
        return PhotoFitOptions(**terms, landmarks=self.landmark_weight)

    def check(self) -> None:
        super().check()
        places, count = [photo.resolve() for photo in self.photos], len(self.photos)
        twice = next((photo for number, photo in enumerate(self.photos) if places[number] in places[:number]), None)
        if not count or twice is not None:
            raise InputError("PHOTO", "none given, expected one or more" if twice is None else f"{twice} given twice")
        if self.landmarks and self.landmarker is not None:
            raise InputError("--landmarks", "given with --landmarker, expected only one of them")
        if self.start is not None and self.database is not None:
            raise InputError("--start", "given with --database, expected only one of them: it guesses FACE's sliders")
        self.check_judge(self.identity_model)
        if len(self.landmarks) not in (0, count):
            expected = f"expected {count}: one for each photo, in their order"
            raise InputError("--landmarks", f"{len(self.landmarks)} given, {expected}")
        if len(self.faces) not in (0, 1, count):
            raise InputError("--face", f"{len(self.faces)} given, expected one, or {count}: one for each photo")

    def author(self, face: Face, job: Job) -> PhotoFitReport:
        from facepipe.photo.fit.author import AuthorPhotoFit
        from facepipe.photo.fit.fit_face import Fitted, fit_face, fit_person, read_inputs
        from facepipe.photo.fit.person_model import person_model
        from facepipe.photo.fit.report import sliders_at_limit, unseen_regions, with_similarities
        from facepipe.stage import Face

        begin, recipe = time.perf_counter(), job.recipe()  # with the digests that files have before they are read
        inputs, parts = read_inputs(self), face.parts()
        model = None if self.start else person_model(parts, str(self.face), self.database)
        if model is None:
            fit, identity = fit_face(self, parts, inputs, job.watch), None
        else:
            fit, identity = fit_person(self, model, face, inputs, job.watch)
            face = Face(face.stage, face.prim)  # with the person
        report = AuthorPhotoFit()(face, fit, inputs.photos, recipe=recipe)
        fitted = Fitted(parts=parts if model is None else face.parts(), fit=fit, inputs=inputs)
        report = replace(
            report,
            identity=identity,
            unseen=unseen_regions(fitted),
            at_limit=sliders_at_limit(parts.sliders, report),
            fitted=fitted,
        )
        if self.identity_model is not None:
            report = with_similarities(report, fitted, inputs.extractors["identity"])
            report = replace(report, similarity_fitted=bool(self.identity and fit.steps))
        warnings = (*inputs.warnings, *report.warnings, *self._misses(report))
        return replace(report, warnings=warnings, seconds=time.perf_counter() - begin)

    def missed(self, report: PhotoFitReport) -> bool:
        return report.missed or bool(self._misses(report))

    def _misses(self, report: PhotoFitReport) -> list[str]:
        """A line for each threshold that is missed."""
        from facepipe.photo.fit.report import implausible, off_landmarks, unlike

        off = off_landmarks(report, self.landmark_threshold)
        return [*off, *implausible(report), *unlike(report.similarities, self.similarity_threshold)]

    def write_report(self, face: Face, report: PhotoFitReport, path: Path) -> None:
        """The folder of the report."""
        from facepipe.photo.fit.report import write_folder

        write_folder(path, report.fitted, report)

    def text(self, report: PhotoFitReport, out: Path) -> str:
        from facepipe.photo.fit.report import as_text

        return as_text(out, report, report.fitted.parts.sliders)
