"""List the regions of a face; with --map author them from a picture painted over its UV layout.

The map is a PNG, the legend a JSON object {"#ff0000": "eyes", ...} or {"regions": {"eyes": "#ff0000", ...}}. Beside the
colours a legend may have "outside": the region of points that the map does not cover (without it they keep the regions
they have), "meshes": {"Eye*": "eyes"}: regions of other meshes, whole, and "background": a colour that means unpainted.
A map covers the UV tile 0 to 1 unless --tile says otherwise. OUT is an override layer over FACE.

examples:
  facepipe regions head.usdc --picture regions.png
  facepipe regions head.usdc --map map.png --legend legend.json -o head.regions.usda
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.core.names import first_names, identifier, select, unknown
from facepipe.core.reading import read_json_object
from facepipe.core.reports import Report, table
from facepipe.declare import beside, option, source
from facepipe.geometry.options import MapSampling
from facepipe.kinds import Job, StageAction, action
from facepipe.verbs.landmarks import mesh_of

if TYPE_CHECKING:
    from facepipe.core.arrays import BoolArray, ByteArray, FloatArray, IntArray
    from facepipe.parts import Mesh
    from facepipe.stage import Face

    Masks = Mapping[str, FloatArray]  # region -> (n,) how much of each point it has, 0..1

RGB = tuple[int, int, int]

MOST_COLORS = 512
_MOST_BYTES = 1 << 20  # of a legend
_KEYS = ("regions", "outside", "meshes", "background")
_TAKEN = "default"


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


@action("regions", "list regions, or author them from a painted map", remote=True)
@dataclass(frozen=True, kw_only=True)
class AuthorRegions(MapSampling, StageAction[RegionsReport]):
    """The action."""

    face: Path = source("face stage")
    map: Path = source("regions painted over the UV layout, a colour each", flag="--map", metavar="PNG")
    legend: Path = source("a JSON file that says which colour is which region", flag="--legend", metavar="JSON")
    mesh: str | None = option(None, "meshes the map covers, globs (default: that of most points)", metavar="NAMES")
    uv_set: str | None = option(None, "UV set that it was painted over (default: st, or the first)", metavar="NAME")
    picture: Path | None = beside("draw the regions on the face", ".png", "draw")

    def author(self, face: Face, job: Job) -> RegionsReport:
        from facepipe.core.images import read_png
        from facepipe.stage.skeleton import author_recipe

        recipe, image, legend = job.recipe(), read_png(self.map), read_legend(self.legend)
        report = set_regions(
            face, image, legend, mesh=self.mesh, uv_set=self.uv_set, where=str(self.map), sampling=self
        )
        author_recipe(face.prim, recipe)
        return report

    def draw(self, face: Face, report: RegionsReport, path: Path) -> None:
        """The picture of the regions."""
        draw_regions(face, path)

    def text(self, report: RegionsReport, out: Path) -> str:
        lines = []
        for mesh in report.meshes:
            counts = ((mesh.outside, "outside the map"), (mesh.kept, "kept"))
            facts = [f"{mesh.points} points", *(f"{count} {what}" for count, what in counts if count)]
            if not mesh.covered:
                facts += [f"all in {name}" for name, count in mesh.regions.items() if count.points]
            facts += [f"removed: {', '.join(mesh.removed)}"] if mesh.removed and mesh.covered else []
            lines.append(f"{out} -> {mesh.mesh}: {', '.join(facts)}")
            lines += [region_table(mesh.regions)] if mesh.covered else []
        return "\n".join(lines)


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
                both = f"#{bytes(color).hex()} for {seen[color]} and {name}"
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


def set_regions(
    face: Face,
    image: ByteArray,
    legend: RegionLegend,
    *,
    mesh: str | None = None,
    uv_set: str | None = None,
    where: str = "region map",
    sampling: MapSampling | None = None,
) -> RegionsReport:
    """Author regions of meshes from a map; those they had are replaced.

    Points that the map does not cover (UVs in other tiles, unpainted texels, no face) take the legend's outside
    region, or keep the regions they have. Other meshes keep theirs, but those that the legend's `meshes` names lie in
    one region whole; a region left without any point on the face is removed from all its meshes. Where point subsets
    stood for a mesh's regions they follow.

    :param image: (h, w, 3|4) uint8 pixels, top row first
    :param legend: what its colours mean
    :param mesh: names or globs of the meshes that the map covers, comma-separated; default the one with most points
    :param uv_set: the UV set that it was painted over; default ``st``, or a mesh's first
    :param where: what messages call the image
    :raises InputError: no such mesh or UV set, a colour that the legend lacks, a region name that USD can't hold,
        points without map that have no region to keep, or meshes in instances
    """
    import numpy as np

    from facepipe.stage.author_mesh import author_region_subsets, author_regions, check_region_name

    for name in legend.regions:
        check_region_name(legend.where, name)
    names = [] if mesh is None else select([one.name for one in face.meshes], mesh, "mesh")
    chosen = [mesh_of(face, name) for name in names] or [mesh_of(face, None)]
    whole = _named(face, legend, {one.name for one in chosen})
    done: dict[str, tuple[Masks, MeshRegions]] = {
        one.name: _mapped(face, one, image, legend, sampling or MapSampling(), uv_set, where) for one in chosen
    }
    for name, region in whole.items():
        points = len(mesh_of(face, name).points)
        in_region = {one: np.full(points, float(one == region), np.float32) for one in legend.regions}
        done[name] = in_region, MeshRegions(mesh=name, points=points, covered=0)
    masks_of: dict[str, Masks] = {name: masks for name, (masks, _) in done.items()}
    masks_of |= {one.name: one.regions for one in face.meshes if one.name not in done and one.regions}
    # regions that no point of the face is left in go from all meshes, but for those of the legend
    alive = {name for masks in masks_of.values() for name, mask in masks.items() if np.any(mask)} | {*legend.regions}
    masks_of = {one: {name: mask for name, mask in masks.items() if name in alive} for one, masks in masks_of.items()}
    reports = []
    for name, masks in masks_of.items():
        old, prim = mesh_of(face, name), face.mesh_prim(name)
        if name in done:
            removed = tuple(region for region in old.regions if region not in masks)
            reports.append(replace(done[name][1], regions=count_regions(masks), removed=removed))
        if name in done or len(masks) < len(old.regions):
            subsets = [region for region in old.regions if identifier(region) in old.point_subsets]
            if subsets:
                gone = tuple(identifier(region) for region in subsets if region not in masks)
                author_region_subsets(prim, _points_of(masks), gone)
            author_regions(prim, replace(old, regions=masks))
    return RegionsReport(meshes=tuple(reports), warnings=_warnings(face, legend, reports, masks_of))


def _points_of(masks: Masks) -> dict[str, IntArray]:
    """Point subset of a region -> the points where no other has more."""
    import numpy as np

    first = np.argmax(np.stack(list(masks.values()), axis=1), axis=1)
    return {identifier(name): np.flatnonzero(first == number).astype(np.int32) for number, name in enumerate(masks)}


def _named(face: Face, legend: RegionLegend, mapped: Collection[str]) -> dict[str, str]:
    """Mesh -> region, of those that the legend names and that are not `mapped`."""
    named: dict[str, str] = {}
    for glob, region in legend.meshes.items():
        names = [mesh.name for mesh in face.meshes if fnmatchcase(mesh.name, glob)]
        if not names:
            some = ", ".join(mesh.name for mesh in face.meshes[:6])
            raise InputError(f"{legend.where} -> meshes", f"'{glob[:60]}' matches none of {some}")
        if glob in mapped:
            raise InputError(f"{legend.where} -> meshes", f"'{glob}' has the map, expected another mesh")
        for name in names:
            if name not in mapped:
                named.setdefault(name, region)
    return named


def _mapped(
    face: Face,
    mesh: Mesh,
    image: ByteArray,
    legend: RegionLegend,
    sampling: MapSampling,
    uv_set: str | None,
    map_name: str,
) -> tuple[Masks, MeshRegions]:
    """Masks of one mesh under the map, and what became of its points."""
    import numpy as np

    from facepipe.geometry.region_map import region_masks

    where = f"{face.where} -> {mesh.name}"
    uv_sets = {one.name: one for one in mesh.uv_sets}
    if not uv_sets:
        raise InputError(where, "no UV set, expected one that the map was painted over")
    if uv_set is not None and uv_set not in uv_sets:
        raise InputError(where, unknown(uv_set, uv_sets, "UV set"))
    uv = uv_sets[uv_set] if uv_set is not None else uv_sets.get("st", mesh.uv_sets[0])
    shares, covered = region_masks(
        image,
        np.array([color for color, _ in legend.colors], dtype=np.uint8).reshape(-1, 3),
        np.asarray(uv.values)[mesh.face_vertex_indices if uv.indices is None else uv.indices],
        mesh.face_vertex_counts,
        mesh.face_vertex_indices,
        len(mesh.points),
        sampling,
        background=None if legend.background is None else np.array(legend.background, dtype=np.uint8),
        where=f"{map_name} -> {mesh.name}",
    )
    masks: dict[str, FloatArray] = {name: np.zeros(len(mesh.points)) for name in legend.regions}
    for (_, name), column in zip(legend.colors, shares.T, strict=True):
        # added up: several colours of a legend may be one region
        masks[name] += column
    bare = ~covered
    if not covered.any():
        raise InputError(where, f"no UV lies on a painted texel of tile {sampling.tile or 'all'}, expected some")
    if legend.outside:
        masks[legend.outside][bare] = 1.0
    elif bare.any():
        _keep(where, masks, mesh, bare)
    rest = int(bare.sum())
    outside = rest if legend.outside else 0
    report = MeshRegions(
        mesh=mesh.name, points=len(bare), covered=int(covered.sum()), outside=outside, kept=rest - outside
    )
    return {name: mask.astype(np.float32) for name, mask in masks.items()}, report


def _keep(where: str, masks: dict[str, FloatArray], mesh: Mesh, bare: BoolArray) -> None:
    """Give points without map the regions that they have, in sum 1."""
    import numpy as np

    old = {name: np.maximum(np.asarray(mask, dtype=np.float64), 0.0) for name, mask in mesh.regions.items()}
    total = np.sum([np.zeros(len(bare)), *old.values()], axis=0)
    missing = int(np.count_nonzero(bare & (total <= 0)))
    if missing:
        what = f"{missing} points that the map does not cover have no region to keep"
        raise InputError(where, f"{what}, expected an `outside` region in the legend, or another tile")
    for name, mask in old.items():
        mine = masks.setdefault(name, np.zeros(len(bare)))
        mine[bare] = mask[bare] / total[bare]


def _warnings(
    face: Face, legend: RegionLegend, reports: Sequence[MeshRegions], masks_of: Mapping[str, Masks]
) -> tuple[str, ...]:
    used = {mesh: [name for name, mask in masks.items() if mask.any()] for mesh, masks in masks_of.items()}
    empty = [name for name in legend.regions if not any(name in names for names in used.values())]
    warnings = [f"no point in {first_names(empty, 8)} of the legend"] if empty else []
    for report in reports:
        if report.kept:
            advice = 'which keep their regions; "outside" in the legend would give them another'
            warnings.append(f"{report.mesh}: the map does not cover {report.kept} points, {advice}")
    whole = mesh_of(face, None).name in {one.mesh for one in reports if one.covered}  # not one more loose part
    done = {one.mesh for one in reports} if whole else set(used)
    foreign = {mesh: [name for name in names if name not in legend.regions] for mesh, names in used.items()}
    meshes = [mesh for mesh, names in foreign.items() if names and mesh not in done]
    if meshes:
        names = first_names(list(dict.fromkeys(name for mesh in meshes for name in foreign[mesh])), 8)
        advice = f'"meshes" in the legend gives them one, like {{"{meshes[0]}": "{legend.regions[0]}"}}'
        warnings.append(f"{first_names(meshes, 8)} keep regions that the legend lacks ({names}); {advice}")
    return tuple(warnings)


def count_regions(masks: Masks) -> dict[str, RegionCount]:
    """How much of the points (n,) each region has."""
    import numpy as np

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
