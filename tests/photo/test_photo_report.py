"""The report page of a photo fit: marks where the landmarks are, bars and curves as long and high as the numbers."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import replace

import numpy as np
import pytest
from faces import grid_mesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from facepipe.parts import FaceParts, Mesh, Slider
from facepipe.photo import pictures
from facepipe.photo.pictures import PhotoSheet, SheetPhoto, facts, photo_page, wireframe
from facepipe.pictures.figures import COLORS, bar, loss_chart

NAN = float("nan")


def pixels(image: Image.Image) -> np.ndarray:
    return np.asarray(image.convert("RGB")).astype(int)


def near(image: np.ndarray, color: tuple[int, int, int], slack: int = 12) -> np.ndarray:
    """(h, w) where pixels have a colour."""
    return np.asarray(np.abs(image - np.array(color)).max(axis=2) <= slack)


def noise(width: int, height: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)


def face(*meshes: Mesh, sliders: tuple[Slider, ...] = ()) -> FaceParts:
    return FaceParts(name="Someone", meshes=meshes or (grid_mesh(),), sliders=sliders)


def slider(name: str, minimum: float = -1.0, default: float = 0.0, maximum: float = 1.0, group: str = "") -> Slider:
    return Slider(name=name, minimum=minimum, default=default, maximum=maximum, group=group)


def one_photo(width: int = 90, height: int = 70, name: str = "someone.png", seed: int = 0) -> SheetPhoto:
    """A photo of noise; the face is the grid of 36 points in its middle."""
    rng = np.random.default_rng(seed)
    grid = grid_mesh().points * (width / 12, -height / 12, 0) + (width / 2, height * 0.7, 50)
    landmarks = grid[::5, :2]
    return SheetPhoto(
        name=name,
        photo=noise(width, height, seed),
        render=rng.random((20, 30, 4)),
        screen=grid,
        targets=landmarks + rng.normal(0, 1, landmarks.shape),
        landmarks=landmarks,
        landmark_error=1.25,
        eye_distance=20.0,
        expressions={"smile": 0.5, "jawOpen": 0.0},
    )


def sheet(*photos: SheetPhoto, **changes: object) -> PhotoSheet:
    sliders = tuple(slider(name, group="nose") for name in ("noseWidth", "noseLength", "noseTip"))
    made = PhotoSheet(
        parts=face(sliders=sliders),
        neutral=grid_mesh().points * (0.05, 1, 1),  # a narrow plate: few pixels to shade
        photos=photos or (one_photo(),),
        sliders={"noseWidth": 0.7, "noseLength": 0.0},
        history=[{"total": 3.0 / (step + 1), "landmarks": 1.0 / (step + 1)} for step in range(12)],
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def shown(made: PhotoSheet) -> str:
    return photo_page(made).decode()


def images(made: PhotoSheet) -> list[np.ndarray]:
    """The pictures of a page, in order."""
    found = re.findall(r'src="data:image/jpeg;base64,([^"]*)"', shown(made))
    return [pixels(Image.open(io.BytesIO(base64.b64decode(each)))) for each in found]


def test_same_sheet_same_bytes() -> None:
    assert photo_page(sheet()) == photo_page(sheet())


def test_names_are_text_and_no_file_is_loaded() -> None:
    hostile = "<script>alert(1)</script>\"'&"
    one = replace(one_photo(name=hostile), expressions={hostile: 0.5})
    made = sheet(one, one, sliders={hostile: 0.7}, note=hostile)
    parts = replace(face(sliders=(slider(hostile, group=hostile),)), name=hostile)
    page = shown(replace(made, parts=parts, history=[{"total": 1.0, hostile: 0.5}] * 9))
    assert "<script" not in page
    assert page.count("&lt;script&gt;") > 10
    assert not re.search(r'(src|href)="(?!data:)', page)


@pytest.mark.parametrize("count", [1, 2, pytest.param(4, marks=pytest.mark.slow)])
def test_every_photo_is_shown(count: int) -> None:
    plain = [(10, 200, 30), (200, 20, 20), (30, 40, 220), (220, 210, 20)][:count]
    photos = [
        replace(one_photo(name=str(number)), photo=np.full((70, 90, 3), color) / 255)
        for number, color in enumerate(plain)
    ]
    drawn = images(sheet(*photos))
    assert len(drawn) == 5 * count + 3
    for color, picture in zip(plain, drawn[::5], strict=False):
        assert near(picture, color, 6)[120:520, 40:-40].mean() > 0.8


@pytest.mark.parametrize(("width", "height"), [(64, 64), (4000, 60), (48, 900), (4000, 3000)])
def test_photos_of_any_shape(width: int, height: int) -> None:
    assert len(images(sheet(one_photo(width, height)))) == 8


def test_likeness_and_what_no_photo_shows() -> None:
    page = shown(replace(sheet(replace(one_photo(), similarity=0.8125)), unseen={"ears": 0.75, "nose": 0.01}))
    assert "similarity 0.812" in page
    assert page.index("In no photo") < page.index("<td>ears</td>")
    assert "<td>nose</td>" not in page
    assert "similarity" not in shown(sheet())
    assert "In no photo" not in shown(sheet())


def test_a_face_that_is_out_of_sight() -> None:
    one = one_photo()
    away = replace(one, screen=one.screen * (1, 1, -1), targets=one.targets + 5000, landmarks=one.landmarks - 5000)
    page = shown(sheet(away, sliders={}, history=[]))
    assert "none fitted" in page
    assert "no steps were made" in page


def test_crop_keeps_pixels_where_the_scale_is_one() -> None:
    photo = noise(60, 40)
    inner = pictures.cut(photo, pictures.Crop(left=7, top=5, side=20, size=20), (60, 40))
    np.testing.assert_allclose(inner, photo[5:25, 7:27], atol=1e-5)
    whole = pictures.cut(photo, pictures.whole(60, 40, 60), (60, 40))
    np.testing.assert_allclose(whole[10:50], photo, atol=1e-5)
    assert np.isnan(whole[:10]).all()
    assert np.isnan(whole[50:]).all()


def test_crops_of_a_smaller_render_match_the_photo() -> None:
    y, x = np.mgrid[:150, :300]
    fine = np.stack([np.sin(x / 40), np.cos(y / 30)], axis=2)
    coarse = fine.reshape(75, 2, 150, 2, 2).mean(axis=(1, 3))
    crop = pictures.Crop(left=80.3, top=20.7, side=101, size=55)
    one, other = (pictures.cut(each, crop, (300, 150)) for each in (fine, coarse))
    np.testing.assert_allclose(one, other, atol=2e-3)
    row, column = 20, 31
    place = crop.left + (column + 0.5) / crop.scale - 0.5, crop.top + (row + 0.5) / crop.scale - 0.5
    np.testing.assert_allclose(one[row, column], (np.sin(place[0] / 40), np.cos(place[1] / 30)), atol=2e-3)


@settings(max_examples=60, deadline=None)
@given(
    width=st.integers(8, 4000), height=st.integers(8, 4000), x=st.floats(-50, 4050), y=st.floats(-50, 4050),
    reach=st.floats(0, 3000),
)  # fmt: skip
def test_crops_show_the_face_and_stay_in_the_photo(width: int, height: int, x: float, y: float, reach: float) -> None:
    landmarks = np.array([(x, y), (x + reach, y + reach / 2), (x, y + reach)])
    for crop in (
        pictures.close_up(landmarks, width, height, 300),
        pictures.portrait(landmarks, landmarks + 3 * reach, width, height, 300),
    ):
        places = crop.place(np.clip(landmarks, 0, (width, height)))
        assert (places >= -1e-6).all()
        assert (places <= 300 + 1e-6).all()
        for start, length in ((crop.left, width), (crop.top, height)):
            inside = start >= -1e-6 and start + crop.side <= length + 1e-6
            around = start <= 1e-6 and start + crop.side >= length - 1e-6
            assert inside or around


def test_marks_stand_at_the_landmarks() -> None:
    photo, size = np.full((100, 100, 3), 0.35), 800
    crop = pictures.Crop(left=10, top=20, side=50, size=size)
    given_points = np.array([(20.3, 30.1), (50.2, 60.4)])
    fitted_points = np.array([(20.3, 30.1), (35.2, 60.4)])
    drawn = pixels(pictures.landmark_picture(photo, crop, given_points, fitted_points))
    for color, points, spot in (
        (pictures.FITTED, fitted_points, 0.0),
        (pictures.GIVEN, given_points, 1.95),
    ):
        for x, y in crop.place(points) + np.array((spot * size / 200, 0)):
            assert near(drawn, color, 30)[int(y), int(x)], (color, x, y)
    line = crop.place((given_points[1:] + fitted_points[1:]) / 2)[0]
    assert near(drawn, pictures.ERROR, 30)[int(line[1]), int(line[0])]
    # dots are centred on their landmarks
    red = np.argwhere(near(drawn, pictures.FITTED, 60))
    found = np.stack([red[red[:, 0] < 400].mean(axis=0), red[red[:, 0] > 400].mean(axis=0)])[:, ::-1] + 0.5
    np.testing.assert_allclose(found, crop.place(fitted_points), atol=0.35)


def test_render_lies_over_the_photo_by_its_coverage() -> None:
    photo = np.full((40, 40, 3), 188 / 255)  # 0.503 linear
    cover = np.repeat(np.repeat([[0.0, 0.5, 1.0, 1.0]], 4, axis=0)[..., None], 4, axis=2)
    cover[..., :3] *= (0.2, 0.4, 0.8)
    crop = pictures.whole(40, 40, 80)
    drawn = pixels(pictures.render_picture(cover, photo, crop, on_photo=True))
    alone = pixels(pictures.render_picture(cover, photo, crop, on_photo=False))
    np.testing.assert_allclose(drawn[:, 2], 188, atol=1)
    np.testing.assert_allclose(alone[:, 2], np.tile(pictures.GROUND, (80, 1)), atol=1)
    for picture in (drawn, alone):
        np.testing.assert_allclose(picture[40, 78], (124, 170, 231), atol=1)  # sRGB of 0.2, 0.4, 0.8
    np.testing.assert_allclose(drawn[40, 30], (159, 180, 212), atol=2)  # of the linear mean


def plate(name: str, z: float, size: float, flip: bool = False) -> Mesh:
    """A square polygon around the view axis."""
    points = np.array([(-size, -size, z), (size, -size, z), (size, size, z), (-size, size, z)])
    corners = np.arange(4, dtype=np.int32)
    return Mesh(
        name=name,
        points=points,
        face_vertex_counts=np.array([4], np.int32),
        face_vertex_indices=corners[::-1] if flip else corners,
    )


def seen(*meshes: Mesh) -> np.ndarray:
    """(100, 100) wireframe of plates whose points are pixels from the middle, and depths."""
    screen = np.concatenate([mesh.points * (1, -1, 1) + (50, 50, 0) for mesh in meshes])
    return np.asarray(wireframe(face(*meshes), screen, (100, 100))).astype(int)


def test_wireframe_draws_edges_where_they_are() -> None:
    found = seen(plate("A", 10.0, 30.5))
    ys, xs = np.nonzero(found > 100)
    at_border = np.maximum(np.abs(xs + 0.5 - 50), np.abs(ys + 0.5 - 50))
    np.testing.assert_allclose(at_border, 30.5, atol=1.0)
    assert (found[50] > 200).sum() in (2, 4)  # the polygon's sides, no diagonal of its triangles


def test_wireframe_hides_what_lies_behind() -> None:
    behind, before = plate("Behind", 20.0, 20.5), plate("Before", 10.0, 30.5)
    np.testing.assert_array_equal(seen(behind, before), seen(before))
    both = seen(replace(behind, name="Front", points=behind.points * (1, 1, 0.2)), before)
    assert (both[50] > 100).sum() > (seen(before)[50] > 100).sum()


def test_wireframe_leaves_out_backs_and_what_is_behind_the_camera() -> None:
    assert not seen(plate("Back", 10.0, 30.5, flip=True)).any()
    assert not seen(plate("Away", -10.0, 30.5)).any()


def rectangles(drawn: str) -> dict[str, tuple[float, float]]:
    """Colour -> left and right of the rectangles of a bar, of 100."""
    found = re.findall(r'<rect(?: x="([\d.]+)")?(?: y="2")? width="([\d.]+)"[^>]*fill="var\(--(\w+)\)"', drawn)
    return {color: (float(left or 0), float(left or 0) + float(width)) for left, width, color in found}


@pytest.mark.parametrize(
    ("limits", "default", "value", "color", "ends"),
    [
        ((-1.0, 1.0), 0.0, 0.75, "above", (50.0, 87.5)),
        ((-1.0, 1.0), 0.0, -0.5, "under", (25.0, 50.0)),
        ((-0.5, 3.5), 1.0, 2.5, "above", (37.5, 75.0)),
        ((-1.0, 1.0), 0.0, 7.0, "above", (50.0, 100.0)),
        ((2.0, 2.0), 2.0, 2.0, "under", (0.0, 0.0)),
    ],
)
def test_bars_lead_from_the_default_to_the_value(
    limits: tuple[float, float], default: float, value: float, color: str, ends: tuple[float, float]
) -> None:
    drawn = rectangles(bar(limits, default, value))
    assert drawn[color] == pytest.approx(ends, abs=0.01)
    assert drawn["track"] == (0, 100)
    assert 0 <= drawn["muted"][0] < drawn["muted"][1] <= 100
    low, high = limits
    if high > low:
        assert np.mean(drawn["muted"]) == pytest.approx(100 * (default - low) / (high - low), abs=0.01)


@pytest.mark.parametrize("count", [40, *(pytest.param(count, marks=pytest.mark.slow) for count in (0, 1, 90))])
def test_tables_have_the_sliders_that_moved_by_group(count: int) -> None:
    sliders = tuple(slider(f"slider{number}", group=f"group {number // 7}") for number in range(count))
    values = {each.name: 0.5 if number % 3 else 0.01 for number, each in enumerate(sliders)}
    page = shown(sheet(parts=face(sliders=(*sliders, slider("other"))), sliders=values))
    moved = [each for number, each in enumerate(sliders) if number % 3]
    assert re.findall(r"<td>(slider\d+)</td>", page) == [each.name for each in moved]
    assert re.findall(r"<caption>(.*?)</caption>", page) == list(dict.fromkeys(each.group for each in moved))
    still = count - len(moved)
    assert (f"{still} within 2% of the range from their default" in page) == bool(still)
    assert "1 not fitted" in page


def test_expressions_stand_largest_first_with_a_bar_a_photo() -> None:
    photos = [replace(one_photo(), expressions=weights) for weights in ({"smile": 0.4, "open": 0.8}, {"smile": -0.6})]
    page = shown(sheet(*photos, sliders={}))
    rows = re.findall(r"<tr><td>(open|smile)</td>(.*?)</tr>", page)
    assert [name for name, _ in rows] == ["open", "smile"]
    assert [re.findall(r'class="number">([^<]*)<', places) for _, places in rows] == [["0.80"], ["0.40", "-0.60"]]


def curves(history: list[dict[str, float]]) -> dict[str, list[list[tuple[float, float]]]]:
    """Colour -> the places that each run of a curve goes through."""
    found = re.findall(r'<path d="([^"]*)" fill="none" stroke="([^"]*)"', loss_chart(history))
    return {
        color: [
            [(float(x), float(y)) for x, y in (place.split() for place in run.split("L"))]
            for run in path.split("M")[1:]
        ]
        for path, color in found
    }


def heights(history: list[dict[str, float]], count: int) -> list[float]:
    """Rows of the first curves beside the total."""
    drawn = curves(history)
    return [float(np.mean([y for _, y in drawn[color][0]])) for color in COLORS[:count]]


def test_curves_are_as_high_as_the_losses() -> None:
    one, two, three = heights([{"total": 4.0, "a": 1.0, "b": 2.0, "c": 3.0}] * 50, 3)
    assert one - two == pytest.approx(two - three, abs=0.2)
    assert one - two > 30
    one, two, three = heights([{"total": 1.0, "a": 0.1, "b": 0.01, "c": 0.001}] * 50, 3)
    assert two - one == pytest.approx(three - two, abs=0.2)
    assert two - one > 30


def test_losses_that_are_not_known_leave_gaps() -> None:
    known = {"total": 4.0, "a": 1.0, "b": 2.0}
    history = [{**known, "a": NAN if 20 <= step < 40 else 1.0} for step in range(60)]
    drawn = curves(history)
    assert [len(run) - 1 for run in drawn[COLORS[0]]] == [20, 20]
    assert [len(run) - 1 for run in drawn[COLORS[1]]] == [60]
    before, after = drawn[COLORS[0]]
    assert (after[0][0] - before[0][0]) == pytest.approx(40 / 19 * (before[-1][0] - before[0][0]), abs=1)
    infinite = [{**each, "a": float("inf") if np.isnan(each["a"]) else each["a"]} for each in history]
    assert loss_chart(history) == loss_chart(infinite)


@pytest.mark.parametrize(
    "history",
    [
        [],
        [{}],
        [{"total": 1.0}],
        [{"total": 0.0, "a": 0.0}] * 3,
        [{"total": NAN, "a": NAN}] * 3,
        [{"total": 2.0, "a": -1.0}] * 3,
        [{"total": 1e12, "a": 1e-12}, {"total": 3.0}],
        [{"total": 1e-300, "a": 5e-324}] * 2,
        [{f"a term with a very long name, number {n}": 0.1 * n for n in range(40)}] * 5,
    ],
)
def test_histories_of_any_kind(history: list[dict[str, float]]) -> None:
    drawn = loss_chart(history)
    assert drawn.endswith("</svg>")
    assert "nan" not in drawn
    assert "inf" not in drawn
    for name in {name for step in history for name in step}:
        assert f"{name}<title>" in drawn


def test_the_loss_that_is_shown_is_that_of_the_face() -> None:
    history = [{"total": NAN}, {"total": 2.0}, {"total": 1.0}, {"total": 1.5}]
    assert "loss 1.5 at step 3" in facts(sheet(history=history, kept=3))
    assert "loss 1 at step 2" in facts(sheet(history=history, kept=2))
    assert not [fact for fact in facts(sheet(history=history)) if "loss" in fact]
    assert not [fact for fact in facts(sheet(history=[])) if "loss" in fact]
