"""Regions from painted maps: what a map shows is what the masks say, and nothing half-done is written."""

from __future__ import annotations

import dataclasses
import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import done, failed, run
from faces import grid_mesh, replace_mesh, tiny_face, with_head, with_meshes
from hypothesis import given, settings
from hypothesis import strategies as st
from import_data import damaged, refused, shared
from photo_files import png_of
from pxr import Sdf
from region_painter import COLORS, legend_of, paint, save

import facepipe
from facepipe.checks import validate
from facepipe.core.errors import InputError
from facepipe.core.images import read_png
from facepipe.geometry.options import MapSampling
from facepipe.geometry.region_map import region_masks
from facepipe.parts import FaceParts, Mesh, UvSet
from facepipe.pictures import HeatMap, PictureOptions, RegionColors, picture
from facepipe.pictures.overlay import NO_VALUE, region_colors
from facepipe.stage import Face, save_parts
from facepipe.verbs.regions import RegionLegend, RegionsReport, read_legend, set_regions

RED, GREEN, BLUE = COLORS[:3]
Array = np.ndarray[Any, Any]


def masks_at(image: Array, uv: Any, colors: Array = COLORS[:3], **options: Any) -> Array:
    """(n, k) masks of points that each have one UV: faces of three corners at one place."""
    background = options.pop("background", None)
    corners, counts = np.arange(len(uv)).repeat(3), np.full(len(uv), 3)
    sampling = MapSampling(**options)
    return region_masks(
        image, colors, np.array(uv)[corners], counts, corners, len(uv), sampling, background=background
    ).masks


def solid(*rows: tuple[Array, ...], alpha: bool = False) -> Array:
    """An image of texels, top row first."""
    image = np.array(rows, np.uint8)
    return np.dstack([image, np.full(image.shape[:2], 255, np.uint8)]) if alpha else image


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample head on disk, with a map painted from its own masks and a legend beside it."""
    from small_head import make

    folder = tmp_path_factory.mktemp("sample")
    parts = paintable(make())
    save_parts(parts, folder / "head.usdc")
    save(paint(parts.meshes[0], 1024), folder / "map.png")
    (folder / "legend.json").write_text(json.dumps(legend_of(list(parts.meshes[0].regions))))
    return folder / "head.usdc"


def paintable(parts: FaceParts) -> FaceParts:
    """The head with both tiles of its UVs side by side in one, and hard regions beside the soft ones."""
    head = parts.meshes[0]
    (uv,) = head.uv_sets
    return with_head(
        parts,
        uv_sets=(replace(uv, values=uv.values * np.float32([0.5, 1.0])),),
        point_subsets={name: np.flatnonzero(mask > 0.75).astype(np.int32) for name, mask in head.regions.items()},
    )


# --- what a texel says -------------------------------------------------------------------------------------------


def test_v_is_up_and_a_uv_takes_the_texel_it_lies_in() -> None:
    image = solid((RED, GREEN), (BLUE, BLUE))
    masks = masks_at(image, [(0.1, 0.9), (0.9, 0.9), (0.4, 0.51), (0.1, 0.1), (0.9, 0.49), (0.999, 0.999), (0.0, 0.0)])
    assert masks.argmax(axis=1).tolist() == [0, 1, 0, 2, 2, 1, 2]
    assert (masks.sum(axis=1) == 1).all()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_a_map_of_pure_colours_is_looked_up_exactly(seed: int, factor: int) -> None:
    """Against integer indexing; whole enlargements of a map, and the legend's order, change nothing."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 3, (rng.integers(1, 9), rng.integers(1, 9)))
    uv = rng.random((50, 2))
    height, width = labels.shape
    there = labels[np.floor((1 - uv[:, 1]) * height).astype(int), np.floor(uv[:, 0] * width).astype(int)]
    image = COLORS[labels]
    assert np.array_equal(masks_at(image, uv), np.eye(3)[there])
    assert np.array_equal(masks_at(image.repeat(factor, axis=0).repeat(factor, axis=1), uv), np.eye(3)[there])
    assert np.array_equal(masks_at(image, uv, COLORS[[2, 0, 1]]), np.eye(3)[there][:, [2, 0, 1]])


def test_a_point_on_a_seam_takes_the_mean_over_its_corners() -> None:
    """Four faces at point 0, one of them beyond the seam; the face in the next tile is left out."""
    left, right, next_tile = (0.2, 0.5), (0.8, 0.5), (1.5, 0.5)
    uv = np.array([left] * 9 + [right] * 3 + [next_tile] * 3)
    points = np.array([0, 1, 2] * 3 + [0, 3, 4] + [4, 5, 6])
    found = region_masks(solid((RED, GREEN)), COLORS[:2], uv, np.full(5, 3), points, 7, MapSampling())
    expected = [(0.75, 0.25), (1, 0), (1, 0), (0, 1), (0, 1), (0, 0), (0, 0)]
    assert np.allclose(found.masks, expected, atol=1e-15)
    assert found.covered.tolist() == [True] * 5 + [False] * 2


def test_tiles() -> None:
    image = solid((RED, GREEN))
    uv = [(0.2, 0.5), (1.8, 0.5), (1.8, 1.5), (-0.8, 0.5)]
    assert masks_at(image, uv).sum(axis=1).tolist() == [1, 0, 0, 0]
    assert masks_at(image, uv, tile=1002)[:, 1].tolist() == [0, 1, 0, 0]
    assert masks_at(image, uv, tile=1012)[:, 1].tolist() == [0, 0, 1, 0]
    assert masks_at(image, uv, tile=None).argmax(axis=1).tolist() == [0, 1, 1, 0]


@pytest.mark.parametrize("tile", [1001, 1002, None])
def test_the_line_between_two_tiles_belongs_to_the_faces_on_either_side(tile: int | None) -> None:
    """Triangles left and right of u = 1 with corners of their own on it."""
    uv = np.array([(0.6, 0.5), (1.0, 0.4), (1.0, 0.6), (1.4, 0.5), (1.0, 0.6), (1.0, 0.4)])
    found = region_masks(
        solid((RED, GREEN)), COLORS[:2], uv, np.array([3, 3]), np.arange(6), 6, MapSampling(tile=tile)
    ).masks
    left, right = (tile != 1002) * 1.0, (tile != 1001) * 1.0
    assert np.array_equal(found, [(0, left)] * 3 + [(right, 0)] * 3)


def test_an_antialiased_texel_counts_by_its_shares() -> None:
    quarter = (RED * 0.25 + BLUE * 0.75).round().astype(np.uint8)
    image = solid((RED, quarter, BLUE))
    masks = masks_at(image, [(0.5, 0.5)])
    assert np.allclose(masks, [(0.25, 0, 0.75)], atol=2 / 255)
    third = np.round(RED / 3 + GREEN / 3 + BLUE / 3).astype(np.uint8)
    masks = masks_at(solid((RED, third, BLUE), (RED, GREEN, BLUE)), [(0.5, 0.75)])
    assert np.allclose(masks, 1 / 3, atol=3 / 255)


def test_a_shrunken_map_reads_as_the_mean_of_the_fine_one() -> None:
    """Area filtering commutes with the lookup, up to the rounding of colours to 8 bits."""
    labels = (np.add.outer(np.arange(64), 0.6 * np.arange(64)) > 50).astype(int) + (np.arange(64) > 40)
    fine = COLORS[labels]
    coarse = fine.reshape(16, 4, 16, 4, 3).mean(axis=(1, 3)).round().astype(np.uint8)
    centres = (np.stack(np.meshgrid(np.arange(16), np.arange(16)), axis=-1).reshape(-1, 2) + 0.5) / 16
    expected = np.eye(3)[labels].reshape(16, 4, 16, 4, 3).mean(axis=(1, 3))[::-1].reshape(-1, 3)
    assert (expected.max(axis=1) < 1).mean() > 0.1  # there are borders
    assert np.abs(masks_at(coarse, centres) - expected).max() < 0.02


def test_a_border_is_not_taken_for_a_region_whose_colour_lies_between() -> None:
    """Red to blue over three texels, the middle one about the purple of a third region, which is elsewhere."""
    purple, about = np.array((128, 0, 127), np.uint8), np.array((126, 2, 129), np.uint8)
    colors = np.stack([RED, BLUE, purple])
    image = solid((RED, RED, about, BLUE, BLUE, purple, purple, purple, about, purple))
    masks = masks_at(image, [(0.25, 0.5), (0.85, 0.5)], colors, edge=1)
    assert np.allclose(masks[0], (0.5, 0.5, 0), atol=0.02)
    assert masks[1].tolist() == [0, 0, 1]


def test_a_footprint_measures_area() -> None:
    image = COLORS[np.repeat((np.arange(64) >= 32).astype(int)[None], 64, axis=0)]
    u = np.linspace(0.3, 0.7, 41)
    found = masks_at(image, np.stack([u, np.full(41, 0.5)], axis=1), footprint=8)[:, 1]
    exact = np.clip((u * 64 - 32) / 8 + 0.5, 0, 1)
    assert np.abs(found - exact).max() <= 1 / 16 + 1e-9  # eight taps a side
    assert (np.diff(found) >= 0).all()
    assert found[0] == 0
    assert found[-1] == 1


def test_an_unknown_colour_is_named_with_its_points_and_the_nearest() -> None:
    image = solid((RED, RED), (RED, np.array((250, 120, 0), np.uint8)))
    with pytest.raises(InputError) as caught:
        masks_at(image, [(0.1, 0.9), (0.9, 0.1), (0.8, 0.2)])
    text = str(caught.value)
    assert "texel 1, 1" in text
    assert "#fa7800 at 2 points" in text
    assert "#ff0000" in text
    assert "120 away" in text
    assert (masks_at(image, [(0.1, 0.9), (0.3, 0.1)])[:, 0] == 1).all()  # nothing looks there: no matter
    assert masks_at(image, [(0.9, 0.1)], tolerance=130)[0].tolist() == [1, 0, 0]


def test_the_tolerance_is_a_distance_in_rgb() -> None:
    near = solid((np.array((250, 5, 5), np.uint8),))
    assert masks_at(near, [(0.5, 0.5)], tolerance=8.7)[0, 0] == 1
    with pytest.raises(InputError, match="9 away"):
        masks_at(near, [(0.5, 0.5)], tolerance=8.6)


def test_paint_reaches_a_little_beyond_its_end_and_no_farther() -> None:
    image = np.zeros((1, 8, 4), np.uint8)
    image[0, :2] = (*RED, 255)
    uv = [((column + 0.5) / 8, 0.5) for column in range(8)]
    assert masks_at(image, uv, edge=2)[:, 0].tolist() == [1, 1, 1, 1, 0, 0, 0, 0]
    assert masks_at(image, uv, edge=0)[:, 0].tolist() == [1, 1, 0, 0, 0, 0, 0, 0]
    black = np.where(image[..., 3:] > 0, image[..., :3], 0)
    black[0, 2] = RED // 2  # antialiased against the background: still red
    assert masks_at(black, uv, edge=2, background=np.zeros(3, np.uint8))[:, 0].tolist() == [1, 1, 1, 1, 0, 0, 0, 0]
    with pytest.raises(InputError, match=r"#[0-9a-f]{6} at"):
        masks_at(black, uv)


@pytest.mark.parametrize(
    "options",
    [{"tolerance": -1.0}, {"tolerance": float("nan")}, {"edge": 9}, {"footprint": 0}, {"footprint": 257}, {"tile": 7}],
)
def test_options_out_of_range(options: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(options))):
        MapSampling(**options)


# --- on faces ----------------------------------------------------------------------------------------------------


def compare(source: Mesh, found: Mesh) -> tuple[float, float]:
    """Share of points whose region is the same, of those inside a region and of all."""
    before = np.stack([np.asarray(mask, np.float64) for mask in source.regions.values()], axis=1)
    after = np.stack([found.regions[name] for name in source.regions], axis=1)
    assert np.abs(after.sum(axis=1) - 1).max() < 1e-6
    ranked = np.sort(before, axis=1)
    same = before.argmax(axis=1) == after.argmax(axis=1)
    return float(same[ranked[:, -1] - ranked[:, -2] > 0.1].mean()), float(same.mean())


def test_the_command_on_the_sample(sample: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A map painted from its masks gives its regions back; the layer is valid and holds what changed alone."""
    out, again, drawn = tmp_path / "out.usda", tmp_path / "again.usda", tmp_path / "out.png"
    before = sample.read_bytes()
    words = ["regions", sample, "--map", sample.parent / "map.png", "--legend", sample.parent / "legend.json"]
    text = done(capsys, *words, "-o", out, "--picture", drawn, "--json")
    result = json.loads(text)
    source, head = facepipe.open(sample).meshes[0], facepipe.open(out).meshes[0]
    inside, everywhere = compare(source, head)
    assert inside > 0.999
    assert everywhere > 0.99
    (one,) = result["meshes"]
    count = len(source.points)
    assert (one["mesh"], one["points"], one["covered"], one["kept"], one["removed"]) == ("Head", count, count, 0, [])
    for name, mask in head.regions.items():
        assert one["regions"][name]["points"] == np.count_nonzero(mask)
        assert one["regions"][name]["share"] == pytest.approx(mask.mean())
        hard = head.point_subsets[name]  # the sample has subsets, and they follow
        assert (mask[hard] >= 0.5).all()
    assert validate(out) == ()
    assert sample.read_bytes() == before
    done(capsys, *words, "-o", again)
    assert again.read_bytes() == out.read_bytes()
    assert set(authored(out)) == {
        *(f"/Face/Head.primvars:facepipe:region:{name}" for name in head.regions),
        *(f"/Face/Head/{name}.{what}" for name in head.regions for what in ("elementType", "familyName", "indices")),
        *(f"/Face.facepipe:recipe:{what}" for what in ("verb", "sources", "digests", "options", "version")),
    }
    recipe = facepipe.open(out).parts().recipe
    assert recipe is not None
    assert (recipe.verb, len(recipe.sources), recipe.options["tile"]) == ("regions", 3, 1001)


def authored(path: Path) -> list[str]:
    """Paths of every property that a layer itself holds."""
    layer, paths = Sdf.Layer.OpenAsAnonymous(str(path)), []
    layer.Traverse("/", lambda where: paths.append(str(where)) if where.IsPropertyPath() else None)
    return paths


@pytest.mark.slow
def test_ict_tile_by_tile(tmp_path: Path) -> None:
    """The ICT head's UVs fill two tiles: a map of each, one after the other, gives all of its regions back."""
    from facepipe.importers import load

    save_parts(load("ict", shared("ict_facekit/ict_facekit.npz")).parts, tmp_path / "0.usdc")
    mesh = facepipe.open(tmp_path / "0.usdc").meshes[0]
    colors = tuple((tuple(COLORS[number].tolist()), name) for number, name in enumerate(mesh.regions))
    covered = []
    for number in range(2):
        author = partial(
            set_regions,
            image=paint(mesh, 1024, tile=(number, 0)),
            legend=RegionLegend(colors=colors),  # type: ignore[arg-type]
            sampling=MapSampling(tile=1001 + number),
        )
        with facepipe.open(tmp_path / f"{number}.usdc").deriving(tmp_path / f"{number + 1}.usdc") as face:
            (report,) = author(face).meshes
        covered.append(report.covered)
        assert report.covered + report.kept == len(mesh.points)
    assert sum(covered) >= len(mesh.points)
    assert min(covered) > 0
    inside, everywhere = compare(mesh, facepipe.open(tmp_path / "2.usdc").meshes[0])
    assert inside > 0.999
    assert everywhere > 0.99
    assert validate(tmp_path / "2.usdc") == ()


def halves(*names: str, **more: Any) -> RegionLegend:
    """A legend of red, green, ..."""
    return RegionLegend(
        colors=tuple((tuple(color.tolist()), name) for color, name in zip(COLORS, names, strict=False)),  # type: ignore[misc]
        **more,
    )


LEFT_RIGHT = solid((RED, GREEN))


def derived(source: Path, out: Path, processor: Callable[[Face], RegionsReport]) -> tuple[Any, Face]:
    """The report, and the face as it is read back; it has to be valid."""
    with facepipe.open(source).deriving(out) as face:
        report = processor(face)
    assert validate(out) == ()
    return report, facepipe.open(out)


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A head with regions mouth and neck, and teeth without."""
    save_parts(tiny_face(), tmp_path / "tiny.usda")
    return tmp_path / "tiny.usda"


def test_a_new_set_of_regions_replaces_the_old_one(tiny: Path, tmp_path: Path) -> None:
    report, face = derived(
        tiny, tmp_path / "a.usda", partial(set_regions, image=LEFT_RIGHT, legend=halves("left", "right"))
    )
    head, teeth = face.meshes
    assert report.meshes[0].removed == ("mouth", "neck")
    assert set(head.regions) == {"left", "right"}
    assert teeth.regions == {}
    assert np.array_equal(head.regions["left"], tiny_face().meshes[0].points[:, 0] < 0)
    assert [name for name in face.mesh_prim("Head").GetAppliedSchemas() if "Region" in name] == [
        "FacepipeRegionAPI:left",
        "FacepipeRegionAPI:right",
    ]
    assert set(head.point_subsets) == {"lips"}  # named for no region: left alone
    _, back = derived(
        tmp_path / "a.usda", tmp_path / "b.usda", partial(set_regions, image=LEFT_RIGHT, legend=halves("neck", "mouth"))
    )
    assert set(back.meshes[0].regions) == {"mouth", "neck"}
    with back.deriving(tmp_path / "flat.usda", flatten=True) as _:
        pass
    assert set(facepipe.open(tmp_path / "flat.usda").meshes[0].regions) == {"mouth", "neck"}


def test_the_same_map_again_changes_nothing(tiny: Path, tmp_path: Path) -> None:
    processor = partial(set_regions, image=LEFT_RIGHT, legend=halves("left", "right", meshes={"Teeth": "left"}))
    derived(tiny, tmp_path / "a.usda", processor)
    derived(tmp_path / "a.usda", tmp_path / "b.usda", processor)
    assert authored(tmp_path / "a.usda")
    assert authored(tmp_path / "b.usda") == []


def test_indexed_masks_are_replaced_whole(tiny: Path, tmp_path: Path) -> None:
    """A region with indices in the source, which must not index the new values."""
    from pxr import UsdGeom, Vt

    with facepipe.open(tiny).deriving(tmp_path / "indexed.usda") as face:
        primvar = UsdGeom.PrimvarsAPI(face.mesh_prim("Head")).GetPrimvar("facepipe:region:mouth")
        primvar.Set(Vt.FloatArray([0.0, 1.0]))
        primvar.SetIndices(Vt.IntArray([0, 1] * 18))
    _, face = derived(
        tmp_path / "indexed.usda",
        tmp_path / "a.usda",
        partial(set_regions, image=LEFT_RIGHT, legend=halves("mouth", "neck")),
    )
    assert np.array_equal(face.meshes[0].regions["mouth"], tiny_face().meshes[0].points[:, 0] < 0)


def test_meshes_that_the_legend_names_lie_in_one_region(tiny: Path, tmp_path: Path) -> None:
    legend = halves("left", "right", meshes={"Te*": "teeth"})
    report, face = derived(tiny, tmp_path / "a.usda", partial(set_regions, image=LEFT_RIGHT, legend=legend))
    masks = face.meshes[1].regions
    assert (masks["teeth"] == 1).all()
    assert not masks["left"].any()
    assert not masks["right"].any()
    assert [mesh.mesh for mesh in report.meshes] == ["Head", "Teeth"]
    assert report.warnings == ()


def test_loose_meshes_that_keep_regions_of_another_set_are_named(sample: Path, tmp_path: Path) -> None:
    legend = halves("left", "right")
    report, face = derived(sample, tmp_path / "a.usdc", partial(set_regions, image=LEFT_RIGHT, legend=legend))
    (warning,) = report.warnings
    assert warning.startswith("GumsAndTongue, Teeth, EyeballLeft")
    assert "keep regions that the legend lacks (mouth, eyes" in warning
    assert warning.endswith('"meshes" in the legend gives them one, like {"GumsAndTongue": "left"}')
    hint = json.loads(warning.rpartition(" like ")[2])
    assert hint == {"GumsAndTongue": "left"}
    assert set(face.meshes[0].point_subsets) == {"left", "right"}  # those of the old regions went with them
    kept = set().union(*(mesh.regions for mesh in face.meshes[1:]))
    assert kept == {"eyes", "mouth"}  # those where no point is left are gone from all
    whole = {"Eye*": "left", "*": "right"}
    report, face = derived(
        sample,
        tmp_path / "b.usdc",
        partial(set_regions, image=LEFT_RIGHT, legend=halves("left", "right", meshes=whole)),
    )
    assert report.warnings == ()
    assert all(set(mesh.regions) == {"left", "right"} for mesh in face.meshes)


def in_two_tiles() -> FaceParts:
    """The tiny face with the upper half of its head in the next tile."""
    parts = tiny_face()
    head = parts.meshes[0]
    uv = head.uv_sets[0].values.copy()
    uv[uv[:, 1] > 0.5] += (1.0, 0.0)
    uv[uv[:, 0] == 1.0] += (1e-3, 0.0)
    return dataclasses.replace(parts, meshes=(replace_mesh(head, uv_sets=(UvSet(values=uv),)), parts.meshes[1]))


def test_points_that_the_map_does_not_cover(tmp_path: Path) -> None:
    parts = in_two_tiles()
    save_parts(parts, tmp_path / "tiny.usda")
    old = parts.meshes[0]
    inside = (old.uv_sets[0].values <= 1).all(axis=1)
    keeping = partial(set_regions, image=LEFT_RIGHT, legend=halves("left", "right"))
    report, face = derived(tmp_path / "tiny.usda", tmp_path / "a.usda", keeping)
    head = face.meshes[0]
    for name in ("mouth", "neck"):
        assert np.allclose(head.regions[name], np.where(inside, 0, old.regions[name]), atol=1e-6)
    assert report.meshes[0].covered == inside.sum()
    assert report.meshes[0].kept == (~inside).sum()
    (warning,) = report.warnings
    assert "keep their regions" in warning
    assert '"outside"' in warning
    outside = partial(set_regions, image=LEFT_RIGHT, legend=halves("left", "right", outside="skull"))
    report, face = derived(tmp_path / "tiny.usda", tmp_path / "b.usda", outside)
    assert set(face.meshes[0].regions) == {"left", "right", "skull"}
    assert np.array_equal(face.meshes[0].regions["skull"], ~inside)
    assert report.meshes[0].outside == (~inside).sum()
    bare = dataclasses.replace(parts, meshes=(replace_mesh(old, regions={}),))
    with pytest.raises(InputError, match="no region to keep"):
        keeping(Face.from_parts(bare))


def test_one_map_for_several_meshes(tiny: Path, tmp_path: Path) -> None:
    processor = partial(set_regions, image=LEFT_RIGHT, legend=halves("left", "right"), mesh="Head,Teeth")
    report, face = derived(tiny, tmp_path / "a.usda", processor)
    assert [one.covered for one in report.meshes] == [36, 9]
    assert all(set(mesh.regions) == {"left", "right"} for mesh in face.meshes)


# --- files -------------------------------------------------------------------------------------------------------


def png(path: Path, mode: str) -> Path:
    """Left black or red, right white or green, as a PNG of some kind."""
    from PIL import Image

    if mode == "RGB;16":  # which Pillow can't write
        row = b"\0" + struct.pack(">6H", 65535, 0, 0, 0, 65535, 0)

        def chunk(kind: bytes, data: bytes) -> bytes:
            return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

        header = chunk(b"IHDR", struct.pack(">2I5B", 2, 1, 16, 2, 0, 0, 0))
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(row)) + chunk(b"IEND", b""))
        return path
    if mode == "I;16":
        image = Image.fromarray(np.array([[0, 65535]], np.uint16))
    elif mode in ("L", "LA", "1"):
        image = Image.fromarray(np.array([[0, 255]], np.uint8)).convert(mode)
    elif mode == "P":
        image = Image.fromarray(np.array([[1, 2]], np.uint8), mode="P")
        image.putpalette([9, 9, 9, 255, 0, 0, 0, 255, 0])
    else:
        image = Image.fromarray(LEFT_RIGHT).convert(mode)
    image.save(path)
    return path


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P", "RGB;16", "L", "LA", "1", "I;16"])
def test_every_kind_of_png_means_the_same(tmp_path: Path, mode: str) -> None:
    image = read_png(png(tmp_path / "map.png", mode))
    grey = mode in ("L", "LA", "1", "I;16")
    expected = [[0, 0, 0], [255, 255, 255]] if grey else [[255, 0, 0], [0, 255, 0]]
    assert image[0, :, :3].tolist() == expected
    assert image.shape[2] == 3 or (image[..., 3] == 255).all()


GOOD = {"#ff0000": "left", "#00ff00": "right"}
BAD_LEGENDS = {
    "not json": "{",
    "a list": "[]",
    "empty": "{}",
    "no regions": '{"regions": {}, "outside": "left"}',
    "a key twice": '{"#ff0000": "left", "#ff0000": "right"}',
    "a colour twice": json.dumps({**GOOD, "#F00": "third"}),
    "background twice": json.dumps({**GOOD, "background": "#ff0000"}),
    "unknown key": json.dumps({**GOOD, "outsid": "left"}),
    "no colour": json.dumps({"#ff000": "left"}),
    "large channel": json.dumps({"regions": {"left": [256, 0, 0]}}),
    "boolean channel": json.dumps({"regions": {"left": [True, 0, 0]}}),
    "number as name": json.dumps({"#ff0000": 3}),
    "name with a space": json.dumps({**GOOD, "#ff0000": "left half"}),
    "name with a digit first": json.dumps({**GOOD, "#ff0000": "1st"}),
    "reserved name": json.dumps({**GOOD, "#ff0000": "eyes:indices"}),
    "outside that USD can't hold": json.dumps({**GOOD, "outside": "neck!"}),
    "unknown mesh": json.dumps({**GOOD, "meshes": {"Hair": "left"}}),
    "mesh with map": json.dumps({**GOOD, "meshes": {"Head": "left"}}),
    "meshes as list": json.dumps({**GOOD, "meshes": ["Teeth"]}),
    "a region called default": json.dumps({**GOOD, "#ff0000": "default"}),
    "outside called default": json.dumps({**GOOD, "outside": "default"}),
    "colour missing": json.dumps({"#ff0000": "left", "#0000ff": "right"}),
    "binary": "\x00\xff",
}


@pytest.mark.parametrize("legend", BAD_LEGENDS.values(), ids=BAD_LEGENDS)
def test_bad_legends_are_one_line_and_write_nothing(
    tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], legend: str
) -> None:
    save(LEFT_RIGHT, tmp_path / "map.png")
    (tmp_path / "legend.json").write_text(legend)
    refuses(capsys, tmp_path, tiny)


@pytest.mark.parametrize("kind", ["empty", "text", "cut", "jpeg", "missing", "folder"])
def test_bad_maps_are_one_line_and_write_nothing(
    tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    from PIL import Image

    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    data = save(image, tmp_path / "map.png").read_bytes()
    (tmp_path / "map.png").unlink()
    if kind == "jpeg":
        Image.fromarray(image).save(tmp_path / "map.png", format="JPEG")
    elif kind == "folder":
        (tmp_path / "map.png").mkdir()
    elif kind != "missing":
        (tmp_path / "map.png").write_bytes({"empty": b"", "text": b"red\n", "cut": data[:2000]}[kind])
    (tmp_path / "legend.json").write_text(json.dumps(GOOD))
    assert "map.png" in refuses(capsys, tmp_path, tiny)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--mesh", "Nobody"], "Nobody"),
        (["--uv-set", "st2"], "st2"),
        (["--tile", "1002"], "tile 1002"),
        (["--tile", "left"], "tile"),
        (["--tolerance", "-1"], "tolerance"),
        (["--edge", "99"], "edge"),
        (["--picture", "out.jpg"], ".png"),
    ],
)
def test_bad_options_are_one_line_and_write_nothing(
    tiny: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
    expected: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    save(LEFT_RIGHT, tmp_path / "map.png")
    (tmp_path / "legend.json").write_text(json.dumps(GOOD))
    assert expected in refuses(capsys, tmp_path, tiny, *words)


def test_a_mesh_without_uvs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = tiny_face()
    bare = with_meshes(parts, uv_sets=())
    save_parts(bare, tmp_path / "tiny.usda")
    save(LEFT_RIGHT, tmp_path / "map.png")
    (tmp_path / "legend.json").write_text(json.dumps(GOOD))
    assert "tiny.usda -> </Tiny> -> Head: no UV set" in refuses(capsys, tmp_path, tmp_path / "tiny.usda")


def refuses(capsys: pytest.CaptureFixture[str], folder: Path, face: Path, *words: str) -> str:
    """The one line that the command says; it must write nothing."""
    files = ["--map", folder / "map.png", "--legend", folder / "legend.json", "-o", folder / "out.usda"]
    return failed(capsys, "regions", face, *files, *words, folder=folder)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_maps_and_legends_read_or_say_why(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:

    folder = tmp_path_factory.mktemp("damaged")
    (folder / "map.png").write_bytes(data.draw(damaged(png_of(LEFT_RIGHT))))
    (folder / "legend.json").write_bytes(data.draw(damaged(json.dumps(legend_of(["a", "b"], outside="c")).encode())))
    refused(lambda: read_png(folder / "map.png"), folder / "map.png")
    refused(lambda: read_legend(folder / "legend.json"), folder / "legend.json")


def test_both_forms_of_a_legend_mean_the_same(tmp_path: Path) -> None:
    more = {"outside": "neck", "meshes": {"Eye*": "eyes"}, "background": "#000"}
    flat, nested = tmp_path / "flat.json", tmp_path / "nested.json"
    flat.write_text(json.dumps({"#ff0000": "left", "#0F0": "right", **more}))
    nested.write_text(json.dumps({"regions": {"left": [255, 0, 0], "right": "#00ff00"}, **more}))
    assert read_legend(flat).colors == read_legend(nested).colors == (((255, 0, 0), "left"), ((0, 255, 0), "right"))
    assert read_legend(flat).regions == ("left", "right", "neck", "eyes")
    flat.write_text(json.dumps({"#ff0000": "eyes", "#00ff00": "eyes", "#0000ff": "mouth"}))
    assert read_legend(flat).regions == ("eyes", "mouth")  # two colours may mean one region


# --- listing and pictures ----------------------------------------------------------------------------------------


def test_listing(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = done(capsys, "regions", tiny, "--json", "--picture", tmp_path / "p.png")
    result, head = json.loads(out), tiny_face().meshes[0]
    assert set(result["regions"]) == {"mouth", "neck"}
    assert result["meshes"]["Teeth"] == {}
    assert result["meshes"]["Head"]["mouth"]["share"] == pytest.approx(np.mean(head.regions["mouth"]))
    assert result["regions"]["mouth"]["most"] == np.count_nonzero(head.regions["mouth"] > head.regions["neck"])
    assert (tmp_path / "p.png").read_bytes()[:4] == b"\x89PNG"
    assert [line.split()[0] for line in run(capsys, "regions", tiny)[1].splitlines()] == ["region", "mouth", "neck"]
    for words in (["-o", tmp_path / "o.usda"], ["--legend", "l.json"], ["--map", tmp_path / "m.png"]):
        failed(capsys, "regions", tiny, *words, folder=tmp_path)


def test_the_picture_shows_each_region_in_its_colour_where_it_is() -> None:
    """A wall in three bands: the pixels of each band are nearest to its colour, those between are the mix."""
    bands = np.repeat([0, 1, 2], 12)
    rows = np.arange(36) // 6
    mesh = grid_mesh()
    masks = {name: (bands == number).astype(np.float32) for number, name in enumerate(("low", "middle", "top"))}
    assert (bands == rows // 2).all()
    options = PictureOptions(size=120, background=(0.0, 0.0, 0.0), samples=2, regions=RegionColors(masks=masks))
    pixels = np.asarray(picture(FaceParts(meshes=(replace_mesh(mesh, regions=masks),)), None, options)).astype(float)
    column = pixels[:, 60][pixels[:, 60].sum(axis=1) > 0][::-1]  # from the bottom up
    expected = region_colors(3)
    for number, share in enumerate((0.1, 0.5, 0.9)):
        seen = column[int(share * len(column))]
        cosine = expected @ seen / np.linalg.norm(expected, axis=1) / np.linalg.norm(seen)
        assert cosine.argmax() == number
        assert cosine[number] > 0.995


def test_the_legend_shows_every_colour_and_none(tmp_path: Path) -> None:
    masks = {f"region_{number}": np.eye(36)[number] for number in range(9)}
    parts = FaceParts(meshes=(grid_mesh(),))
    image = np.asarray(picture(parts, None, PictureOptions(size=400, samples=1, regions=RegionColors(masks=masks))))
    colors = [*region_colors(9), np.array(NO_VALUE)]  # most points lie in none
    for color in colors:
        swatch = (image == (color * 255 + 0.5).astype(np.uint8)).all(axis=2)
        assert swatch.sum() > 30
    many = {f"a_long_name_of_region_{number}": np.eye(36)[number % 36] for number in range(80)}
    picture(parts, None, PictureOptions(size=200, samples=1, regions=RegionColors(masks=many)))  # as many as fit


def test_colours_are_distinct_and_keep_their_places() -> None:
    colors = region_colors(36)
    assert np.array_equal(colors[:5], region_colors(5))
    apart = np.linalg.norm(colors[:, None] - colors[None], axis=2) + 9 * np.eye(36)
    assert apart.min() > 0.04
    assert apart[:12, :12].min() > 0.25
    assert ((colors >= 0) & (colors <= 1)).all()


def test_pictures_that_make_no_sense() -> None:
    one = {"a": np.ones(36)}
    with pytest.raises(InputError, match="heat map"):
        PictureOptions(heatmap=HeatMap(values=np.ones(36)), regions=RegionColors(masks=one))
    for masks in ({}, {"a": np.full(36, -1.0)}):
        with pytest.raises(InputError, match="regions"):
            RegionColors(masks=masks)


def test_render_regions(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`render --regions` draws what `regions --picture` draws; a face without regions is refused."""
    done(capsys, "render", tiny, "--regions", "-o", tmp_path / "a.png")
    done(capsys, "regions", tiny, "--picture", tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    parts = tiny_face()
    bare = with_meshes(parts, regions={})
    save_parts(bare, tmp_path / "bare.usda")
    failed(capsys, "render", tmp_path / "bare.usda", "--regions", "-o", tmp_path / "c.png", folder=tmp_path)
