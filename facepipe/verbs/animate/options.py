"""Options of animate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from facepipe.declare import option


@dataclass(frozen=True, kw_only=True)
class AnimateOptions:
    """How a performance is read, cut and put on a face."""

    fps: float | None = option(
        None,
        "frames per second of CLIP; by default its own, or 60 (a timecode counts frames, not how many make a second)",
        1.0,
        1000.0,
    )
    angles: Literal["auto", "rad", "deg"] = option(
        "auto", "unit of the turns in CLIP; auto: radians unless they can't be"
    )
    start: float | None = option(None, "leave out what is before, from the first frame of CLIP", 0.0, 1e6, "s")
    end: float | None = option(None, "leave out what is after, from the first frame of CLIP", 0.0, 1e6, "s")
    resample: float | None = option(None, "frames per second of the result; those of CLIP by default", 1.0, 1000.0)
    offset: float = option(0.0, "when the result begins on the stage", -1e6, 1e6, "s")
    head: str | None = option(
        None, "joint that HeadYaw, HeadPitch and HeadRoll turn, or none; found by its name by default"
    )
    left_eye: str | None = option(None, "joint that LeftEyeYaw ... turn, or none; as --head")
    right_eye: str | None = option(None, "joint that RightEyeYaw ... turn, or none; as --head")
