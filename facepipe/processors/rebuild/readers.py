"""How files come into a rebuild."""

from __future__ import annotations

from pathlib import Path

from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_landmarks import read_scan_landmarks
from facepipe.parts import FaceParts
from facepipe.processors.rebuild.scan_input import landmarks_of
from facepipe.processors.rebuild.stages import Readers
from facepipe.stage import open_face


def readers() -> Readers:
    """Those of the importers."""
    return Readers(
        scan=read_scan,
        landmarks=read_scan_landmarks,
        find_landmarks=lambda scan: landmarks_of(None, scan)[0],
        face=_face,
    )


def _face(path: Path) -> FaceParts:
    """A corrected mesh; OBJ files are in millimetres, Y up, as the meshes of the work folder are."""
    from facepipe.importers import load, obj

    suffix = path.suffix.lower()
    if suffix == ".obj":
        return load("obj", path, obj.Options(meters_per_unit=0.001, up_axis="Y")).parts
    if suffix in (".glb", ".gltf"):
        return load("gltf", path).parts
    return open_face(path).parts()
