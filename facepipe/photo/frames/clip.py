"""Short videos, frame by frame: upright, in sRGB. Formats and decoders are those of cameras, and files are bounded."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import ByteArray
from facepipe.core.errors import InputError
from facepipe.core.images import FREE_PIXELS, MOST_PIXELS, PER_BYTE
from facepipe.core.reading import check_regular
from facepipe.geometry.colors import from_srgb, to_srgb

# Numbers of ITU-T H.273
_MATRICES = {1: 1, 4: 4, 5: 5, 6: 5, 7: 7, 9: 9, 10: 9}  # of a frame -> of the scaler
_BT709, _BT601, _FULL = 1, 5, 2
_HD = 720  # rows or columns from which on a video that does not say its matrix has that of BT.709
_PQ, _HLG = 16, 18
_TO_BT709 = {
    9: ((1.6605, -0.5876, -0.0728), (-0.1246, 1.1329, -0.0083), (-0.0182, -0.1006, 1.1187)),  # BT.2020
    12: ((1.2249, -0.2249, 0.0), (-0.0421, 1.0421, 0.0), (-0.0196, -0.0786, 1.0983)),  # Display P3
}
_WHITE = 203.0  # cd/m2 of a sheet of paper in HDR (BT.2408)
_PEAK = 1000.0  # cd/m2 of the screen that HLG is graded on
_BT2020_LUMA = np.array((0.2627, 0.6780, 0.0593), np.float32)
_SHOULDER = 0.8  # linear; brighter colours are pressed together below 1
MOST_FRAMES = 20_000  # 11 minutes of 30 a second
_MOST_BYTES = 1 << 33
_SMALLEST = 64  # pixels a side, as of photos
# Of FFmpeg's many: no playlist or script, which could name other files or hosts, and no decoder that few have tried.
_FORMATS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts"
_CODECS = frozenset(("h264", "hevc", "av1", "libdav1d", "vp8", "vp9", "mpeg4", "mpeg2video", "mjpeg", "prores"))
_EXPECTED = "a video of a camera or phone (MP4, MOV, WebM, MKV, AVI or MPEG-TS)"


def srgb_picture(frame: Any, size: tuple[int, int]) -> ByteArray:
    """(h, w, 3) sRGB of a frame of PyAV, not turned yet, scaled to `size` (width, height)."""
    curve, matrix = int(frame.color_trc), _TO_BT709.get(int(frame.color_primaries))
    wide = curve in (_PQ, _HLG) or matrix is not None
    unsaid = _BT709 if min(frame.width, frame.height) >= _HD else _BT601
    shrinks = size[0] * size[1] < frame.width * frame.height
    rgb = frame.reformat(
        *size,
        format="rgb48le" if wide else "rgb24",
        src_colorspace=_MATRICES.get(int(frame.colorspace), unsaid),
        dst_color_range=_FULL,
        interpolation="AREA" if shrinks else "BICUBIC",
    ).to_ndarray()
    if not wide:
        return np.ascontiguousarray(rgb)
    return np.concatenate([_narrowed(band, curve, matrix) for band in np.array_split(rgb, max(len(rgb) // 64, 1))])


def _narrowed(rgb: npt.NDArray[np.uint16], curve: int, matrix: tuple[tuple[float, ...], ...] | None) -> ByteArray:
    """HDR and wide colours as sRGB, paper white as its white."""
    signal = rgb.astype(np.float32) / np.float32(65535)
    # light on the screen over that of paper white (BT.2100)
    if curve == _PQ:
        root = signal ** (1 / 78.84375)
        light = (
            10000 / _WHITE * (np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root)) ** (1 / 0.1593017578125)
        )
    elif curve == _HLG:
        scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - 0.55991073) / 0.17883277) + 0.28466892) / 12)
        luma = np.maximum(scene @ _BT2020_LUMA, 1e-9)[..., None]
        light = _PEAK / _WHITE * scene * luma**0.2
    else:
        light = from_srgb(signal)
    light = np.asarray(light, dtype=np.float32)
    if matrix is not None:
        light = np.maximum(light @ np.array(matrix, np.float32).T, 0)
    most = np.maximum(light.max(axis=-1, keepdims=True), 1e-6)
    room = 1 - _SHOULDER
    pressed = np.where(most < _SHOULDER, most, 1 - room * np.exp((_SHOULDER - most) / room))
    pressed = pressed if curve in (_PQ, _HLG) else np.minimum(most, 1)  # others have nothing above white
    return np.asarray(to_srgb(light * (pressed / most)) * 255 + 0.5).astype(np.uint8)


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One frame of a video."""

    number: int  # from 0
    time: float  # seconds since the first frame
    decoded: Any  # PyAV's frame
    shape: float = 1.0  # width of a pixel over its height

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the upright picture."""
        width, height = round(self.decoded.width * self.shape), self.decoded.height
        return (height, width) if self._quarters % 2 else (width, height)

    @property
    def _quarters(self) -> int:
        """Turns counter-clockwise until it is upright, as the file says."""
        return round(float(self.decoded.rotation) / 90)

    def picture(self, most: int | None = None) -> ByteArray:
        """(h, w, 3) sRGB, upright, reduced to at most so many pixels of the shorter side; None: as large as it is."""
        width, height = self.size
        scale = 1.0 if most is None else min(1.0, most / min(width, height))
        size = max(round(width * scale), 1), max(round(height * scale), 1)
        pixels = srgb_picture(self.decoded, size[::-1] if self._quarters % 2 else size)
        return np.ascontiguousarray(np.rot90(pixels, self._quarters))


@dataclass(frozen=True, kw_only=True)
class Clip:
    """A video that can be read."""

    path: Path
    count: int  # about how many frames it has

    @classmethod
    def of(cls, path: Path) -> Clip:
        """The clip in a file.

        :raises InputError: PyAV is not installed, not readable, no video of those formats, no frame in it, too many, or
            frames too small or too large
        """
        with _opened(path) as (container, stream):
            context = stream.codec_context
            if context.name not in _CODECS:
                raise InputError(path, f"is encoded as {context.name}, expected one of {', '.join(sorted(_CODECS))}")
            _check_size(path, context.width, context.height)
            count = 0
            for packet in container.demux(stream):
                count += bool(packet.size)
                if packet.is_corrupt:
                    raise InputError(path, "is damaged or cut short")
                if count > MOST_FRAMES:
                    raise InputError(path, f"more than {MOST_FRAMES} frames, expected a short clip: cut it before")
        if not count:
            raise InputError(path, f"no frame in it, expected {_EXPECTED}")
        return cls(path=path, count=count)

    def frames(self) -> Iterator[Frame]:
        """All frames that are whole, in order.

        :raises InputError: damaged, or it has changed since
        """
        number, begin = -1, None
        with _opened(self.path) as (container, stream):
            stream.thread_type = "AUTO"
            ratio = stream.sample_aspect_ratio
            shape = float(ratio) if ratio and 0.25 <= ratio <= 4 else 1.0
            for decoded in container.decode(stream):
                number += 1
                if number >= MOST_FRAMES:
                    raise InputError(self.path, f"more than {MOST_FRAMES} frames, expected a short clip")
                _check_size(self.path, decoded.width, decoded.height)
                time = number / 30 if decoded.time is None else decoded.time
                begin = time if begin is None else begin
                if not decoded.is_corrupt:
                    yield Frame(number=number, time=time - begin, decoded=decoded, shape=shape)


def _check_size(path: Path, width: int, height: int) -> None:
    if min(width, height) < _SMALLEST or width * height > _most_pixels(path):  # 0 where a decoder found them too many
        fault = f"frames of {width} x {height} pixels, expected at least {_SMALLEST} a side"
        raise InputError(path, f"{fault} and {_most_pixels(path)} pixels at most")


def _most_pixels(path: Path) -> int:
    return min(FREE_PIXELS + PER_BYTE * path.stat().st_size, MOST_PIXELS)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """The container and its first stream of video; what FFmpeg can't read, within the block too, is an `InputError`."""
    try:
        import av
    except ImportError as error:
        raise InputError("av", "is not installed, expected `pip install 'facepipe[video]'`") from error
    check_regular(path, _MOST_BYTES)
    most = {"max_pixels": str(_most_pixels(path))}
    # a playlist or script could name other files or hosts
    settings = {
        "format_whitelist": _FORMATS,
        "codec_whitelist": ",".join(sorted(_CODECS)),
        "protocol_whitelist": "none",
    }
    try:
        with path.open("rb") as file, av.open(file, options={**settings, **most}) as container:
            if not container.streams.video:
                raise InputError(path, f"has no picture, expected {_EXPECTED}")
            stream = container.streams.video[0]
            stream.codec_context.options = most
            yield container, stream
    except (OSError, ValueError, av.FFmpegError) as error:
        what = getattr(error, "strerror", None) or str(error)
        raise InputError(path, f"can't be read ({what[:80]}), expected {_EXPECTED}") from None
