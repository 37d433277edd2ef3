"""Train a network that guesses where `facepipe fit-photo` should start, for one face.

FACE has sliders and the 68 landmarks `multipie68`. The network sees a crop of a face, 128 pixels a side, and its
landmarks, and tells sliders, expression and pose. It learns these from random people of FACE: from their landmarks,
then from renders in random light and colours; then, without being told, from the joint loss of a photo fit.
--images DIR takes photos of people for that last part: nothing needs to be known about them but where the landmarks
are, PHOTO.landmarks.json or STEM.landmarks.json beside a photo or found by facepipe's own network. Photos without a
face, or with several, are left out, with a warning.

OUT is one ONNX file; what it was trained on and its joint loss on pictures that it has not seen are in its metadata
`facepipe.photo`. It is for faces with the same sliders and expressions. Training takes minutes on one core; the same
line gives the same file. It needs `pip install 'facepipe[train]'`.

examples:
  facepipe train-photo head.usda -o start.onnx
  facepipe fit-photo portrait.jpg head.usda -o person.usda --start start.onnx --iterations 20 --rate 0.1
  facepipe train-photo head.usda -o start.onnx --images people --steps 400
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.parser import add_options, add_output, options_from, output_of
from facepipe.cli.show import emit, progress, warn
from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.learn.photo.amortised.pictures import Picture
    from facepipe.learn.photo.amortised.training import Trained
    from facepipe.learn.photo.subject import Subject
    from facepipe.start_options import StartOptions

_SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".avif", ".jp2", ".ppm", ".tga"))


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.start_options import StartOptions

    parser.add_argument("face", type=Path, metavar="FACE", help="face stage")
    add_output(parser, "network to write: .onnx")
    parser.add_argument("--images", type=Path, metavar="DIR", help="photos of people, for the joint loss")
    text = "shape that is an expression; may be given again (default those with ARKit's names)"
    parser.add_argument("--expression", dest="expressions", action="append", metavar="NAME", help=text)
    parser.add_argument("--json", action="store_true", help="print the losses as JSON")
    add_options(parser, StartOptions, "training")


def run(arguments: argparse.Namespace) -> int:
    """Render, train, write."""
    import facepipe
    from facepipe.core.atomic import write_bytes
    from facepipe.learn.photo.amortised.graph import start_graph
    from facepipe.learn.photo.amortised.metadata import start_metadata
    from facepipe.learn.photo.subject import Subject
    from facepipe.start_options import StartOptions

    begin = time.perf_counter()
    out = output_of(arguments, [arguments.face])
    if out.suffix.lower() != ".onnx":
        raise InputError(out, f"suffix '{out.suffix}', expected .onnx")
    options: StartOptions = options_from(arguments, StartOptions)
    parts = facepipe.read(arguments.face).parts()
    with _under(arguments.face):
        subject = Subject.of(parts, arguments.expressions)
    photos, left_out = _photos(arguments.images, subject)
    trained = _trained(arguments, subject, options, photos)
    metadata = start_metadata(trained, options)
    write_bytes(out, start_graph(trained.network, metadata))
    warnings = [*left_out, *trained.warnings]
    warn(warnings)
    result = {"path": str(out), "seconds": time.perf_counter() - begin, "photos": trained.photos, "warnings": warnings}
    result |= {"held_out": metadata["held_out"], "training": metadata["training"]}
    emit(result, _text(out, trained, result), as_json=arguments.json)
    return 1 if trained.warnings else 0


def _trained(
    arguments: argparse.Namespace, subject: Subject, options: StartOptions, photos: Sequence[Picture]
) -> Trained:
    from facepipe.learn.photo.amortised.training import train_start

    with _under(arguments.face), progress("train", options.total) as bar:
        return train_start(subject.parts, options, photos=photos, expressions=arguments.expressions, done=bar.update)


@contextmanager
def _under(face: Path) -> Iterator[None]:
    """Errors say which file the face is of."""
    try:
        yield
    except FacepipeError as error:
        raise error.under(face) from None


def _photos(folder: Path | None, subject: Subject) -> tuple[list[Picture], list[str]]:
    """The heads of the photos in a folder, and a line for each photo that shows none.

    :raises InputError: no such folder, or no photo with a face in it
    """
    from facepipe.learn.photo.amortised.pictures import Picture
    from facepipe.learn.photo.fit import pose_space
    from facepipe.processors.photo_fit import own_landmarks, read_landmarks, read_photo

    if folder is None:
        return [], []
    if not folder.is_dir():
        raise InputError(folder, "is no folder, expected one of photos")
    files = sorted(one for one in folder.iterdir() if one.suffix.lower() in _SUFFIXES)
    pictures, left_out = [], []
    with progress("photos", len(files)) as bar:
        for path in files:
            try:
                photo, beside = read_photo(path), _landmark_file(path)
                marks = own_landmarks(photo) if beside is None else read_landmarks(beside, photo)
                space = pose_space(subject, photo.pixels.shape[1], photo.pixels.shape[0])
                pictures.append(Picture.of(photo.pixels, marks.points, space))
            except InputError as error:
                left_out.append(f"left out: {error}")
            bar.update()
    if not pictures:
        raise InputError(folder, f"{len(files)} photos and no usable face in them, expected photos of people")
    return pictures, left_out


def _landmark_file(photo: Path) -> Path | None:
    names = (f"{photo.name}.landmarks.json", f"{photo.stem}.landmarks.json")
    return next((photo.with_name(name) for name in names if photo.with_name(name).is_file()), None)


def _text(out: Path, trained: Trained, result: dict[str, Any]) -> str:
    rows = [("joint loss", "at the defaults", "as guessed")]
    rows += [(name, f"{value:.3f}", f"{trained.after.get(name, 0.0):.3f}") for name, value in trained.before.items()]
    on = f"{trained.photos} photos" if trained.photos else "renders"
    minutes = f"{result['seconds'] / 60:.1f} min"
    return (
        f"{out}: {minutes}, joint loss on {trained.held_out} held-out {'of ' * bool(trained.photos)}{on}\n{table(rows)}"
    )
