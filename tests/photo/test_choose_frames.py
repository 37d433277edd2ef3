"""Frames of short videos as photos: which are kept, how they look, and what is refused."""

from __future__ import annotations

import json
import sys
import wave
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Capsys, content, done, failed, run
from photo_files import png_of
from PIL import Image
from with_torch import torch  # noqa: F401  (skips without)

import facepipe
from facepipe.core.arrays import ByteArray
from facepipe.core.errors import InputError
from facepipe.geometry.colors import to_srgb
from facepipe.photo.frames import clip as clips
from facepipe.photo.frames import search
from facepipe.photo.frames.clip import Clip, srgb_picture
from facepipe.photo.frames.search import Look, choose, relative_sharpness

av = pytest.importorskip("av")

from turning_clip import RATE, Shot, portrait, put_clip, turned, write_video  # noqa: E402

pytestmark = pytest.mark.needs_torch

COLORS = np.array([(200, 60, 50), (60, 170, 70), (50, 80, 190), (210, 170, 140)], np.uint8)
FACE = Look(number=0, time=0.0, yaw=0.0, pitch=0.0, sharpness=0.02, lids=0.1, lips=0.01, error=2.5)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Shot]]:
    path = tmp_path_factory.mktemp("clip") / "clip.mp4"
    return path, put_clip(path)


@pytest.fixture(scope="module")
def frames(clip: tuple[Path, list[Shot]]) -> Path:
    folder = clip[0].parent / "frames"
    facepipe.choose_frames(clip[0], out=folder)
    return folder


def chosen(folder: Path) -> list[dict[str, Any]]:
    report: list[dict[str, Any]] = json.loads((folder / "report.json").read_text())["chosen"]
    return report


def check_chosen(folder: Path, shots: list[Shot]) -> None:
    """Five sharp frames: from the front, far to both sides, up and down."""
    kept = chosen(folder)
    assert [one["number"] for one in kept] == sorted(one["number"] for one in kept)
    assert all(shots[one["number"]].sharp for one in kept)
    turns = {(shots[one["number"]].yaw, shots[one["number"]].pitch) for one in kept}
    assert turns == {(0, 0), (40, 0), (-45, 0), (0, 20), (2, -20)}


def test_frames_are_sharp_and_from_all_sides(clip: tuple[Path, list[Shot]], frames: Path) -> None:
    _, shots = clip
    check_chosen(frames, shots)
    kept = chosen(frames)
    assert {one.name for one in frames.iterdir()} == {*(one["file"] for one in kept), "report.json"}
    for one in kept:
        shot = shots[one["number"]]
        assert one["time"] == pytest.approx(one["number"] / RATE)
        assert one["file"] == f"frame_{one['number']:05d}_{one['time']:.2f}s.png"
        assert one["sharpness"] > 0.85
        np.testing.assert_allclose(np.degrees((one["yaw"], one["pitch"])), (shot.yaw, shot.pitch), atol=10)
        with Image.open(frames / one["file"]) as image:
            error = np.asarray(image, np.float64) - portrait(shot.yaw, shot.pitch)
        assert np.abs(error).mean() < 4  # the colours of the video


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_noise_changes_nothing(seed: int, tmp_path: Path) -> None:
    shots = put_clip(tmp_path / "clip.mp4", noise=6.0, seed=seed)
    facepipe.choose_frames(tmp_path / "clip.mp4", out=tmp_path / "frames")
    check_chosen(tmp_path / "frames", shots)


def test_the_command_prints_its_choice_and_replaces_its_own_folder_alone(
    clip: tuple[Path, list[Shot]], frames: Path, tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "frames"
    words = ["choose-frames", clip[0], "-o", out, "--json"]
    report = json.loads(done(capsys, *words))
    assert report["chosen"] == chosen(frames)
    assert report["path"] == str(out)
    assert (report["clip_frames"], report["looked_at"], report["with_face"]) == (16, 16, 16)
    first = {path.name: data for path, data in content(frames).items()}
    assert {path.name: data for path, data in content(out).items()} == first  # the same bytes
    assert "exists" in failed(capsys, *words, folder=tmp_path)
    (out / "notes.txt").write_text("mine")
    assert "notes.txt" in failed(capsys, *words, "--force", folder=tmp_path)
    (out / "notes.txt").unlink()
    monkeypatch.setattr(search, "MOST_LOOKS", 4)
    text = done(capsys, *words[:-1], "--force", "--count", "2")
    assert len(chosen(out)) == 2
    assert all(one["file"] in text for one in chosen(out))


def test_a_head_that_does_not_turn_and_another_face_are_named(tmp_path: Path, capsys: Capsys) -> None:
    pair = np.concatenate([portrait(0, 0), portrait(20, 0)], axis=1)
    write_video(tmp_path / "pair.mp4", [pair, pair])
    code, _, err = run(capsys, "choose-frames", tmp_path / "pair.mp4", "-o", tmp_path / "frames")
    assert code == 1
    assert "turns by" in err
    assert "2 faces found, expected one, or an index" in err
    assert len(chosen(tmp_path / "frames")) == 1


def looks(*changes: dict[str, float]) -> list[Look]:
    """Some looks like those of a usual clip, and then others."""
    usual = [replace(FACE, yaw=np.radians(yaw)) for yaw in range(-40, 41, 4)]
    return usual + [replace(FACE, **change) for change in changes]


@pytest.mark.parametrize("fault", [{"sharpness": 0.012}, {"lids": 0.03}, {"lips": 0.12}, {"error": 9.0}])
def test_a_fault_counts_as_much_as_some_degrees(fault: dict[str, float]) -> None:
    """A little farther to the side, a blurred or blinking face is left out; a face from another side is not."""
    side, far = np.radians(46.0), np.radians(75.0)
    assert 21 in choose(looks({"yaw": side}), 3)
    assert 21 not in choose(looks({"yaw": side, **fault}), 3)
    assert 21 in choose(looks({"yaw": far, "pitch": far / 2, **fault}), 3)


def test_looks_are_compared_with_those_from_their_side() -> None:
    """A cheek has less detail than eyes: both are as sharp as can be."""
    front = [replace(FACE, yaw=0.01 * i) for i in range(12)]
    side = [replace(FACE, yaw=1.0 + 0.01 * i, sharpness=0.01) for i in range(12)]
    np.testing.assert_allclose(relative_sharpness(front + side), 1)
    blurred = replace(side[0], sharpness=0.005)
    assert relative_sharpness([*front, *side, blurred])[-1] == pytest.approx(0.5)


def test_no_look_is_kept_twice() -> None:
    assert choose([FACE] * 6, 5) == [0]
    assert choose([replace(FACE, yaw=0.01 * i) for i in range(6)], 5) == [0]
    assert len(choose(looks(), 5)) == 5


def patches(height: int, width: int) -> ByteArray:
    """A colour in each quarter, the person's right first."""
    pixels = np.empty((height, width, 3), np.uint8)
    for i, color in enumerate(COLORS):
        pixels[(i // 2) * height // 2 :, (i % 2) * width // 2 :][: height // 2, : width // 2] = color
    return pixels


def quarters_of(pixels: ByteArray) -> np.ndarray[Any, Any]:
    """(4, 3) the colours in the middle of the quarters."""
    height, width = pixels.shape[:2]
    rows, columns = (height // 4, 3 * height // 4), (width // 4, 3 * width // 4)
    return np.array(
        [pixels[row - 4 : row + 4, column - 4 : column + 4].mean((0, 1)) for row in rows for column in columns]
    )


@pytest.mark.parametrize("quarters", range(4))
def test_phones_held_upright(quarters: int, tmp_path: Path) -> None:
    """The file says how far it is to be turned."""
    write_video(tmp_path / "clip.mp4", [patches(96, 160)] * 2)
    (tmp_path / "clip.mp4").write_bytes(turned((tmp_path / "clip.mp4").read_bytes(), quarters))
    first, _ = Clip.of(tmp_path / "clip.mp4").frames()
    expected = np.rot90(patches(96, 160), -quarters)
    assert first.size == expected.shape[1::-1]
    assert first.picture().shape == expected.shape
    np.testing.assert_allclose(quarters_of(first.picture()), quarters_of(expected), atol=4)
    assert min(first.picture(64).shape[:2]) == 64
    np.testing.assert_allclose(quarters_of(first.picture(64)), quarters_of(expected), atol=4)


@pytest.mark.parametrize(("matrix", "said", "height"), [(5, 5, 96), (1, 1, 96), (5, 2, 96), (1, 2, 736), (9, 9, 96)])
@pytest.mark.parametrize("full", [False, True])
def test_colours_are_those_that_were_filmed(matrix: int, said: int, height: int, full: bool) -> None:
    """By the matrix and range that the video names; where it names none, by its size."""
    pixels = patches(height, height)
    rgb = av.VideoFrame.from_ndarray(pixels, "rgb24")
    frame = rgb.reformat(format="yuv444p", dst_colorspace=matrix, dst_color_range=2 if full else 1)
    frame.colorspace, frame.color_range = said, 2 if full else 1
    np.testing.assert_allclose(quarters_of(srgb_picture(frame, (height, height))), COLORS, atol=3)


@pytest.mark.parametrize("curve", [16, 18])
def test_hdr_is_brought_to_srgb(curve: int) -> None:
    """Paper white is white, or nearly; what is darker keeps its colour (BT.2100 and BT.2408)."""
    light = np.array([(1, 1, 1), (0.5, 0.4, 0.3), (0.1, 0.2, 0.05), (4, 4, 4)])
    wide = light @ np.linalg.inv([(1.6605, -0.5876, -0.0728), (-0.1246, 1.1329, -0.0083), (-0.0182, -0.1006, 1.1187)]).T
    signal = (perceptual if curve == 16 else hybrid_log)(wide)
    pixels = np.repeat(np.repeat(signal.reshape(2, 2, 3), 32, 0), 32, 1)
    rgb = av.VideoFrame.from_ndarray((pixels * 65535 + 0.5).astype(np.uint16), "rgb48le")
    frame = rgb.reformat(format="yuv444p10le", dst_colorspace=9, dst_color_range=1)
    frame.colorspace, frame.color_range, frame.color_trc, frame.color_primaries = 9, 1, curve, 9
    found = quarters_of(srgb_picture(frame, (64, 64)))
    np.testing.assert_allclose(found[1:3], 255 * to_srgb(light[1:3]), atol=4)
    assert (found[0] > 235).all()
    assert (found[3] > found[0]).all()


def perceptual(light: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The signal of light over paper white, 203 cd/m2 (BT.2100, table 4)."""
    power = (light * 203 / 10000) ** 0.1593017578125
    return np.asarray(((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375)


def hybrid_log(light: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The same on a screen of 1000 cd/m2 (BT.2100, table 5)."""
    shown = light * 0.203
    scene = shown * (shown @ (0.2627, 0.6780, 0.0593))[:, None] ** (1 / 1.2 - 1)
    bright = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 0.1)) + 0.55991073
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), bright)


def silent(clip: Path) -> bytes:
    """A sound."""
    path = clip.with_name("sound.wav")
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(8000)
        file.writeframes(bytes(8000))
    return path.read_bytes()


def quickstart(clip: Path) -> bytes:
    """The clip with its tables before its frames."""
    path = clip.with_name("quickstart.mp4")
    with av.open(str(clip)) as old, av.open(str(path), "w", options={"movflags": "faststart"}) as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in old.demux(video=0):
            if packet.size:
                packet.stream = stream
                new.mux(packet)
    return path.read_bytes()


HOSTILE: dict[str, tuple[Callable[[Path], bytes], str]] = {
    "empty": (lambda _: b"", "expected a video"),
    "text": (lambda _: b"no video, but text\n" * 500, "expected a video"),
    "cut": (lambda clip: clip.read_bytes()[:-2000], "expected a video"),
    "cut behind its tables": (lambda clip: quickstart(clip)[:-2000], "is damaged or cut short"),
    "sound": (silent, "expected a video"),
    "playlist": (lambda clip: f"#EXTM3U\n#EXTINF:10,\n{clip}\n#EXT-X-ENDLIST\n".encode(), "expected a video"),
    "script": (lambda clip: f"ffconcat version 1.0\nfile '{clip}'\n".encode(), "expected a video"),
    "picture": (lambda _: png_of(portrait(0, 0)), "expected a video"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_no_video_is_refused(name: str, clip: tuple[Path, list[Shot]], tmp_path: Path, capsys: Capsys) -> None:
    data, expected = HOSTILE[name]
    (tmp_path / "clip.mp4").write_bytes(data(clip[0]))
    line = failed(capsys, "choose-frames", tmp_path / "clip.mp4", "-o", tmp_path / "frames", folder=tmp_path)
    assert expected in line


def test_no_frame_no_face_too_small_and_too_long(
    clip: tuple[Path, list[Shot]], tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "frames"

    def refused(path: Path) -> str:
        return failed(capsys, "choose-frames", path, "-o", out, folder=tmp_path)

    write_video(tmp_path / "grey.mp4", [np.full((96, 96, 3), 120, np.uint8)] * 2)
    assert "no face in any of 2 frames" in refused(tmp_path / "grey.mp4")
    write_video(tmp_path / "small.mp4", [np.full((32, 96, 3), 120, np.uint8)] * 2)
    assert "frames of 96 x 32 pixels, expected at least 64 a side" in refused(tmp_path / "small.mp4")
    write_video(tmp_path / "none.avi", [])
    assert "none.avi" in refused(tmp_path / "none.avi")
    write_video(tmp_path / "other.mkv", [portrait(0, 0)], codec="ffv1")
    assert "ffv1, expected one of av1, h264" in refused(tmp_path / "other.mkv")
    assert "is not a regular file" in refused(tmp_path)
    assert "option count" in failed(capsys, "choose-frames", clip[0], "-o", out, "--count", "0", folder=tmp_path)
    monkeypatch.setattr(clips, "MOST_FRAMES", 15)
    assert "more than 15 frames, expected a short clip" in refused(clip[0])
    monkeypatch.setattr(clips, "FREE_PIXELS", 0)
    monkeypatch.setattr(clips, "PER_BYTE", 0)
    assert "and 0 pixels at most" in refused(clip[0])


def test_without_pyav_one_line_says_what_to_install(
    clip: tuple[Path, list[Shot]], tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    line = failed(capsys, "choose-frames", clip[0], "-o", tmp_path / "frames", folder=tmp_path)
    assert line == "av: is not installed, expected `pip install 'facepipe[video]'`\n"


def test_a_clip_that_breaks_off_later_leaves_no_folder(
    clip: tuple[Path, list[Shot]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Found when its frames are written."""
    from facepipe.photo.frames import search

    def broken(**_: object) -> None:
        raise InputError("clip.mp4", "is damaged")

    monkeypatch.setattr(search, "ChosenFramesReport", broken)
    with pytest.raises(InputError, match="is damaged"):
        facepipe.choose_frames(clip[0], out=tmp_path / "frames", count=1)
    assert not list(tmp_path.iterdir())
