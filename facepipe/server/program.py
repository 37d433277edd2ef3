"""The process that does the work of a server: `facepipe.tasks.program` with lines of its own.

A task has a folder of its own, the only one that it reads and writes. Its line is one of
``act VERB FIELDS OUT``, an action that is remote, its fields as JSON with paths in that folder;
``take FILE OUT``, a face of any file that imports;
``derive FACE WHAT OUT``, what is made of a version, in a folder;
``find PHOTO OUT``, the landmarks of a photo.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError
from facepipe.core.reports import Report
from facepipe.declare import from_json
from facepipe.registry import exporter, host, manifest, own_action, photos
from facepipe.tasks.program import Line, Outcome, main, watch

# what is made of a version -> the files that are made with it
PAGE = ("face.glb", "sliders.onnx", "sliders.onnx.json", "regions.bin", "details.json", "recipe.json")
MADE: dict[str, str] = {
    **dict.fromkeys(PAGE, "page"),
    "thumbnail.png": "thumbnail",
    "face.fpb": "person",
    "face.usdz": "package",
    **dict.fromkeys(("face.onnx", "face.onnx.json"), "onnx"),
}
_THUMBNAIL = 256  # pixels
_BEHIND = 10  # niceness of jobs: what somebody waits for, a dragged weight or a picture, goes first where cores are few


def read_line(words: Sequence[str]) -> Line:
    """A line of a server.

    :raises InputError: no such line, or fields that the action does not take
    """
    lines: dict[str, Callable[..., Line]] = {"act": _act, "take": _take, "derive": _derive, "find": _find}
    if not words or words[0] not in lines:
        raise InputError("line", "is none of a server's")
    return lines[words[0]](*words[1:])


def _act(verb: str, fields: str, out: str) -> Line:
    from facepipe.performing import files_of, perform

    if not manifest()["actions"].get(verb, {}).get("remote"):
        raise InputError(verb[:40], "is not done for others")
    action = from_json(own_action(verb), json.loads(fields), verb)

    def run() -> Outcome:
        _give_way()
        report = perform(action, Path(out), flatten=True, watch=watch).report
        return Outcome(missed=action.missed(report), report=report.to_dict())

    return Line(verb=verb, reads=files_of(action), writes=[Path(out)], run=run)


def _take(file: str, out: str) -> Line:
    def run() -> Outcome:
        from facepipe.importers import read_face
        from facepipe.stage import save_parts

        _give_way()
        with watch("reading", 2) as bar:
            face = read_face(file)
            parts = face.parts()
            bar.update()
            save_parts(parts, Path(out))
            bar.update()
        return Outcome(report=Report(warnings=tuple(face.warnings)).to_dict())

    return Line(verb="upload", reads=[Path(file)], writes=[Path(out)], run=run)


def _give_way() -> None:
    """Have this process, which does jobs alone, get the time that others leave; on Windows as before."""
    if hasattr(os, "nice"):
        os.nice(max(_BEHIND - os.nice(0), 0))


def _derive(face: str, what: str, out: str) -> Line:
    making = {"page": _page, "thumbnail": _thumbnail, "person": _person, "package": _package, "onnx": _onnx}[what]

    def run() -> Outcome:
        making(Path(face), Path(out))
        return Outcome()

    return Line(verb=what, reads=[Path(face)], writes=[Path(out)], run=run)


def _find(photo: str, out: str) -> Line:
    def run() -> Outcome:
        photos().find_landmarks(Path(photo), Path(out))
        return Outcome()

    return Line(verb="find", reads=[Path(photo)], writes=[Path(out)], run=run)


def _page(face: Path, out: Path) -> None:
    from facepipe.stage import open_face

    parts = open_face(face).parts()
    host("view").write_assets(parts, face.stem, out, ".")
    recipe = parts.recipe
    said: Any = None if recipe is None else {**vars(recipe), "options": dict(recipe.options)}
    (out / "recipe.json").write_text(json.dumps(said, sort_keys=True), encoding="utf-8")


def _thumbnail(face: Path, out: Path) -> None:
    out.mkdir()
    _perform("render", out / "thumbnail.png", face=face, size=_THUMBNAIL)


def _person(face: Path, out: Path) -> None:
    out.mkdir()
    _perform("person", out / "face.fpb", face=face)


def _perform(verb: str, out: Path, **fields: Any) -> None:
    from facepipe.performing import perform

    perform(own_action(verb)(**fields), out)


def _package(face: Path, out: Path) -> None:
    from facepipe.stage import open_face, save_parts

    out.mkdir()
    save_parts(open_face(face).parts(), out / "face.usdz")


def _onnx(face: Path, out: Path) -> None:
    from facepipe.stage import open_face

    out.mkdir()
    module = exporter("face.onnx")
    module.export(open_face(face), out / "face.onnx", module.Options())


if __name__ == "__main__":
    main(read_line)
