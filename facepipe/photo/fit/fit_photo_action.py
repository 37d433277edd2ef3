"""Fit a face to photos of a person: slider values, and the expression, camera and light of each photo.

FACE, the built-in head where none is given, has sliders and the 68 landmarks `multipie68` (`facepipe sliders`,
`facepipe landmarks`). Several photos show the same person and share the sliders. First landmarks are fitted, then the
picture, by gradient descent on the joint loss; that needs `pip install 'facepipe[train]'`.

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
camera, the overlay of mesh and landmarks, and the landmarks as JSON for --landmarks, to be mended by hand. --person
writes who it is as a payload of some hundred bytes (`facepipe person`), and needs no OUT. Exit code 1: done, but
landmarks or similarity miss their threshold, the person is like hardly anyone, or the loss was not finite and the best
until then is kept.

The recipe stays on the result. --edit fits again from it with what the line changes: FACE alone is another face, PHOTO
... FACE also other photos. Without -o that is in place (with --force), and anything else authored in that file is lost.

examples:
  facepipe fit-photo portrait.jpg head.usdc -o person.usdc --report person
  facepipe fit-photo selfie.heic --person me.fpb
  facepipe fit-photo front.jpg side.jpg head.usdc --landmarks front.json --landmarks side.json -o person.usdc
  facepipe fit-photo --edit person.usdc --iterations 400 --sparsity 0.1 --force
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.reports import Watch, table
from facepipe.declare import beside, option, source
from facepipe.kinds import Job, StageAction, action
from facepipe.photo.options import MODELS, LikenessOptions, PhotoFitOptions, PhotoTermOptions

if TYPE_CHECKING:
    from facepipe.core.arrays import FloatArray
    from facepipe.networks.onnx_file import Kind
    from facepipe.parts import FaceParts
    from facepipe.photo.descent.subject import PhotoFit
    from facepipe.photo.features.extractor import Extractor
    from facepipe.photo.fit.report import PhotoFitReport, PhotoInputs
    from facepipe.stage import Face

_SHOWN = 5  # names of a list
_HIDDEN = 0.5  # share of a region from which on it is named
_OFF = 0.01  # of a slider's range, or a weight: what counts as set
_TEXTURES = 2048  # texels a side of the built-in head's
_AT_LIMIT = 0.005  # of a slider's range
_NETWORK = "network for {}, .onnx or .pt2 (default facepipe's own)"
_REPORT = r"report\.(html|json)|[^/]+\.(landmarks\.json|render\.png|overlay\.png)"


def _indices(words: Sequence[str]) -> tuple[int, ...]:
    if not all(word.isascii() and word.isdecimal() and len(word) < 7 for word in words):
        raise InputError(" ".join(words), "expected whole numbers from 0")
    return tuple(map(int, words))


@action("fit-photo", "find a person's sliders in photos", remote=True)
@dataclass(frozen=True, kw_only=True)
class FitPhoto(PhotoTermOptions, LikenessOptions, StageAction["PhotoFitReport"]):
    """The action."""

    face: Path | None = source("face stage, after the photos (default the built-in head)", default=None)
    photos: tuple[Path, ...] = source("photos of one person, before the face", flag="PHOTO")
    landmarks: tuple[Path, ...] = source(
        "landmarks of a photo, in the order of the photos", default=(), flag="--landmarks", metavar="JSON"
    )
    landmarker: Path | None = source(
        "find landmarks by MediaPipe: its model face_landmarker.task", default=None, flag="--landmarker", metavar="TASK"
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
    person: Path | None = beside("payload of the person, as of `facepipe person`", ".fpb", "write_person", instead=True)

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
        from facepipe.core.images import PICTURE_SUFFIXES

        *photos, face = arguments.files
        if face.suffix.lower() in PICTURE_SUFFIXES:
            others = [photo for photo in photos if photo.suffix.lower() not in PICTURE_SUFFIXES]
            if others:
                raise InputError(face, f"comes after {others[0]}, expected photos before the face")
            return {**values, "photos": tuple(arguments.files)}
        return {**values, "face": face, **({"photos": tuple(photos)} if photos else {})}

    @property
    def base(self) -> Path:
        return self.photos[0] if self.face is None and self.photos else Path(self.face or "PHOTO")

    def made_base(self) -> tuple[FaceParts, tuple[str, ...]] | None:
        from facepipe.heads import make

        return (make(textures=_TEXTURES), ()) if self.face is None else None

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
        from facepipe.photo.fit.person_model import REACH, person_model
        from facepipe.photo.fit.report import Fitted, unseen_regions
        from facepipe.rig.conventions import ARKIT_SHAPES
        from facepipe.stage import Face
        from facepipe.verbs.person_basis import basis_of

        begin, recipe = time.perf_counter(), job.recipe()  # with the digests that files have before they are read
        inputs, parts, where = self._inputs(), face.parts(), str(self.face or face.where)
        if self.person is not None:
            basis_of(parts, where, database=self.database)  # refuses a face without one before the work
        model, identity = None if self.start else person_model(parts, where, self.database), None
        if model is None:
            fit = self._fit(parts, inputs, job.watch)
        else:
            import numpy as np

            from facepipe.photo.descent.subject import Subject

            # the modes of identity are fitted; then the person is the neutral, in terms of the face's own sliders
            sliders = Subject.of(model.parts, self.expressions).free_sliders
            free = ARKIT_SHAPES if self.expressions is None else frozenset(self.expressions)
            fit = self._fit(model.fit_parts(free), inputs, job.watch, 1 / (2 * REACH))
            weights = np.array([fit.sliders[name] for name in model.names])
            values, identity = model.author(face, weights, sliders)
            fit, face = replace(fit, sliders=values), Face(face.stage, face.prim)
        # sliders over modes that were not fitted were of whom the face was before
        others = {slider.name: slider.default for slider in parts.sliders if slider.modes}
        fit = replace(fit, sliders={**others, **fit.sliders})
        report = AuthorPhotoFit()(face, fit, inputs.photos, recipe=recipe)
        fitted = Fitted(parts=face.with_identity(fit.sliders).parts(), fit=fit, inputs=inputs)
        unseen = unseen_regions(fitted)
        at_limit = []  # sliders that the fit moved from their default to an end of their range
        for slider in parts.sliders:
            value, reach = report.sliders.get(slider.name, slider.default), slider.maximum - slider.minimum
            end = min(value - slider.minimum, slider.maximum - value) <= _AT_LIMIT * reach
            if end and abs(value - slider.default) > _AT_LIMIT * reach:
                at_limit.append(slider.name)
        report = replace(report, identity=identity, unseen=unseen, at_limit=tuple(at_limit), fitted=fitted)
        if self.identity_model is not None:
            from facepipe.photo.features.extractor import similarity

            network = inputs.extractors["identity"]
            photos = {
                name: replace(photo, similarity=similarity(network, shown.photo, shown.render, shown.targets))
                for (name, photo), shown in zip(report.photos.items(), fitted.sheet.photos, strict=True)
            }
            weight = self.with_networks(inputs.extractors).identity
            report = replace(report, photos=photos, similarity_fitted=bool(weight and fit.steps))
        warnings = (*inputs.warnings, *report.warnings, *self._misses(report))
        return replace(report, warnings=warnings, seconds=time.perf_counter() - begin)

    def _inputs(self) -> PhotoInputs:
        """Photos, where their landmarks are, and the networks that compare them."""
        from facepipe.photo.fit.photo_file import read_photo
        from facepipe.photo.fit.photo_landmarks import mediapipe_landmarks, own_landmarks, read_landmarks
        from facepipe.photo.fit.report import PhotoInputs

        photos = [read_photo(path) for path in self.photos]
        faces = self.faces if len(self.faces) != 1 else self.faces * len(photos)
        landmarks = []
        for number, photo in enumerate(photos):
            index = faces[number] if faces else None
            if self.landmarks:
                landmarks.append(read_landmarks(self.landmarks[number], photo, index=index))
            elif self.landmarker is not None:
                landmarks.append(mediapipe_landmarks(photo, self.landmarker, index=index))
            else:
                landmarks.append(own_landmarks(photo, index=index))
        warnings = [f"{photo.path}: {line}" for photo in photos for line in photo.warnings]
        warnings += [
            f"{photo.path}: {line}" for photo, each in zip(photos, landmarks, strict=True) for line in each.warnings
        ]
        from facepipe.photo.features.extractor import load_extractor, own_extractors

        paths = {kind: getattr(self, name) for name, kind in MODELS.items()}
        given: dict[Kind, Extractor] = {
            kind: load_extractor(path, kind) for kind, path in paths.items() if path is not None
        }
        missing = [kind for kind in MODELS.values() if kind not in given and getattr(self, kind)]
        if missing and self.iterations:  # facepipe's own for the other terms that are on
            given = {**own_extractors(missing), **given}
        return PhotoInputs(photos, landmarks, given, tuple(warnings))

    def _fit(self, parts: FaceParts, inputs: PhotoInputs, watch: Watch, slider_sigma: float | None = None) -> PhotoFit:
        """The face fitted to the photos, with where their pupils are; `slider_sigma` as for `fit_photos`."""
        import numpy as np

        from facepipe.networks.files import face_mask
        from facepipe.photo.descent.fit import fit_photos, pose_space
        from facepipe.photo.descent.landmark_rig import dense_points
        from facepipe.photo.descent.subject import Subject

        pixels, marks, start = [photo.pixels for photo in inputs.photos], inputs.landmarks, None
        if self.start is not None:
            from facepipe.photo.amortised.guess import load_start

            try:
                subject = Subject.of(parts, self.expressions)
                spaces = [pose_space(subject, photo.shape[1], photo.shape[0]) for photo in pixels]
            except FacepipeError as error:
                raise error.under(self.face or self.base) from None
            start = load_start(self.start, subject).together(pixels, [each.points for each in marks], spaces)
        terms = {field.name: getattr(self, field.name) for field in fields(PhotoTermOptions)}
        options = PhotoFitOptions(**terms, landmarks=self.landmark_weight)
        # dense landmarks that were found count where the face has as many
        count = len(dense_points(parts))
        known = [(each, slice(0, count if len(each.dense) == count else 0)) for each in marks]
        try:
            with watch("fit", self.iterations) as bar:

                def stepped(draw: Callable[[], FloatArray]) -> None:
                    bar.show(lambda: _jpeg(draw()))
                    bar.update()

                fit = fit_photos(
                    parts,
                    pixels,
                    [np.vstack([each.points, each.dense[some]]) for each, some in known],
                    options,
                    confidences=[np.append(each.confidence, each.dense_confidence[some]) for each, some in known],
                    expressions=self.expressions,
                    extractors=inputs.extractors,
                    start=start,
                    slider_sigma=slider_sigma,
                    mask=lambda photo, points: face_mask(np.asarray(photo, np.float32), points).face,
                    done=stepped,
                )
            views = zip(fit.views, marks, strict=True)
            return replace(fit, views=tuple(replace(view, pupils=each.pupils) for view, each in views))
        except FacepipeError as error:
            raise error.under(self.face or self.base) from None

    def missed(self, report: PhotoFitReport) -> bool:
        return report.missed or bool(self._misses(report))

    def _misses(self, report: PhotoFitReport) -> list[str]:
        """A line for each threshold that is missed, and one where the person is like hardly anyone."""
        lines = [
            f"{name}: landmarks off by {photo.percent:.1f} % of the distance of the outer eye corners, "
            f"expected at most {self.landmark_threshold:g} %"
            for name, photo in report.photos.items()
            if photo.percent > self.landmark_threshold
        ]
        person = report.identity
        if person is not None and person.deviations > person.usual:
            found = f"{person.deviations:.2f} standard deviations (root mean square over {person.modes} modes)"
            lines.append(f"the person is {found} from the average, expected at most {person.usual:.2f}")
        return lines + self.unlike(report.similarities)

    def write_report(self, face: Face, report: PhotoFitReport, path: Path) -> None:
        """The folder of the report."""
        from facepipe.photo.fit.report import write_folder

        write_folder(path, report.fitted, report)

    def write_person(self, face: Face, report: PhotoFitReport, path: Path) -> dict[str, Any]:
        """The payload, and what it leaves of the person."""
        from facepipe.core.atomic import write_bytes
        from facepipe.verbs.person import encoded_person

        where = str(self.face or face.where)
        data, told = encoded_person(face.parts(), where, database=self.database)
        write_bytes(path, data)
        return {"bytes": len(data), "mean_mm": told.mean_mm, "max_mm": told.max_mm}

    def text(self, report: PhotoFitReport, out: Path) -> str:
        from facepipe.photo.fit.report import ENDS

        count = len(report.photos)
        total = report.losses.get("total")
        loss = f", loss {total.first:.4g} to {total.last:.4g}" if total and report.steps else ""
        steps = f"{report.steps} steps in {report.seconds:.1f} s"
        head = f"{out}: {count} photo{'s' * (count != 1)}, {steps}, {ENDS[report.stopped]}{loss}"
        judged = any(value is not None for value in report.similarities.values())
        titles = [
            "landmarks off by",
            "pixels",
            "of the outer eye corners' distance",
            *["similarity"] * judged,
            "expression",
        ]
        rows: list[list[object]] = [[*titles]]
        for name, photo in report.photos.items():
            alike = [] if not judged else ["none" if photo.similarity is None else f"{photo.similarity:.3f}"]
            figures = (f"{photo.landmark_error_px:.2f}", f"{photo.percent:.1f} %", *alike)
            rows.append([name, *figures, _largest(photo.expressions, {})])
        ranges = {slider.name: slider for slider in report.fitted.parts.sliders}
        off = {name: value - ranges[name].default for name, value in report.sliders.items()}
        spans = {name: ranges[name].maximum - ranges[name].minimum for name in off}
        moved = sum(abs(value) > _OFF * spans[name] for name, value in off.items())
        last = f"{moved} of {len(off)} sliders off their defaults: {_largest(off, spans, report.sliders)}"
        lines = [head, table(rows), last]
        if report.identity is not None:
            one = report.identity
            where = f"a section of {one.section_bytes} bytes" if one.section_bytes else "the neutral"
            beyond = f", and leaves {one.beyond_section_mean_mm:.2f} mm" if one.section_bytes else ""
            lines.append(
                f"sliders leave {one.beyond_sliders_mean_mm:.2f} mm of the person (mean), at most "
                f"{one.beyond_sliders_max_mm:.2f} mm, which is in {where}{beyond}"
            )
        if judged and report.similarity_fitted:
            lines.append("the similarity is to a network that the fit was drawn to: --identity 0 keeps them apart")
        if report.at_limit:
            lines.append(f"sliders at a limit: {_some(report.at_limit)}")
        hidden = [f"{name} {share:.0%}" for name, share in report.unseen.items() if share >= _HIDDEN]
        if hidden:
            lines.append(f"no photo shows: {', '.join(hidden)}")
        if report.beyond_limits:
            lines.append(f"beyond bone limits: {_some(report.beyond_limits)}")
        return "\n".join(lines)


def _jpeg(image: FloatArray) -> bytes:
    """(h, w, 3) sRGB 0..1 for somebody who watches."""
    from io import BytesIO

    import numpy as np
    from PIL import Image

    file = BytesIO()
    Image.fromarray(np.rint(image * 255).astype(np.uint8)).save(file, "JPEG", quality=80)
    return file.getvalue()


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")


def _largest(off: Mapping[str, float], spans: Mapping[str, float], values: Mapping[str, float] | None = None) -> str:
    """The names that are furthest off, with their values."""
    shares = {name: abs(value) / max(spans.get(name, 1.0), 1e-9) for name, value in off.items()}
    order = sorted((name for name, share in shares.items() if share > _OFF), key=lambda name: (-shares[name], name))
    shown = ", ".join(f"{name} {(values or off)[name]:.2f}" for name in order[:_SHOWN])
    return (shown + (", ..." if len(order) > _SHOWN else "")) or "none"
