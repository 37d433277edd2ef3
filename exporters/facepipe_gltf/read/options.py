"""Options of the glTF reader."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from facepipe.declare import option


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to read, and how."""

    weld: bool = option(True, "join vertices that were split at UV and normal seams into one point")
    scene: int | None = option(None, "number of the scene to read; the file's default scene where not given")
    fps: float | None = option(
        None, "frames per second that animations are sampled at; their own keys where not given", 1.0, 1000.0
    )
    strict: bool = option(False, "refuse a file with a texture that can't be read, in place of leaving that out")
    meters_per_unit: float | None = option(None, "metres in a unit, in place of what the file declares", 1e-6, 1e3, "m")
    up_axis: Literal["Y", "Z"] | None = option(None, "axis that points up, in place of what the file declares")
