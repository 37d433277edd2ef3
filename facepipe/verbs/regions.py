"""Authors the regions of a face from a map painted over its UV layout."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from facepipe.core.arrays import BoolArray, ByteArray, FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import first_names, identifier, select, unknown
from facepipe.core.reading import read_json_object
from facepipe.core.reports import Report, table
from facepipe.geometry.map_sampling import MapSampling
from facepipe.geometry.region_map import region_masks
from facepipe.parts import Mesh, UvSet
from facepipe.stage import Face
from facepipe.stage.author_mesh import author_region_subsets, author_regions, check_region_name
from facepipe.verbs.landmarks import mesh_of

RGB = tuple[int, int, int]

MOST_COLORS = 512
_MOST_BYTES = 1 << 20
_KEYS = ("regions", "outside", "meshes", "background")
_TAKEN = "default"
Masks = Mapping[str, FloatArray]


@dataclass(frozen=True, kw_only=True)
class RegionLegend:
    """What the colours of a map mean.

    :raises InputError: no colours, too many, one twice, the background among them, or a region called ``default``
    """

    colors: tuple[tuple[RGB, str], ...]  # (colour 0..255, region), each colour once
    outside: str | None = None
    meshes: Mapping[str, str] = field(default_factory=dict)  # name or glob -> region
    background: RGB | None = None
    where: str = "legend"  # for messages

    def __post_init__(self) -> None:
        if not 1 <= len(self.colors) <= MOST_COLORS:
            raise InputError(self.where, f"{len(self.colors)} colours, expected 1 to {MOST_COLORS}")
        seen: dict[RGB, str] = {} if self.background is None else {self.background: "the background"}
        for color, name in self.colors:
            if color in seen:
                both = f"{_hex(color)} for {seen[color]} and {name}"
                raise InputError(self.where, f"{both}, expected each colour once")
            seen[color] = name
        if _TAKEN in self.regions:
            raise InputError(
                self.where, f"a region '{_TAKEN}', which means all other regions to a blend, expected another name"
            )

    @property
    def regions(self) -> tuple[str, ...]:
        """Every region that it names, each once: those with colours first."""
        names = [name for _, name in self.colors]
        return tuple(dict.fromkeys([*names, *([self.outside] if self.outside else []), *self.meshes.values()]))

    @property
    def color_array(self) -> ByteArray:
        """(k, 3) its colours."""
        return np.array([color for color, _ in self.colors], dtype=np.uint8).reshape(-1, 3)


def read_legend(path: Path) -> RegionLegend:
    """The legend of a JSON file.

    :raises InputError: not such JSON
    """
    where = str(path)
    content = read_json_object(path, _MOST_BYTES)
    unknown = [key for key in content if not key.startswith("#") and key not in _KEYS]
    if unknown:
        raise InputError(where, f"key '{unknown[0][:60]}', expected colours like #ff0000, or {', '.join(_KEYS)}")
    named = [(_color(where, key), _name(where, value)) for key, value in content.items() if key.startswith("#")]
    regions = _mapping(where, content, "regions")
    named += [(_color(f"{where} -> {name[:60]}", value), name) for name, value in regions.items()]
    meshes = _mapping(where, content, "meshes")
    return RegionLegend(
        colors=tuple(named),
        outside=_name(where, content["outside"]) if "outside" in content else None,
        meshes={key: _name(f"{where} -> meshes", value) for key, value in meshes.items()},
        background=_color(f"{where} -> background", content["background"]) if "background" in content else None,
        where=where,
    )


def _mapping(where: str, content: dict[str, object], key: str) -> dict[str, object]:
    value = content.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"{where} -> {key}", f"{str(value)[:40]}, expected an object")
    return value


def _name(where: str, value: object) -> str:
    if not isinstance(value, str) or not value:
        raise InputError(where, f"{str(value)[:40]!r}, expected the name of a region")
    return value


def _color(where: str, value: object) -> RGB:
    if isinstance(value, str) and re.fullmatch(r"#([0-9a-fA-F]{3}|[0-9a-fA-F]{6})", value):
        digits = value[1:] if len(value) == 7 else "".join(digit * 2 for digit in value[1:])
        return int(digits[:2], 16), int(digits[2:4], 16), int(digits[4:], 16)
    if isinstance(value, list) and len(value) == 3 and all(type(one) is int and 0 <= one <= 255 for one in value):
        return value[0], value[1], value[2]
    raise InputError(where, f"colour {str(value)[:40]}, expected one like #ff0000 or [255, 0, 0]")


def _hex(color: RGB) -> str:
    return "#{:02x}{:02x}{:02x}".format(*color)


@dataclass(frozen=True, kw_only=True)
class RegionCount:
    """How much of some points a region has."""

    points: int  # with a mask above 0
    most: int  # where no other region has more
    share: float  # mean of the mask over the points, 0..1


@dataclass(frozen=True, kw_only=True)
class MeshRegions:
    """What one mesh got."""

    mesh: str
    points: int
    covered: int  # points that the map covers
    outside: int = 0  # points that it does not, and that got the legend's outside region
    kept: int = 0  # points that it does not, and that kept the regions they had
    regions: Mapping[str, RegionCount] = field(default_factory=dict)
    removed: tuple[str, ...] = ()  # regions that it had and has no more


@dataclass(frozen=True, kw_only=True)
class RegionsReport(Report):
    """What was authored, mesh by mesh: those with the map first, then those that the legend names."""

    meshes: tuple[MeshRegions, ...]


@dataclass(frozen=True, kw_only=True)
class SetRegions:
    """Regions of meshes from a map; those they had are replaced.

    Points that the map does not cover (UVs in other tiles, unpainted texels, no face) take the legend's outside
    region, or keep the regions they have. Other meshes keep theirs, but those that the legend's `meshes` names lie in
    one region whole; a region left without any point on the face is removed from all its meshes. Where point subsets
    stood for a mesh's regions they follow.

    :param image: (h, w, 3|4) uint8 pixels, top row first
    :param legend: what its colours mean
    :param mesh: names or globs of the meshes that the map covers, comma-separated; default the one with most points
    :param uv_set: the UV set that it was painted over; default ``st``, or a mesh's first
    """

    image: ByteArray
    legend: RegionLegend
    mesh: str | None = None
    uv_set: str | None = None
    where: str = "region map"  # what messages call the image
    sampling: MapSampling = field(default_factory=MapSampling)

    def __call__(self, face: Face) -> RegionsReport:
        """Author them.

        :raises InputError: no such mesh or UV set, a colour that the legend lacks, a region name that USD can't hold,
            points without map that have no region to keep, or meshes in instances
        """
        for name in self.legend.regions:
            check_region_name(self.legend.where, name)
        chosen = self._chosen(face)
        named = self._named(face, chosen)
        done = {mesh.name: self._mapped(face, mesh) for mesh in chosen}
        for mesh_name, region in named.items():
            points = len(mesh_of(face, mesh_name).points)
            whole = {one: np.full(points, float(one == region), np.float32) for one in self.legend.regions}
            done[mesh_name] = whole, MeshRegions(mesh=mesh_name, points=points, covered=0)
        masks_of = _without_dead(face, {name: masks for name, (masks, _) in done.items()}, self.legend.regions)
        reports = tuple(_counted(face, report, masks_of[name]) for name, (_, report) in done.items())
        for name, masks in masks_of.items():
            if name in done or len(masks) < len(mesh_of(face, name).regions):
                mesh, prim = mesh_of(face, name), face.mesh_prim(name)
                old = [region for region in mesh.regions if identifier(region) in mesh.point_subsets]
                if old:
                    # region -> the points where no other has more
                    first = np.argmax(np.stack(list(masks.values()), axis=1), axis=1)
                    author_region_subsets(
                        prim,
                        {
                            identifier(name): np.flatnonzero(first == number).astype(np.int32)
                            for number, name in enumerate(masks)
                        },
                        tuple(identifier(one) for one in old if one not in masks),
                    )
                author_regions(prim, replace(mesh, regions=masks))
        return RegionsReport(meshes=reports, warnings=self._warnings(face, reports, masks_of))

    def _chosen(self, face: Face) -> tuple[Mesh, ...]:
        if self.mesh is None:
            return (mesh_of(face, None),)
        names = select([mesh.name for mesh in face.meshes], self.mesh, "mesh")
        return tuple(mesh_of(face, name) for name in names) or (mesh_of(face, None),)

    def _named(self, face: Face, chosen: tuple[Mesh, ...]) -> dict[str, str]:
        """Mesh -> region, of those that the legend names."""
        mapped = {mesh.name for mesh in chosen}
        named: dict[str, str] = {}
        for glob, region in self.legend.meshes.items():
            names = [mesh.name for mesh in face.meshes if fnmatchcase(mesh.name, glob)]
            if not names:
                some = ", ".join(mesh.name for mesh in face.meshes[:6])
                raise InputError(f"{self.legend.where} -> meshes", f"'{glob[:60]}' matches none of {some}")
            if glob in mapped:
                raise InputError(f"{self.legend.where} -> meshes", f"'{glob}' has the map, expected another mesh")
            for name in names:
                if name not in mapped:
                    named.setdefault(name, region)
        return named

    def _mapped(self, face: Face, mesh: Mesh) -> tuple[Masks, MeshRegions]:
        """Masks of one mesh under the map, and what became of its points."""
        where = f"{face.where} -> {mesh.name}"
        uv = _uv_of(where, mesh, self.uv_set)
        background = self.legend.background
        shares, covered = region_masks(
            self.image,
            self.legend.color_array,
            np.asarray(uv.values)[mesh.face_vertex_indices if uv.indices is None else uv.indices],
            mesh.face_vertex_counts,
            mesh.face_vertex_indices,
            len(mesh.points),
            self.sampling,
            background=None if background is None else np.array(background, dtype=np.uint8),
            where=f"{self.where} -> {mesh.name}",
        )
        masks: dict[str, FloatArray] = {name: np.zeros(len(mesh.points)) for name in self.legend.regions}
        for (_, name), column in zip(self.legend.colors, shares.T, strict=True):
            # added up: several colours of a legend may be one region
            masks[name] += column
        bare = ~covered
        if not covered.any():
            tile = self.sampling.tile or "all"
            raise InputError(where, f"no UV lies on a painted texel of tile {tile}, expected some")
        if self.legend.outside:
            masks[self.legend.outside][bare] = 1.0
        elif bare.any():
            _keep(where, masks, mesh, bare)
        rest = int(bare.sum())
        outside = rest if self.legend.outside else 0
        report = MeshRegions(
            mesh=mesh.name, points=len(bare), covered=int(covered.sum()), outside=outside, kept=rest - outside
        )
        return {name: mask.astype(np.float32) for name, mask in masks.items()}, report

    def _warnings(self, face: Face, reports: tuple[MeshRegions, ...], masks_of: Mapping[str, Masks]) -> tuple[str, ...]:
        used = {mesh: [name for name, mask in masks.items() if np.any(mask)] for mesh, masks in masks_of.items()}
        empty = [name for name in self.legend.regions if not any(name in names for names in used.values())]
        warnings = [f"no point in {first_names(empty, 8)} of the legend"] if empty else []
        for report in reports:
            if report.kept:
                advice = 'which keep their regions; "outside" in the legend would give them another'
                warnings.append(f"{report.mesh}: the map does not cover {report.kept} points, {advice}")
        whole = mesh_of(face, None).name in {one.mesh for one in reports if one.covered}  # not one more loose part
        done = {one.mesh for one in reports} if whole else set(used)
        foreign = {mesh: [name for name in names if name not in self.legend.regions] for mesh, names in used.items()}
        meshes = [mesh for mesh, names in foreign.items() if names and mesh not in done]
        if meshes:
            names = first_names(list(dict.fromkeys(name for mesh in meshes for name in foreign[mesh])), 8)
            advice = f'"meshes" in the legend gives them one, like {{"{meshes[0]}": "{self.legend.regions[0]}"}}'
            warnings.append(f"{first_names(meshes, 8)} keep regions that the legend lacks ({names}); {advice}")
        return tuple(warnings)


def _keep(where: str, masks: dict[str, FloatArray], mesh: Mesh, bare: BoolArray) -> None:
    """Give points without map the regions that they have, in sum 1."""
    old = {name: np.maximum(np.asarray(mask, dtype=np.float64), 0.0) for name, mask in mesh.regions.items()}
    total = np.sum([np.zeros(len(bare)), *old.values()], axis=0)
    missing = int(np.count_nonzero(bare & (total <= 0)))
    if missing:
        what = f"{missing} points that the map does not cover have no region to keep"
        raise InputError(where, f"{what}, expected an `outside` region in the legend, or another tile")
    for name, mask in old.items():
        mine = masks.setdefault(name, np.zeros(len(bare)))
        mine[bare] = mask[bare] / total[bare]


def _without_dead(face: Face, done: Mapping[str, Masks], keep: tuple[str, ...]) -> dict[str, Masks]:
    """Masks of every mesh that has any, without the regions that no point of the face is left in."""
    every = dict(done)
    every |= {mesh.name: mesh.regions for mesh in face.meshes if mesh.name not in done and mesh.regions}
    alive = {name for masks in every.values() for name, mask in masks.items() if np.any(mask)} | set(keep)
    return {mesh: {name: mask for name, mask in masks.items() if name in alive} for mesh, masks in every.items()}


def _counted(face: Face, report: MeshRegions, masks: Masks) -> MeshRegions:
    old = mesh_of(face, report.mesh).regions
    return replace(report, regions=count_regions(masks), removed=tuple(name for name in old if name not in masks))


def count_regions(masks: Masks) -> dict[str, RegionCount]:
    """How much of the points (n,) each region has."""
    if not masks:
        return {}
    table = np.stack([np.asarray(mask, dtype=np.float64) for mask in masks.values()], axis=1)
    most = np.bincount(table.argmax(axis=1)[table.any(axis=1)], minlength=len(masks))
    return {
        name: RegionCount(
            points=int(np.count_nonzero(column)), most=int(first), share=float(column.mean()) if len(column) else 0.0
        )
        for name, column, first in zip(masks, table.T, most, strict=True)
    }


def region_table(regions: Mapping[str, RegionCount]) -> str:
    """How much of the points each region has, for people."""
    rows = [[name, one.points, one.most, f"{one.share * 100:.1f}%"] for name, one in regions.items()]
    return table([["region", "points", "most of", "share"], *rows])


def draw_regions(face: Face, path: Path) -> None:
    """A picture of the regions on the face, in its order a colour each."""
    from facepipe.pictures import PictureOptions, RegionColors, picture, save_png

    parts = face.parts()
    save_png(picture(parts, face.evaluate(), PictureOptions(regions=RegionColors.from_parts(parts))), path)


def _uv_of(where: str, mesh: Mesh, name: str | None) -> UvSet:
    named = {uv_set.name: uv_set for uv_set in mesh.uv_sets}
    if not named:
        raise InputError(where, "no UV set, expected one that the map was painted over")
    if name is not None and name not in named:
        raise InputError(where, unknown(name, named, "UV set"))
    return named[name] if name is not None else named.get("st", mesh.uv_sets[0])
