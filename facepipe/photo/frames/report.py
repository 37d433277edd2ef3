"""Which frames of a video were kept."""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees
from pathlib import Path

from facepipe.core.reports import Report, table


@dataclass(frozen=True, kw_only=True)
class ChosenFrame:
    """A frame that was kept."""

    file: str
    number: int  # from 0
    time: float  # seconds since the first frame
    sharpness: float  # 1: as sharp as the sharper frames from nearly the same side
    yaw: float  # radians, to the person's left
    pitch: float  # radians, up


@dataclass(frozen=True, kw_only=True)
class ChosenFramesReport(Report):
    """Which frames were kept, in their order."""

    chosen: tuple[ChosenFrame, ...]
    clip_frames: int
    clip_seconds: float
    looked_at: int  # moments
    with_face: int  # of these

    def as_text(self, out: Path) -> str:
        """The report for people."""
        rows = [("frame", "sharpness", "yaw", "pitch")]
        for one in self.chosen:
            rows.append((one.file, f"{one.sharpness:.2f}", f"{degrees(one.yaw):.0f}", f"{degrees(one.pitch):.0f}"))
        looked = f"a face at {self.with_face} of {self.looked_at} moments of {self.clip_seconds:.1f} s"
        unit = "yaw to the person's left, pitch up, degrees"
        return f"{out}: {len(self.chosen)} frame(s), {looked}\n{table(rows)}\n{unit}"
