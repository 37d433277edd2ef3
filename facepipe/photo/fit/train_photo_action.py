"""Train a network that guesses where `facepipe fit-photo` should start, for one face.

FACE has sliders and the 68 landmarks `multipie68`. The network sees a crop of a face, 128 pixels a side, and its
landmarks, and gives sliders, expression and pose. It learns these from random people of FACE: from their landmarks,
then from renders in random light and colours; then, without known answers, from the joint loss of a photo fit.
--images DIR takes photos of people for that last part: nothing needs to be known about them but where the landmarks
are, PHOTO.landmarks.json or STEM.landmarks.json beside a photo or found by facepipe's own network. Photos without a
face, or with several, are left out, with a warning.

OUT is one ONNX file; what it was trained on and its joint loss on pictures that it never saw are in its metadata
`facepipe.photo`. It is for faces with the same sliders and expressions. Training takes minutes on one core; the same
line gives the same file. It needs `pip install 'facepipe[train]'`.

examples:
  facepipe train-photo head.usdc -o start.onnx
  facepipe fit-photo portrait.jpg head.usdc -o person.usdc --start start.onnx --iterations 20 --rate 0.1
  facepipe train-photo head.usdc -o start.onnx --images people --steps 400
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.reading import file_beside, files_in
from facepipe.core.reports import Report, not_in_json, table
from facepipe.declare import option, source
from facepipe.kinds import FileAction, Job, action
from facepipe.photo.options import StartOptions

if TYPE_CHECKING:
    from facepipe.photo.amortised.pictures import Picture
    from facepipe.photo.descent.subject import Subject

_SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".avif", ".jp2", ".ppm", ".tga"))


@dataclass(frozen=True, kw_only=True)
class TrainPhotoReport(Report):
    """What a network was trained on, and how good it is."""

    seconds: float
    photos: int  # 0: renders alone
    held_out: Mapping[str, Any]  # pictures, and terms of the joint loss before and after, means over these
    training: str  # the command line, without the names of files
    doubtful: bool = not_in_json()  # whether the training itself warns


@action("train-photo", "train a network that guesses where a photo fit starts")
@dataclass(frozen=True, kw_only=True)
class TrainPhoto(StartOptions, FileAction[TrainPhotoReport]):
    """The action."""

    output = "network to write: .onnx"
    suffixes = (".onnx",)

    face: Path = source("face stage")
    images: Path | None = source("photos of people, for the joint loss", default=None, flag="--images", metavar="DIR")
    expressions: tuple[str, ...] | None = option(
        None, "shape that is an expression (default those with ARKit's names)", flag="--expression", metavar="NAME"
    )

    def write(self, job: Job) -> TrainPhotoReport:
        from facepipe.core.atomic import write_bytes
        from facepipe.importers import read_face
        from facepipe.photo.amortised.network import start_graph
        from facepipe.photo.amortised.training import start_metadata, train_start
        from facepipe.photo.descent.subject import Subject

        begin, parts = time.perf_counter(), read_face(self.face).parts()
        with _under(self.face):
            subject = Subject.of(parts, self.expressions)
        photos, left_out = ([], []) if self.images is None else _photos(self.images, subject, job)
        with _under(self.face), job.watch("train", self.total) as bar:
            trained = train_start(parts, self, photos=photos, expressions=self.expressions, done=bar.update)
        metadata = start_metadata(trained, self)
        write_bytes(job.out, start_graph(trained.network, metadata))
        return TrainPhotoReport(
            seconds=time.perf_counter() - begin,
            photos=trained.photos,
            held_out=metadata["held_out"],
            training=metadata["training"],
            doubtful=bool(trained.warnings),
            warnings=(*left_out, *trained.warnings),
        )

    def missed(self, report: TrainPhotoReport) -> bool:
        return report.doubtful

    def text(self, report: TrainPhotoReport, out: Path) -> str:
        before, after = report.held_out["before"], report.held_out["after"]
        rows = [("joint loss", "at the defaults", "as guessed")]
        rows += [(name, f"{value:.3f}", f"{after.get(name, 0.0):.3f}") for name, value in before.items()]
        on = f"of {report.photos} photos" if report.photos else "renders"
        what = f"joint loss on {report.held_out['pictures']} held-out {on}"
        return f"{out}: {report.seconds / 60:.1f} min, {what}\n{table(rows)}"


@contextmanager
def _under(face: Path) -> Iterator[None]:
    """Errors say which file the face is of."""
    try:
        yield
    except FacepipeError as error:
        raise error.under(face) from None


def _photos(folder: Path, subject: Subject, job: Job) -> tuple[list[Picture], list[str]]:
    """The heads of the photos in a folder, and a line for each photo that shows none; at least one has to."""
    from facepipe.photo.amortised.pictures import Picture
    from facepipe.photo.descent.fit import pose_space
    from facepipe.photo.fit.photo_file import read_photo
    from facepipe.photo.fit.photo_landmarks import own_landmarks, read_landmarks

    if not folder.is_dir():
        raise InputError(folder, "is no folder, expected one of photos")
    files = files_in(folder, _SUFFIXES)
    pictures, left_out = [], []
    with job.watch("photos", len(files)) as bar:
        for path in files:
            try:
                names = (f"{path.name}.landmarks.json", f"{path.stem}.landmarks.json")
                photo, beside = read_photo(path), file_beside(path, *names)
                marks = own_landmarks(photo) if beside is None else read_landmarks(beside, photo)
                space = pose_space(subject, photo.pixels.shape[1], photo.pixels.shape[0])
                pictures.append(Picture.from_photo(photo.pixels, marks.points, space))
            except InputError as error:
                left_out.append(f"left out: {error}")
            bar.update()
    if not pictures:
        raise InputError(folder, f"{len(files)} photos and no usable face in them, expected photos of people")
    return pictures, left_out
