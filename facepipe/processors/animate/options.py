"""Options of animate."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class AnimateOptions:
    """How a performance is read, cut and put on a face."""

    fps: float | None = field(
        default=None,
        metadata={
            "help": "frames per second of CLIP; by default what it says, or 60 (a timecode counts frames, not how many "
            "make a second)",
            "range": (1.0, 1000.0),
        },
    )
    angles: Literal["rad", "deg"] = field(
        default="rad", metadata={"help": "unit of the turns in CLIP", "choices": ("rad", "deg")}
    )
    start: float | None = field(
        default=None,
        metadata={"help": "leave out what is before, from the first frame of CLIP", "unit": "s", "range": (0.0, 1e6)},
    )
    end: float | None = field(
        default=None,
        metadata={"help": "leave out what is after, from the first frame of CLIP", "unit": "s", "range": (0.0, 1e6)},
    )
    resample: float | None = field(
        default=None,
        metadata={"help": "frames per second of the result; those of CLIP by default", "range": (1.0, 1000.0)},
    )
    offset: float = field(
        default=0.0, metadata={"help": "when the result begins on the stage", "unit": "s", "range": (-1e6, 1e6)}
    )
    head: str | None = field(
        default=None,
        metadata={"help": "joint that HeadYaw, HeadPitch and HeadRoll turn, or none; found by its name by default"},
    )
    left_eye: str | None = field(default=None, metadata={"help": "joint that LeftEyeYaw ... turn, or none; as --head"})
    right_eye: str | None = field(
        default=None, metadata={"help": "joint that RightEyeYaw ... turn, or none; as --head"}
    )
