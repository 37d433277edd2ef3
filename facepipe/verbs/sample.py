"""Make the built-in head: one topology, a different person for every seed.

example: facepipe sample head.usdc --seed 3
example: facepipe sample old.usda --seed 3 --age 70 --feminine 1
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from facepipe.core.reports import Report
from facepipe.declare import option
from facepipe.kinds import FileAction, Job, action


@dataclass(frozen=True, kw_only=True)
class SampleReport(Report):
    """What was made."""

    points: int
    shapes: int
    joints: int


@action("sample", "make the built-in head", remote=True)
@dataclass(frozen=True, kw_only=True)
class Sample(FileAction[SampleReport]):
    """The action."""

    output = "face stage to write: .usda .usdc .usd .usdz"
    suffixes = (".usd", ".usda", ".usdc", ".usdz")

    seed: int = option(0, "which person; 0 is the average head", 0, 10**9)
    textures: int = option(2048, "size of the skin's textures; 0: colours at points, and no hair", 0, 4096, "texels")

    age: float | None = option(None, "how old the person is; as the seed draws it by default", 18.0, 80.0, "years")
    feminine: float | None = option(None, "0 a man, 1 a woman; as the seed draws it by default", 0.0, 1.0)
    controls: Literal["measures", "bones"] = option("measures", "sliders of measures over shapes, or over bones alone")

    def write(self, job: Job) -> SampleReport:
        from facepipe.heads import make
        from facepipe.stage import save_parts

        parts = make(self.seed, textures=self.textures, controls=self.controls, age=self.age, feminine=self.feminine)
        save_parts(parts, job.out)
        return SampleReport(
            points=parts.point_count,
            shapes=len(parts.shapes),
            joints=len(parts.skeleton.joints),
        )
