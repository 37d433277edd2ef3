"""Textures of the skin from a scan's colours and detail: its light evened, what it does not show completed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from facepipe.core.arrays import BoolArray, Float32Array, FloatArray
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.geometry.colors import to_srgb
from facepipe.geometry.similarity import Similarity
from facepipe.geometry.texture_fill import spread
from facepipe.heads.skin import jpeg, to_bytes
from facepipe.parts import FaceParts, Texture, TextureInput
from facepipe.scanning.rebuild import BakeScanOptions
from facepipe.scanning.texture.scan_colors import SkinOnScan, texel_width
from facepipe.scanning.texture.scan_relief import baked_relief, is_finer, median_edge
from facepipe.scanning.texture.scan_samples import scan_samples
from facepipe.scans import Scan
from facepipe.stage import Face
from facepipe.textures.bake import Baker
from facepipe.textures.brow_cards import hide_brow_cards
from facepipe.textures.evened import inner, missed_light, one_sided
from facepipe.textures.observed import Observed
from facepipe.textures.skin_surface import SkinSurface, skin_of

_ROOM_MM = 5.0  # around the skin
_FINEST_MM = 0.1  # between samples
_OFF_THE_FACE = 0.05  # what skin counts there when light is looked for: hair may be on it
_HAIR_SIZE, _HAIR_REACH = 1.7, 0.07  # of the eyes' distance: how large it is at least, and how near it is to skin
_FRINGE = 0.12  # so far from its edge it hides skin that no scalp is
_FOREHEAD, _ON_BROWS = (0.25,), (0.0, -0.05)  # above the brows' landmarks, shares of chin to root of the nose
_BROWS_REACH = 0.12  # of the eyes' distance, around these
_SHOWN = 0.3  # confidence
_DARK_SHARE = 0.25  # of points there that brows are on at least
_BROWS_SHOW = 0.18  # darker by this than the forehead: skin alone is 0.1, painted brows are 0.3


@dataclass(frozen=True, kw_only=True)
class BakeScanReport(Report):
    """What was baked."""

    textures: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # file -> the materials that show it
    colored: float = 0.0  # share of the skin's outside whose colours the scan shows
    hidden: tuple[str, ...] = ()  # materials of cards of brows, which the scan's colours show


@dataclass(frozen=True, kw_only=True)
class ScanTextures:
    """Textures of a skin."""

    pictures: tuple[Float32Array, ...]  # of each (size, size, 3) sRGB 0..1
    coverage: float  # share of the skin's outside, without what is covered, whose colours the scan shows
    light: float  # what was evened, mean of the logarithm
    brows: float = 0.0  # how much darker they are than the forehead, of the logarithm


def lay_on(skin: SkinSurface, scan: Scan, place: Similarity, covered: BoolArray | None = None) -> SkinOnScan:
    """A skin on a scan.

    :param skin: in the pose of the scan, millimetres
    :param place: from the scan's coordinates to those of the skin
    :param covered: (n,) points of the skin to which the scan's colours do not go
    :raises InputError: a picture of the scan that can't be read
    """
    low, high = skin.points.min(axis=0) - _ROOM_MM, skin.points.max(axis=0) + _ROOM_MM
    samples = scan_samples(scan, place, low, high, max(0.8 * texel_width(skin), _FINEST_MM))
    return SkinOnScan(skin=skin, samples=samples, covered=covered)


def under_hair(parts: FaceParts, points: FloatArray, skin: SkinSurface) -> BoolArray:
    """(n,) points of the skin close under cards of hair: the scalp there has the hair's colour already.

    :param points: (m, 3) of all meshes, in the pose of the skin
    """
    from scipy.spatial import cKDTree

    cut = {material.name for material in parts.materials if isinstance(material.opacity, TextureInput)}
    size = skin.eye_distance(skin.points)
    covered, first = np.zeros(len(skin.points), bool), 0
    for mesh in parts.meshes:
        own = points[first : first + len(mesh.points)]
        first += len(mesh.points)
        if mesh.material in cut and np.ptp(own, axis=0).max() > _HAIR_SIZE * size:  # brows and lashes are smaller
            covered |= cKDTree(own).query(skin.points)[0] < _HAIR_REACH * size
    bare = skin.outside & ~covered
    if not covered.any() or not bare.any():
        return covered
    return np.asarray(covered & (cKDTree(skin.points[bare]).query(skin.points)[0] > _FRINGE * size))


def bake_scan(on_scan: SkinOnScan, even: float) -> ScanTextures:
    """Textures from a scan that has colours.

    :param even: how much of the light in the colours is taken out, 0 to 1
    :raises InputError: a texture of the skin that can't be read
    """
    skin, baker = on_scan.skin, Baker(on_scan.skin)
    observed = [on_scan.observed(number, flat) for number, flat in enumerate(baker.flats)]
    colors, trust = baker.at_points(observed)
    # Colours are logarithms of ratios: light multiplies, so it is subtracted here.
    light = even * _light(skin, on_scan.normals, colors, trust) if even > 0 else np.zeros_like(colors)
    observed = [baker.evened(number, one, light, np.ones(len(trust))) for number, one in enumerate(observed)]
    areas = skin.areas * skin.outside
    if on_scan.covered is not None:
        areas = areas * ~on_scan.covered
    return ScanTextures(
        pictures=tuple(_pictures(baker, observed)),
        coverage=float(trust @ areas / areas.sum()),
        light=float(np.abs(light).mean(axis=1) @ (areas * trust) / max(areas @ trust, 1e-12)),
        brows=_brows(skin, (baker.template + colors - light).mean(axis=1), trust),
    )


def _brows(skin: SkinSurface, brightness: FloatArray, trust: FloatArray) -> float:
    """How much darker than the forehead the darker part of where brows are is; 0 where not both are shown.

    :param brightness: (n,) logarithms at points
    """
    from scipy.spatial import cKDTree

    marks, tree, reach = (
        skin.points[skin.landmarks],
        cKDTree(skin.points),
        _BROWS_REACH * skin.eye_distance(skin.points),
    )
    up = marks[27] - marks[8]

    def around(shares: tuple[float, ...]) -> FloatArray:
        near = tree.query_ball_point(np.concatenate([marks[17:27] + share * up for share in shares]), reach)
        rows = np.unique(np.concatenate([np.asarray(one, np.int64) for one in near]))
        return np.asarray(brightness[rows[trust[rows] > _SHOWN]])

    forehead, brows = around(_FOREHEAD), around(_ON_BROWS)
    if not len(forehead) or not len(brows):
        return 0.0
    return float(np.median(forehead) - np.quantile(brows, _DARK_SHARE))


def _light(skin: SkinSurface, normals: FloatArray, colors: FloatArray, trust: FloatArray) -> FloatArray:
    """(n, 3) what of colours (n, 3) is light: what goes with the direction of the surface, and from side to side."""
    weight = trust * skin.areas * (_OFF_THE_FACE + (1 - _OFF_THE_FACE) * inner(skin))
    light = missed_light(normals, colors, weight)
    return light + one_sided(skin, colors - light, trust, uneven=1.0)


def _pictures(baker: Baker, observed: Sequence[Observed]) -> list[Float32Array]:
    colors, trust = baker.at_points(observed)
    whole = baker.completed(colors, trust)
    pictures = []
    for texture, flat, one in zip(baker.skin.textures, baker.flats, observed, strict=True):
        ratio = texture.texels.carried(whole)
        ratio[one.place] += one.trust[:, None] * (one.ratio - ratio[one.place])
        pictures.append(to_srgb(spread(texture.texels, np.exp(ratio) * flat)).astype(np.float32))
    return pictures


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
    colored, hidden = 0.0, tuple[str, ...]()
    with one_thread():
        skin = skin_of(parts, points, options.texture_size)
        on_scan = lay_on(skin, scan, place, under_hair(parts, points, skin))
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
            hidden = hide_brow_cards(face, on_scan.skin) if baked.brows > _BROWS_SHOW else ()
    return BakeScanReport(textures=files, colored=colored, hidden=hidden)


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
