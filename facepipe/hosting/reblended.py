"""A blended face made again from its recipe, as parts: for hosts that hold the face themselves."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

from facepipe.parts import FaceParts
from facepipe.performing import job_of, read_kept
from facepipe.processors.blend import BlendFaces
from facepipe.stage import Face, open_face


@dataclass(frozen=True, kw_only=True)
class Reblended:
    """A blended face, and one line for each source that has changed since."""

    parts: FaceParts
    warnings: tuple[str, ...] = ()


def reblended(path: Path) -> Reblended:
    """Blend again what `facepipe blend` wrote as `path`, which stays as it is.

    :raises InputError: no recipe of a blend, a source that is gone
    :raises SchemaError, TopologyError: a damaged recipe, or sources that can't be blended any more
    """
    kept = read_kept(path, BlendFaces)
    blend = BlendFaces(**kept.values)
    with (
        tempfile.TemporaryDirectory() as folder,
        open_face(blend.base).deriving(Path(folder) / "blended.usda", flatten=kept.standalone) as face,
    ):
        report = blend.author(face, job_of(blend, path))
        parts = Face(face.stage, face.prim).parts()
    return Reblended(parts=parts, warnings=(*kept.warnings, *report.warnings))
