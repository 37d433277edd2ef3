"""Records of faces in .blend files, which may be of others: read whole, or refused in a line."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from blender_texts import TextBlock
from facepipe_blender.face_objects import Kept, keep, kept_in
from faces import tiny_face

from facepipe.core.errors import SchemaError
from facepipe.stage.values import same

KEPT = Kept(
    parts=tiny_face(),
    bones={"root": np.eye(4), "root/jaw": 2.0 * np.eye(4)},
    places={"Head": 3.0 * np.eye(4)},
    file="face.usda",
    neural_rig=("head.fpnr", "sha256:0", "sha256:1"),
)
CONTENT = "facepipe_content"


def record(parts: Kept = KEPT) -> TextBlock:
    text = TextBlock()
    keep(parts, text)
    return text


def test_what_is_kept_is_read_again() -> None:
    found = kept_in(record())
    assert same(found.parts, kept_in(record(found)).parts)
    assert [mesh.name for mesh in found.parts.meshes] == [mesh.name for mesh in KEPT.parts.meshes]
    for ours, theirs in ((found.bones, KEPT.bones), (found.places, KEPT.places)):
        assert [*ours] == [*theirs]
        assert all(np.array_equal(ours[name], theirs[name]) for name in theirs)
    assert (found.file, found.neural_rig) == (KEPT.file, KEPT.neural_rig)


def changed(**arrays: Any) -> bytes:
    with np.load(io.BytesIO(record()[CONTENT])) as found:
        whole = {name: found[name] for name in found.files} | arrays
    stream = io.BytesIO()
    np.savez_compressed(stream, **{name: array for name, array in whole.items() if array is not None})
    return stream.getvalue()


def of_header(how: Callable[[dict[str, Any]], object]) -> bytes:
    with np.load(io.BytesIO(record()[CONTENT])) as found:
        header = json.loads(found["header"].tobytes())
    how(header)
    return changed(header=np.frombuffer(json.dumps(header).encode(), np.uint8))


DAMAGED: dict[str, Callable[[], object]] = {
    "no bytes": lambda: 2**31 - 1,
    "text": lambda: "PK",
    "cut short": lambda: record()[CONTENT][:-100],
    "deflated wrongly": lambda: record()[CONTENT][:200] + b"\xff" * 60 + record()[CONTENT][260:],
    "unfolds to 300 MB": lambda: changed(face=np.zeros(300_000_000, np.uint8)),
    "no face": lambda: changed(face=None),
    "no stage": lambda: changed(face=np.frombuffer(b"PXR-USDC" + b"\xff" * 100, np.uint8)),
    "other shape": lambda: changed(bones=np.eye(4)),
    "not finite": lambda: changed(places=np.full((1, 4, 4), np.nan)),
    "deep header": lambda: changed(header=np.frombuffer(b"[" * 100_000, np.uint8)),
    "a list as header": lambda: changed(header=np.frombuffer(b"[]", np.uint8)),
    "fewer names": lambda: of_header(lambda header: header["bones"].pop()),
    "numbers as names": lambda: of_header(lambda header: header.update(bones=[1, 2])),
    "a number as file": lambda: of_header(lambda header: header.update(file=3)),
    "null as rig": lambda: of_header(lambda header: header.update(neural_rig=None)),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_record_is_refused(name: str) -> None:
    with pytest.raises(SchemaError, match=r"^face\.usda: holds no face, expected the text block of an imported face$"):
        kept_in(TextBlock({CONTENT: DAMAGED[name]()}))
