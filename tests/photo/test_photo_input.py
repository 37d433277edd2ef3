"""Photos of every kind as the same upright sRGB pixels, or one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from import_data import damaged, refused
from photo_files import encoded, linear_profile, oriented, picture, png, png16
from PIL import Image, ImageCms, features

from facepipe.core.errors import InputError
from facepipe.geometry.colors import to_srgb
from facepipe.photo.fit import Photo, read_photo

Array = np.ndarray[Any, Any]


def read(folder: Path, data: bytes, **options: Any) -> Photo:
    file = folder / "photo"  # kinds are known by content
    file.write_bytes(data)
    photo = read_photo(file, **options)
    assert photo.pixels.dtype == np.float32
    assert photo.pixels.min() >= 0
    assert photo.pixels.max() <= 1
    return photo


def error(folder: Path, data: bytes) -> str:
    file = folder / "photo"
    file.write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_photo(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert "\n" not in str(caught.value)
    return caught.value.what


def apart(photo: Photo, values: Array) -> float:
    """Largest difference in steps of 8 bits."""
    assert photo.pixels.shape == values.shape
    return float(np.abs(photo.pixels * 255.0 - values).max())


@pytest.mark.parametrize("kind", ["PNG", "TIFF", "BMP", "PPM", "TGA", "JPEG2000", "WEBP"])
def test_every_format_without_losses_gives_the_same_pixels(tmp_path: Path, kind: str) -> None:
    if kind == "JPEG2000" and not features.check("jpg_2000"):
        pytest.skip("needs a Pillow with JPEG 2000")
    photo = read(tmp_path, encoded(Image.fromarray(picture()), kind, **({"lossless": True} if kind == "WEBP" else {})))
    assert apart(photo, picture()) < 1e-3
    assert (photo.size, photo.scale, photo.warnings) == ((96, 80), 1.0, ())


@pytest.mark.parametrize("kind", ["JPEG", "AVIF"])
def test_formats_with_losses_give_nearly_the_same_pixels(tmp_path: Path, kind: str) -> None:
    if kind == "AVIF" and not features.check("avif"):
        pytest.skip("needs a Pillow with AVIF")
    assert apart(read(tmp_path, encoded(Image.fromarray(picture()), kind, quality=95)), picture()) < 8


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(("kind", "most"), [("JPEG", 8), ("PNG", 1e-3), ("TIFF", 1e-3), ("WEBP", 1e-3)])
def test_exif_orientations_show_the_upright_picture(tmp_path: Path, kind: str, most: float, orientation: int) -> None:
    options = {"JPEG": {"quality": 95}, "WEBP": {"lossless": True}}.get(kind, {})
    photo = read(tmp_path, oriented(picture(), orientation, kind, **options))
    assert apart(photo, picture()) < most
    assert photo.size == (96, 80)


def test_damaged_exif_is_taken_as_upright(tmp_path: Path) -> None:
    plain = encoded(Image.fromarray(picture()), "JPEG", quality=95)
    broken = plain[:2] + b"\xff\xe1\x00\x12Exif\0\0MM\0*\xff\xff\xff\xff\0\0" + plain[2:]
    assert np.array_equal(read(tmp_path, broken).pixels, read(tmp_path, plain).pixels)


def modes() -> dict[str, tuple[Callable[[Image.Image], Image.Image], str, float]]:
    """Mode -> the picture in it, a format that holds it, and how many steps of 8 bits the mode itself loses."""

    def lab(image: Image.Image) -> Image.Image:
        profiles = ImageCms.createProfile("sRGB"), ImageCms.createProfile("LAB")
        converted = ImageCms.profileToProfile(image, *profiles, outputMode="LAB")
        assert converted is not None
        return converted

    return {
        "RGBA": (lambda image: image.convert("RGBA"), "PNG", 1e-3),
        "P": (lambda image: image.quantize(256), "PNG", 14),
        "P of GIF": (lambda image: image.quantize(256), "GIF", 14),
        "CMYK": (lambda image: image.convert("CMYK"), "JPEG", 4),
        "CMYK of TIFF": (lambda image: image.convert("CMYK"), "TIFF", 1e-3),
        "YCbCr": (lambda image: image.convert("YCbCr"), "TIFF", 3.5),
        "LAB": (lab, "TIFF", 16),
    }


@pytest.mark.parametrize("mode", modes())
def test_every_mode_shows_the_same_colours(tmp_path: Path, mode: str) -> None:
    made, kind, most = modes()[mode]
    image = made(Image.fromarray(picture()))
    # Pillow 10 can't read the plain TIFFs of YCbCr that it writes
    options = {"JPEG": {"quality": 100}, "TIFF": {"compression": "tiff_lzw"} if mode == "YCbCr" else {}}.get(kind, {})
    photo = read(tmp_path, encoded(image, kind, **options))
    assert apart(photo, picture()) < most
    assert any("CMYK without a colour profile" in warning for warning in photo.warnings) == ("CMYK" in mode)


def test_grey_has_three_equal_channels_and_a_warning(tmp_path: Path) -> None:
    grey = np.asarray(Image.fromarray(picture()).convert("L"))
    for image, kind in ((Image.fromarray(grey), "JPEG"), (Image.fromarray(grey).convert("LA"), "PNG")):
        photo = read(tmp_path, encoded(image, kind, **({"quality": 100} if kind == "JPEG" else {})))
        assert apart(photo, np.repeat(grey[..., None], 3, axis=2)) < 4
        assert np.ptp(photo.pixels, axis=2).max() == 0
        assert any("no colour" in warning for warning in photo.warnings)
    stripes = np.arange(80)[:, None] % 2 * np.ones(96, dtype=np.int64)
    bits = Image.fromarray((stripes * 255).astype(np.uint8)).convert("1")
    assert np.array_equal(read(tmp_path, encoded(bits, "PNG")).pixels[..., 1], stripes)


def test_sixteen_bits_become_the_nearest_eight(tmp_path: Path) -> None:
    ramp = np.linspace(0, 65535, 80 * 96).round().astype(np.uint16).reshape(80, 96)
    for kind in ("PNG", "TIFF"):
        photo = read(tmp_path, encoded(Image.fromarray(ramp), kind))
        assert np.abs(photo.pixels[..., 0] - ramp / 65535.0).max() <= 0.5001 / 255
    colors = picture().astype(np.uint16) * 257
    assert apart(read(tmp_path, png16(colors)), picture()) < 1e-3


def test_numbers_that_are_no_photo_are_refused(tmp_path: Path) -> None:
    floats = np.linspace(0, 7.5, 80 * 96, dtype=np.float32).reshape(80, 96)
    assert "floating point" in error(tmp_path, encoded(Image.fromarray(floats), "TIFF"))
    deep = np.full((80, 96), 1_000_000, dtype=np.int32)
    assert "more than 16 bits" in error(tmp_path, encoded(Image.fromarray(deep), "TIFF"))


def test_transparent_pixels_are_mixed_with_mid_grey(tmp_path: Path) -> None:
    alpha = np.linspace(0, 255, 96).round().astype(np.uint8)[None].repeat(80, axis=0)
    image = Image.fromarray(np.dstack([picture(), alpha]))
    share = alpha[..., None] / 255.0
    photo = read(tmp_path, encoded(image, "PNG"))
    assert apart(photo, picture() * share + 127.5 * (1 - share)) < 1e-3
    assert photo.warnings == ("has transparent pixels: mixed with mid grey",)
    opaque = read(tmp_path, encoded(Image.fromarray(picture()).convert("RGBA"), "PNG"))
    assert apart(opaque, picture()) < 1e-3
    assert not opaque.warnings


def test_colours_under_transparent_pixels_don_t_leak_when_reduced(tmp_path: Path) -> None:
    values = np.zeros((400, 400, 4), dtype=np.uint8)
    values[:, :200] = (200, 120, 60, 255)
    values[:, 200:] = (0, 255, 0, 0)
    pixels = read(tmp_path, encoded(Image.fromarray(values), "PNG"), largest=100).pixels
    assert pixels[:, :48] == pytest.approx(np.broadcast_to([200 / 255, 120 / 255, 60 / 255], (100, 48, 3)), abs=0.01)
    assert pixels[:, 52:] == pytest.approx(np.full((100, 48, 3), 0.5), abs=0.01)


def test_a_transparent_palette_colour_is_mixed_with_mid_grey(tmp_path: Path) -> None:
    image = Image.fromarray(np.repeat(np.arange(80, dtype=np.uint8)[:, None] // 40, 96, axis=1), mode="P")
    image.putpalette([250, 10, 10, 10, 10, 250])
    photo = read(tmp_path, encoded(image, "PNG", transparency=0))
    assert photo.pixels[0, 0] == pytest.approx([0.5] * 3)
    assert photo.pixels[-1, 0] * 255 == pytest.approx([10, 10, 250], abs=1e-3)


@pytest.mark.parametrize(("kind", "most"), [("PNG", 2.5), ("TIFF", 2.5), ("JPEG", 12)])
def test_embedded_profiles_lead_to_srgb(tmp_path: Path, kind: str, most: float) -> None:
    linear = np.asarray(to_srgb(picture() / 255.0)) * 255
    image = Image.fromarray(picture())
    options = {"quality": 100, "subsampling": 0} if kind == "JPEG" else {}
    plain = read(tmp_path, encoded(image, kind, icc_profile=linear_profile(), **options))
    assert apart(plain, linear) < most
    swapped = read(tmp_path, encoded(image, kind, icc_profile=linear_profile((1, 0, 2)), **options))
    assert apart(swapped, linear[..., [1, 0, 2]]) < most
    kept = encoded(image.convert("RGBA"), "PNG", icc_profile=linear_profile())
    assert apart(read(tmp_path, kept), linear) < 2.5


def test_a_profile_survives_turning_and_reducing(tmp_path: Path) -> None:
    data = oriented(picture(480, 400), 6, "PNG", icc_profile=linear_profile())
    expected = np.asarray(to_srgb(picture(480, 400)[200, 240] / 255.0))
    assert read(tmp_path, data, largest=240).pixels[100, 120] == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize(
    ("mode", "profile"),
    [
        pytest.param("RGB", b"nonsense", id="nonsense"),
        pytest.param("RGB", linear_profile()[:200], id="cut short"),
        pytest.param("L", linear_profile(), id="of another kind of picture"),
    ],
)
def test_a_profile_that_cannot_be_used_is_a_warning(tmp_path: Path, mode: str, profile: bytes) -> None:
    image = Image.fromarray(picture()).convert(mode)
    photo = read(tmp_path, encoded(image, "PNG", icc_profile=profile))
    assert apart(photo, np.asarray(image.convert("RGB"))) < 1e-3
    assert any("profile can't be used" in warning for warning in photo.warnings)


@pytest.mark.parametrize("orientation", [1, 3, 6])
@pytest.mark.parametrize("size", [(1001, 777), (777, 1001), (2047, 333)])
def test_places_scale_with_the_picture(tmp_path: Path, size: tuple[int, int], orientation: int) -> None:
    """A light dot lies where the factor says, to a tenth of a pixel, as near to the far corner as to the first."""
    y, x = np.mgrid[0 : size[1], 0 : size[0]] + 0.5
    for place in ((60.3, 70.7), (size[0] - 80.2, size[1] - 65.5)):
        dot = 255 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * 12**2))
        data = oriented(np.repeat(dot.astype(np.uint8)[..., None], 3, axis=2), orientation, "PNG", compress_level=1)
        photo = read(tmp_path, data, largest=500)
        assert max(photo.pixels.shape[:2]) == 500
        assert photo.size == size
        light = photo.pixels[..., 0].astype(np.float64)
        rows, columns = np.mgrid[0 : light.shape[0], 0 : light.shape[1]] + 0.5
        found = np.array([(light * columns).sum(), (light * rows).sum()]) / light.sum()
        assert found == pytest.approx(np.array(place) * photo.scale, abs=0.1)
    assert any(warning.startswith("reduced from") for warning in photo.warnings)


def test_a_reduced_picture_shows_no_false_patterns(tmp_path: Path) -> None:
    """Lines finer than a pixel of the result are its mean, not stripes."""
    lines = np.repeat((np.arange(900) % 2 * 255).astype(np.uint8)[:, None, None], 900, axis=1).repeat(3, axis=2)
    pixels = read(tmp_path, encoded(Image.fromarray(lines), "PNG"), largest=130).pixels
    assert np.abs(pixels[2:-2] - 0.5).max() < 0.02


def test_the_first_of_several_pictures_is_read(tmp_path: Path) -> None:
    image = Image.fromarray(picture())
    more = [Image.fromarray(255 - picture())]
    for kind in ("TIFF", "PNG"):
        photo = read(tmp_path, encoded(image, kind, save_all=True, append_images=more))
        assert apart(photo, picture()) < 1e-3
        assert photo.warnings == ("holds several pictures: the first is read",)


def test_the_same_file_gives_the_same_bytes(tmp_path: Path) -> None:
    data = oriented(picture(300, 200), 6, "JPEG", icc_profile=linear_profile())
    first, second = (read(tmp_path, data, largest=150) for _ in range(2))
    assert first.pixels.tobytes() == second.pixels.tobytes()
    assert first.warnings == second.warnings


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF", "BMP", "GIF"])
def test_pictures_cut_short_are_refused(tmp_path: Path, kind: str) -> None:
    data = encoded(Image.fromarray(picture()), kind)
    for share in (0.3, 0.6, 0.9):
        assert "expected a picture" in (what := error(tmp_path, data[: int(share * len(data))])) or "cut short" in what
    progressive = encoded(Image.fromarray(picture()), "JPEG", progressive=True)
    assert "cut short" in error(tmp_path, progressive[: len(progressive) * 2 // 3])


def test_a_phones_heic_is_read_upright(tmp_path: Path) -> None:
    """128 x 96 pixels of ramps, red to the right, green downward, turned a quarter clockwise by what the file says."""
    data = (Path(__file__).parent / "turned.heic").read_bytes()
    photo = read(tmp_path, data)
    assert photo.size == (96, 128)
    assert photo.warnings == ()
    down, across = np.mgrid[0:128, 0:96]
    expected = np.stack([2 * down, 2.6 * (95 - across), np.full(down.shape, 128)], axis=2) / 255
    assert np.abs(photo.pixels - expected).mean() < 0.02
    for share in (0.3, 0.9):
        what = error(tmp_path, data[: int(share * len(data))])
        assert "expected a picture" in what or "cut short" in what


def test_what_is_no_picture_is_refused(tmp_path: Path) -> None:
    assert error(tmp_path, b"").startswith("is empty, expected a picture (JPEG, PNG")
    assert "not a picture" in error(tmp_path, b"a letter, not a photo\n" * 20)
    assert "not a picture" in error(tmp_path, b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 80 80\n")
    assert "not a picture" in error(tmp_path, b"\0\0\0\x18ftypheic" + bytes(400))
    with pytest.raises(InputError, match="not a regular file"):
        read_photo(tmp_path)
    with pytest.raises(InputError, match=r"nowhere\.jpg: can't be read: No such file"):
        read_photo(tmp_path / "nowhere.jpg")


def test_small_and_narrow_pictures_are_refused(tmp_path: Path) -> None:
    assert read(tmp_path, encoded(Image.fromarray(picture(64, 64)), "PNG")).size == (64, 64)
    what = error(tmp_path, encoded(Image.fromarray(picture(200, 63)), "PNG"))
    assert what == "is 200 x 63 pixels, expected at least 64 a side"
    assert "2048 x 35 when reduced" in error(tmp_path, encoded(Image.fromarray(picture(4096, 70)), "PNG"))
    with pytest.raises(InputError, match="option largest"):
        read(tmp_path, encoded(Image.fromarray(picture()), "PNG"), largest=10)


@pytest.mark.parametrize("side", [12_000, 30_000, 2**31 - 1])
def test_decompression_bombs_are_refused_by_their_header(tmp_path: Path, side: int) -> None:
    what = error(tmp_path, png(side, side, 8, 2, bytes(1000)))
    assert "too large" in what or "x 12000 pixels in " in what


KINDS = {kind: encoded(Image.fromarray(picture(64, 64)), kind) for kind in ("JPEG", "PNG", "TIFF", "WEBP", "GIF")}
KINDS["profile"] = oriented(picture(64, 64), 6, "JPEG", icc_profile=linear_profile())
KINDS["tiff"] = oriented(picture(64, 64), 6, "TIFF", icc_profile=linear_profile(), compression="tiff_lzw")


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.sampled_from(sorted(KINDS)).flatmap(lambda kind: damaged(KINDS[kind])))
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path: Path, data: bytes) -> None:
    file = tmp_path / "photo"
    file.write_bytes(data)
    photos: list[Photo] = []
    error = refused(lambda: photos.append(read(tmp_path, data)), file)
    assert (error is None) == bool(photos)
    for photo in photos:
        assert 0.0 <= photo.pixels.min() <= photo.pixels.max() <= 1.0
