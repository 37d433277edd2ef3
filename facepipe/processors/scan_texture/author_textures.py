"""The colours and the detail of a scan authored on the face that was fitted to it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from facepipe.core.arrays import FloatArray
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.geometry.similarity import Similarity
from facepipe.heads.skin import jpeg, to_bytes
from facepipe.parts import FaceParts, Texture, TextureInput
from facepipe.processors.photo_texture import skin_of
from facepipe.processors.rebuild import BakeScanOptions
from facepipe.processors.scan_texture.scan_baking import bake_scan, lay_on
from facepipe.processors.scan_texture.scan_colors import SkinOnScan
from facepipe.processors.scan_texture.scan_relief import baked_relief, is_finer, median_edge
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
    """Bake a scan's colours and detail, and author the textures on a face within `Face.deriving`.

    :param parts: of the face
    :param points: (n, 3) of all meshes as the scan shows them, millimetres
    :param place: from the scan's coordinates to those of the points
    :raises InputError: a picture of the scan, or a texture of the face, that can't be read
    """
    colors = options.colors and scan.colors is not None
    relief = options.relief and not scan.is_cloud
    if not colors and not relief:
        return BakeScanReport()
    if not any(isinstance(material.diffuse_color, TextureInput) for material in parts.materials):
        line = f"{scan.name}: colours are left out, the template's skin has no texture"
        return BakeScanReport(warnings=(line,) if colors else ())
    files: dict[str, tuple[str, ...]] = {}
    colored = 0.0
    with one_thread():
        on_scan = lay_on(skin_of(parts, points, options.texture_size), scan, place)
        edge = place.scale * median_edge(scan.points, scan.triangles)
        if relief and is_finer(on_scan, edge):
            for image, materials in _reliefs(parts, on_scan, edge):
                face.new_texture(materials, image.name, image.data, "normal")
                files[image.name] = materials
        if colors:
            baked = bake_scan(on_scan, options.even)
            colored = baked.coverage
            for texture, picture in zip(on_scan.skin.textures, baked.pictures, strict=True):
                image = jpeg(_name(texture.source), to_bytes(picture))
                face.new_texture(texture.materials, image.name, image.data)
                files[image.name] = texture.materials
    return BakeScanReport(textures=files, colored=colored)


def _reliefs(parts: FaceParts, on_scan: SkinOnScan, edge: float) -> Iterator[tuple[Texture, tuple[str, ...]]]:
    """Normal maps, and the materials that show them, where these have one of the same texture coordinates."""
    normals = {material.name: material.normal for material in parts.materials}
    for number, texture in enumerate(on_scan.skin.textures):
        for own in dict.fromkeys(normals[name] for name in texture.materials):
            if own is not None and own.uv_set == texture.source.uv_set:
                names = tuple(name for name in texture.materials if normals[name] == own)
                picture = baked_relief(on_scan, number, own, edge)
                yield jpeg(_name(own), to_bytes((picture + 1) / 2)), names


def _name(source: TextureInput) -> str:
    return f"{Path(source.texture.name).stem}_scan"
