"""Textures of the skin from a scan's colours and detail: its light evened, what it does not show completed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from facepipe.core.images import open_image, pixels
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.geometry.colors import from_srgb, to_srgb
from facepipe.geometry.polygons import point_areas, point_normals
from facepipe.geometry.scan_surface import cloud_normals
from facepipe.geometry.similarity import Similarity
from facepipe.geometry.texels import Texels, spread
from facepipe.geometry.vectors import unit_vectors
from facepipe.heads.skin import jpeg, to_bytes
from facepipe.parts import FaceParts, TextureInput
from facepipe.scanning.rebuild.declared import BakeScanOptions
from facepipe.scans import Scan
from facepipe.stage import Face
from facepipe.textures.bake import Baker
from facepipe.textures.evened import inner, missed_light, one_sided
from facepipe.textures.seen_skin import DARKEST, Observed, step
from facepipe.textures.skin_surface import SkinSurface, hide_brow_cards, skin_of

_MOST = 6_000_000  # samples of a scan
_STEPS = 64  # of a triangle's side, at most
_NEIGHBOURS = 16  # of a point of a cloud
_FAR_MM = (0.6, 2.5)  # off the scan: full confidence up to the first, none beyond the second
_TURNED = (0.3, 0.7)  # cosine between both normals: none up to the first, full from the second
_EDGE_MM = (1.0, 8.0)  # off what the scan does not show: confidence begins, and is full
_SHOWN = 0.5  # confidence from which a point counts as shown
_CHUNK = 1 << 18  # texels at a time
_COARSE = 1.5  # texels; samples further apart are mixed
_ALIKE = (0.80, 0.95)  # cosine between both normals: below, the scan is another fold's; from the second, fully trusted
_FINER = 0.7  # of the mesh's edges: scans with longer ones show nothing beyond it
_PORES_MM = 0.5  # edges of scans that show pores
_ROOM_MM = 5.0  # around the skin
_FINEST_MM = 0.1  # between samples
_OFF_THE_FACE = 0.05  # what skin counts there when light is looked for: hair may be on it
_HAIR_SIZE, _HAIR_REACH = 1.7, 0.07  # of the eyes' distance: how large it is at least, and how near it is to skin
_FRINGE = 0.12  # so far from its edge it hides skin that no scalp is
_FOREHEAD, _ON_BROWS = (0.25,), (0.0, -0.05)  # above the brows' landmarks, shares of chin to root of the nose
_BROWS_REACH = 0.12  # of the eyes' distance, around these
_BRIGHT_SHOWN = 0.3  # confidence
_DARK_SHARE = 0.25  # of points there that brows are on at least
_BROWS_SHOW = 0.18  # darker by this than the forehead: skin alone is 0.1, painted brows are 0.3


@dataclass(frozen=True, kw_only=True)
class ScanSamples:
    """s places of a scan's surface."""

    points: FloatArray  # (s, 3)
    normals: FloatArray  # (s, 3) unit, outward as far as the scan's are
    colors: Float32Array | None  # (s, 3) linear; None where the scan has none
    spacing: float  # about how far apart they are


def scan_samples(scan: Scan, place: Similarity, low: FloatArray, high: FloatArray, spacing: float) -> ScanSamples:
    """Samples of a scan within a box.

    :param place: from the scan's coordinates to those of the samples
    :param low: (3,) corner of the box
    :param high: (3,) the other
    :param spacing: how far apart they may be; clouds are taken as they are
    :raises InputError: a picture that can't be read
    """
    points = place.apply(scan.points)
    inside = np.asarray(((points >= low) & (points <= high)).all(axis=1))
    if scan.is_cloud:
        from scipy.spatial import cKDTree

        kept = np.flatnonzero(inside)
        near = cKDTree(points[kept]).query(points[kept], k=2)[0][:, 1] if len(kept) > 1 else np.ones(1)
        own = cloud_normals(points, _NEIGHBOURS).normals if scan.normals is None else scan.normals @ place.rotation.T
        colors = None if scan.colors is None else scan.colors[kept].astype(np.float32)
        return ScanSamples(points=points[kept], normals=own[kept], colors=colors, spacing=float(np.median(near)))
    # Any corner, not all: else the box would have a rim without samples, as wide as the scan's triangles.
    triangles = np.flatnonzero(inside[scan.triangles].any(axis=1))
    normals = point_normals(points, scan.triangles)
    owners, shares, spacing = _lattice(points[scan.triangles[triangles]], spacing)
    owners = triangles[owners]
    corners = scan.triangles[owners]
    samples = ScanSamples(
        points=_mixed(points, corners, shares),
        normals=unit_vectors(_mixed(normals, corners, shares)),
        colors=_colors(scan, owners, corners, shares),
        spacing=spacing,
    )
    if scan.photos is None:
        return samples
    assert samples.colors is not None  # scans of photos have some at their points
    # the colours of the photos where these show a place
    there, normals, spacing = place.undo(samples.points), samples.normals @ place.rotation, spacing / place.scale
    photographed = scan.photos(there, normals, spacing)
    return replace(samples, colors=np.where(np.isfinite(photographed), photographed, samples.colors))


def _lattice(corners: FloatArray, spacing: float) -> tuple[IntArray, FloatArray, float]:
    """Owners (s,) and barycentric shares (s, 3) of points spread evenly over triangles (t, 3, 3), and their spacing."""
    sides = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).max(axis=1, initial=0.0)
    while True:
        steps = np.clip(np.ceil(sides / spacing), 1, _STEPS).astype(np.int64)
        if (steps**2).sum() <= _MOST:
            break
        spacing *= 1.2
    owners, shares = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    for count in np.unique(steps):
        here = np.flatnonzero(steps == count)
        # (count^2, 3) barycentrics of the middles of the triangles that a triangle is cut into
        first, second = (axis.ravel() for axis in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
        up, down = first + second < count, first + second < count - 1
        ups = np.column_stack([first[up] + 1 / 3, second[up] + 1 / 3])
        downs = np.column_stack([first[down] + 2 / 3, second[down] + 2 / 3])
        two = np.concatenate([ups, downs]) / count
        middles = np.column_stack([two, 1 - two.sum(axis=1)])
        owners.append(np.repeat(here, len(middles)))
        shares.append(np.tile(middles, (len(here), 1)))
    return np.concatenate(owners), np.concatenate(shares), spacing


def _colors(scan: Scan, owners: IntArray, corners: IntArray, shares: FloatArray) -> Float32Array | None:
    colors = None if scan.colors is None else _mixed(scan.colors, corners, shares).astype(np.float32)
    if scan.texture is None or colors is None:
        return colors
    for number, picture in enumerate(scan.texture.pictures):
        name = f"picture {number + 1} of the scan"
        texels = pixels(open_image(picture.data, name), "RGB", name)
        here = np.flatnonzero(scan.texture.picture[owners] == number)
        uv = np.einsum("sk,skc->sc", shares[here], scan.texture.uvs[owners[here]])
        # (s, 3) linear colours of the texels (h, w, 3) at UVs (s, 2), bilinear
        height, width = texels.shape[:2]
        x, y = uv[:, 0] % 1.0 * width - 0.5, (1.0 - uv[:, 1]) % 1.0 * height - 0.5
        left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        # Decoded before they are mixed: means of sRGB bytes are too dark.
        levels = from_srgb(np.arange(256) / 255).astype(np.float32)
        total = np.zeros((len(uv), 3), np.float32)
        for column, row, share in (
            (left, top, (1 - x + left) * (1 - y + top)),
            (left + 1, top, (x - left) * (1 - y + top)),
            (left, top + 1, (1 - x + left) * (y - top)),
            (left + 1, top + 1, (x - left) * (y - top)),
        ):
            total += share.astype(np.float32)[:, None] * levels[texels[row % height, column % width]]
        colors[here] = np.asarray(np.clip(total * np.array(picture.gain) + np.array(picture.bias), 0, 1), np.float32)
    return colors


def _mixed(values: FloatArray, corners: IntArray, shares: FloatArray) -> FloatArray:
    return np.asarray(sum(values[corner] * share[:, None] for corner, share in zip(corners.T, shares.T, strict=True)))


@dataclass(frozen=True, kw_only=True)
class SkinOnScan:
    """A skin in the pose of a scan, and the scan's samples."""

    skin: SkinSurface  # its points as the scan shows them, millimetres
    samples: ScanSamples
    covered: BoolArray | None = None  # (n,) to which its colours do not go

    @cached_property
    def normals(self) -> FloatArray:
        """(n, 3) of the skin's points."""
        return point_normals(self.skin.points, self.skin.triangles)

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.samples.points, balanced_tree=False, compact_nodes=False)

    @cached_property
    def outward(self) -> float:
        """1, or -1 where the scan's normals point inward."""
        distances, near = self._tree.query(self.skin.points, distance_upper_bound=_FAR_MM[1])
        hit = np.isfinite(distances) & self.skin.outside
        agreement = (self.normals[hit] * self.samples.normals[near[hit]]).sum(axis=1)
        return -1.0 if agreement.sum() < 0 else 1.0

    @cached_property
    def trust(self) -> FloatArray:
        """(n,) 0 to 1, of the skin's points: fading towards the border of what the scan shows."""
        from scipy.spatial import cKDTree

        _, near = self.nearest(self.skin.points, self.normals)
        trust = near * self.skin.outside
        if self.covered is not None:
            trust = trust * ~self.covered
        hidden = self.skin.outside & (trust < _SHOWN)
        if not hidden.any():
            return np.asarray(trust)
        off = cKDTree(self.skin.points[hidden]).query(self.skin.points)[0]
        return np.asarray(trust * step(off, *_EDGE_MM))

    def nearest(self, points: FloatArray, normals: FloatArray) -> tuple[IntArray, FloatArray]:
        """Sample (m,) nearest to each point (m, 3), -1 where none is near, and confidence (m,) 0 to 1.

        :param normals: (m, 3) of the skin there
        """
        distances, near = self._tree.query(points, distance_upper_bound=_FAR_MM[1])
        hit = np.isfinite(distances)
        rows = np.where(hit, near, 0)
        agreement = self.outward * (normals * self.samples.normals[rows]).sum(axis=1)
        trust = np.where(hit, (1 - step(np.where(hit, distances, 0), *_FAR_MM)) * step(agreement, *_TURNED), 0.0)
        return np.where(hit, near, -1), trust

    def shown(self, number: int) -> tuple[IntArray, IntArray, Float32Array]:
        """Of one of the skin's textures (k,) texels that the scan shows, its nearest samples, and trust, 0..1."""
        texels = self.skin.textures[number].texels
        shown = np.flatnonzero(self.trust[texels.corners].min(axis=1) > 0)
        places, samples, trusts = [], [], []
        for chunk in np.array_split(shown, -(-len(shown) // _CHUNK) or 1):
            part = texels.taken(chunk)
            sample, trust = self.nearest(part.carried(self.skin.points), part.carried(self.normals))
            kept = np.flatnonzero(trust > 0)
            places.append(chunk[kept])
            samples.append(sample[kept])
            trusts.append((trust * part.carried(self.trust[:, None])[:, 0])[kept])
        return np.concatenate(places), np.concatenate(samples), np.concatenate(trusts).astype(np.float32)

    def observed(self, number: int, template: FloatArray) -> Observed:
        """The scan's colours on one of the skin's textures.

        :param template: (m, 3) linear colours of the texture's texels
        """
        place, sample, trust = self.shown(number)
        texels, chunks = self.skin.textures[number].texels, -(-len(place) // _CHUNK) or 1
        seen = np.concatenate(
            [
                self._mixed(texels.taken(place[chunk]), sample[chunk])
                for chunk in np.array_split(np.arange(len(place)), chunks)
            ]
        )
        ratio = np.log(np.maximum(seen, DARKEST)) - np.log(template[place])
        return Observed(place=place, ratio=ratio.astype(np.float32), trust=trust)

    def _mixed(self, part: Texels, sample: IntArray) -> Float32Array:
        """(k, 3) colours at texels: of the nearest sample, or of some where these are far apart."""
        colors = self.samples.colors
        assert colors is not None
        if self.samples.spacing <= _COARSE * texel_width(self.skin):
            return colors[sample]
        distances, near = self._tree.query(part.carried(self.skin.points), k=4)
        near = np.minimum(near, len(colors) - 1)
        weights = 1 / (distances**2 + (0.1 * self.samples.spacing) ** 2)
        weights /= weights.sum(axis=1, keepdims=True)
        return np.asarray((weights[..., None] * colors[near]).sum(axis=1), np.float32)


def texel_width(skin: SkinSurface) -> float:
    """About how wide a texel of the largest texture is on the skin."""
    areas = point_areas(skin.points, skin.triangles)
    counts = sum(
        (texture.texels.summed(np.ones((len(texture.texels.at), 1)), len(areas)) for texture in skin.textures),
        np.zeros((len(areas), 1)),
    )[:, 0]
    chosen = skin.outside & (counts > 0)
    return float(np.sqrt(np.median(areas[chosen] / counts[chosen])))


def baked_relief(on_scan: SkinOnScan, number: int, own: TextureInput, edge: float) -> Float32Array:
    """(size, size, 3) a normal map with the scan's detail, -1..1, for one of the skin's textures.

    :param own: the map that the skin has, of the same texture coordinates
    :param edge: millimetres, of the scan's triangles
    :raises InputError: a map that can't be read
    """
    from PIL import Image

    skin, texels = on_scan.skin, on_scan.skin.textures[number].texels
    size, count = (texels.size, texels.size), len(skin.points)
    picture = open_image(own.texture.image(), f"texture {own.texture.name}").convert("RGB")
    values = np.asarray(picture.resize(size, Image.Resampling.BICUBIC), np.float32) / 255
    before = (values * np.array(own.scale[:3]) + np.array(own.bias[:3])).reshape(-1, 3)
    flat = np.asarray(unit_vectors(before), np.float32)
    place, sample, trust = on_scan.shown(number)
    part = texels.taken(place)
    # (n, 3) directions at points in which u and v grow, means of those of the texels around
    places = spread(texels, texels.carried(skin.points))
    growing = (sign * np.gradient(places, axis=axis).reshape(-1, 3)[texels.at] for axis, sign in ((1, 1), (0, -1)))
    across, up = (part.carried(unit_vectors(texels.summed(unit_vectors(one), count))) for one in growing)
    normal = unit_vectors(part.carried(on_scan.normals))
    across = unit_vectors(across - (across * normal).sum(axis=1, keepdims=True) * normal)
    binormal = np.cross(normal, across)
    # Mirrored texture coordinates turn the frame's hand.
    binormal *= np.where((binormal * up).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    there = on_scan.outward * on_scan.samples.normals[sample]
    facing = (there * normal).sum(axis=1)
    slopes = np.column_stack([(there * across).sum(axis=1), (there * binormal).sum(axis=1)])
    share = (trust * step(facing, *_ALIKE))[:, None]
    # Slopes (x / z, y / z) of two reliefs add up, unit normals don't; 0.1 bounds those seen edge-on.
    slopes = slopes / np.maximum(facing, 0.1)[:, None]
    before = flat[part.at]
    kept = 1 - share if edge <= _PORES_MM else 1.0
    both = kept * before[:, :2] / np.maximum(before[:, 2:], 0.1) + share * slopes
    flat[part.at] = unit_vectors(np.column_stack([both, np.ones(len(both))]))
    return flat.reshape(*size, 3)


def is_finer(skin: SkinSurface, edge: float) -> bool:
    """Whether a scan with triangles of that edge shows more than the mesh."""
    face = skin.outside & (inner(skin) > 0.5)  # elsewhere meshes are coarse
    return edge < _FINER * median_edge(skin.points, skin.triangles[face[skin.triangles].all(axis=1)])


def median_edge(points: FloatArray, triangles: IntArray) -> float:
    """Of the edges of triangles (t, 3) between points (n, 3)."""
    lengths = np.linalg.norm(points[triangles] - points[np.roll(triangles, 1, axis=1)], axis=2)
    return float(np.median(lengths)) if lengths.size else 0.0


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
    # Colours are logarithms of ratios: light multiplies, so it is subtracted here. Light is what goes with the
    # direction of the surface, and what changes from side to side.
    light = np.zeros_like(colors)
    if even > 0:
        weight = trust * skin.areas * (_OFF_THE_FACE + (1 - _OFF_THE_FACE) * inner(skin))
        light = missed_light(on_scan.normals, colors, weight)
        light = even * (light + one_sided(skin, colors - light, trust, uneven=1.0))
    observed = [baker.evened(number, one, light, np.ones(len(trust))) for number, one in enumerate(observed)]
    areas = skin.areas * skin.outside
    if on_scan.covered is not None:
        areas = areas * ~on_scan.covered
    whole, pictures = baker.completed(*baker.at_points(observed)), []
    for texture, flat, one in zip(skin.textures, baker.flats, observed, strict=True):
        ratio = texture.texels.carried(whole)
        ratio[one.place] += one.trust[:, None] * (one.ratio - ratio[one.place])
        pictures.append(to_srgb(spread(texture.texels, np.exp(ratio) * flat)).astype(np.float32))
    return ScanTextures(
        pictures=tuple(pictures),
        coverage=float(trust @ areas / areas.sum()),
        light=float(np.abs(light).mean(axis=1) @ (areas * trust) / max(areas @ trust, 1e-12)),
        brows=_brows(skin, (baker.template + colors - light).mean(axis=1), trust),
    )


def _brows(skin: SkinSurface, brightness: FloatArray, trust: FloatArray) -> float:
    """How much darker than the forehead the darker part of where brows are is; 0 where not both are shown.

    :param brightness: (n,) logarithms at points
    """
    from scipy.spatial import cKDTree

    marks, tree = skin.points[skin.landmarks], cKDTree(skin.points)
    reach = _BROWS_REACH * skin.eye_distance(skin.points)
    up = marks[27] - marks[8]

    def around(shares: tuple[float, ...]) -> FloatArray:
        near = tree.query_ball_point(np.concatenate([marks[17:27] + share * up for share in shares]), reach)
        rows = np.unique(np.concatenate([np.asarray(one, np.int64) for one in near]))
        return np.asarray(brightness[rows[trust[rows] > _BRIGHT_SHOWN]])

    # A quantile, not the mean: hairs may cover a quarter of where brows are.
    forehead, brows = around(_FOREHEAD), around(_ON_BROWS)
    if not len(forehead) or not len(brows):
        return 0.0
    return float(np.median(forehead) - np.quantile(brows, _DARK_SHARE))


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
        edge = place.scale * median_edge(scan.points, scan.triangles)
        relief = relief and is_finer(skin, edge)
        if not colors and not relief:
            return BakeScanReport()
        on_scan = lay_on(skin, scan, place, under_hair(parts, points, skin))
        if relief:
            # normal maps, where materials have one of the same texture coordinates
            normals = {material.name: material.normal for material in parts.materials}
            for number, texture in enumerate(skin.textures):
                for own in dict.fromkeys(normals[name] for name in texture.materials):
                    if own is not None and own.uv_set == texture.source.uv_set:
                        materials = tuple(name for name in texture.materials if normals[name] == own)
                        relief_map = (baked_relief(on_scan, number, own, edge) + 1) / 2
                        image = jpeg(_name(own), to_bytes(relief_map))
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


def _name(source: TextureInput) -> str:
    return f"{Path(source.texture.name).stem}_scan"
