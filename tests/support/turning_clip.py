"""Short videos that are made here: a head that turns, with what is true about each frame; and patches of colour."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d
from small_head import make

from facepipe.core.arrays import ByteArray
from facepipe.pictures import PictureOptions, picture

RATE = 10  # frames a second
SIZE = 224
# (yaw to the person's left, pitch up), degrees: from the front to one side, to the other, then up and down
TURNS = ((0, 0), (20, 0), (40, 0), (20, 5), (-20, 5), (-45, 0), (0, 20), (2, -20))


@dataclass(frozen=True)
class Shot:
    """One frame."""

    yaw: float  # degrees
    pitch: float
    sharp: bool


@cache
def portrait(yaw: float, pitch: float) -> ByteArray:
    """The head, turned and with a lens that stands still."""
    view = (np.radians(-yaw), np.radians(-pitch))  # of the camera, around it
    return np.asarray(picture(make(0), None, PictureOptions(size=SIZE, view=view, samples=2)).convert("RGB"))


def shots() -> list[Shot]:
    """Of each turn a sharp frame, and one in which the head moves."""
    return [Shot(yaw, pitch, sharp) for yaw, pitch in TURNS for sharp in (False, True)]


def put_clip(path: Path, noise: float = 0.0, seed: int = 0) -> list[Shot]:
    """Write the clip of `shots`.

    :param noise: standard deviation, of 255
    """
    rng, pictures, made = np.random.default_rng(seed), [], shots()
    for shot in made:
        pixels = portrait(shot.yaw, shot.pitch).astype(np.float64)
        pixels = pixels if shot.sharp else uniform_filter1d(pixels, 7, axis=1)
        pictures.append(np.clip(pixels + noise * rng.normal(size=pixels.shape), 0, 255).astype(np.uint8))
    write_video(path, pictures)
    return made


def write_video(path: Path, pictures: Iterable[ByteArray], codec: str = "mpeg4", **context: Any) -> None:
    """Write pictures (h, w, 3) of sRGB as a video, with a good quality.

    :param context: of the encoder, like color_range
    """
    import av

    with av.open(str(path), "w", options={"fflags": "+bitexact"}) as container:
        stream = None
        for pixels in pictures:
            if stream is None:
                stream = container.add_stream(codec, rate=RATE, options={"qscale": "2"})
                stream.height, stream.width = pixels.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.codec_context.flags |= 1 << 1  # of a fixed quality
                stream.codec_context.global_quality = 2 * 118
                stream.codec_context.thread_count = 1
                for name, value in context.items():
                    setattr(stream.codec_context, name, value)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, "rgb24")))
        if stream is not None:
            container.mux(stream.encode())


def turned(mp4: bytes, quarters: int) -> bytes:
    """An MP4 that says that it is to be turned clockwise, as phones do that are held upright (ISO 14496-12, tkhd)."""
    a, b = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters]
    matrix = struct.pack(">9i", a << 16, b << 16, 0, -b << 16, a << 16, 0, 0, 0, 1 << 30)
    at = mp4.index(b"tkhd") + 4 + 4 + 20 + 16  # version 0: times, track and duration; layer, group, volume
    return mp4[:at] + matrix + mp4[at + len(matrix) :]
