"""The colours of a scan authored on the face that was fitted to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from facepipe.core.arrays import FloatArray
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.geometry.similarity import Similarity
from facepipe.heads.skin import jpeg, to_bytes
from facepipe.parts import FaceParts, TextureInput
from facepipe.processors.photo_texture import skin_of
from facepipe.processors.scan_texture.options import BakeScanOptions
from facepipe.processors.scan_texture.scan_baking import bake_scan
from facepipe.scans import Scan
from facepipe.stage import Face


@dataclass(frozen=True, kw_only=True)
class BakeScanReport(Report):
    """What was baked."""

    textures: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # file -> the materials that show it
    colored: float = 0.0  # share of the skin's outside whose colours the scan shows


def author_scan_textures(
    face: Face, parts: FaceParts, points: FloatArray, scan: Scan, place: Similarity, options: BakeScanOptions
) -> BakeScanReport:
    """Bake a scan's colours, and author the textures on a face within `Face.deriving`.

    :param parts: of the face
    :param points: (n, 3) of all meshes as the scan shows them, millimetres
    :param place: from the scan's coordinates to those of the points
    :raises InputError: a picture of the scan, or a texture of the face, that can't be read
    """
    if not options.colors or scan.colors is None:
        return BakeScanReport()
    if not any(isinstance(material.diffuse_color, TextureInput) for material in parts.materials):
        return BakeScanReport(warnings=(f"{scan.name}: colours are left out, the template's skin has no texture",))
    with one_thread():
        skin = skin_of(parts, points, options.texture_size)
        baked = bake_scan(skin, scan, place, options.even)
    files = {}
    for texture, picture in zip(skin.textures, baked.pictures, strict=True):
        image = jpeg(f"{Path(texture.source.texture.name).stem}_scan", to_bytes(picture))
        face.color_texture(texture.materials, image.name, image.data)
        files[image.name] = texture.materials
    return BakeScanReport(textures=files, colored=baked.coverage)
