"""Rebuild a face from bone coefficients: an animation on an override layer, or its points.

COEFFICIENTS is a payload (.fpb) for the joints of FACE. OUT holds a SkelAnimation below FACE: a pose, a clip where the
payload has sample times, or poses NAME_1, NAME_2 ... where it has frames without times; the (first) one is what the
skeleton plays. An .npz holds `points`, (n, 3) or (frames, n, 3) in stage units, and `times`. Exit code 1: done, but
coefficients are beyond the limits of FACE; --clamp brings them into these.

examples:
  facepipe apply-bones head.usda --info person.fpb
  facepipe apply-bones head.usda person.fpb -o person.usda
  facepipe apply-bones head.usda person.fpb -o points.npz
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.names import check_identifier, first_names, identifier
from facepipe.declare import option, source
from facepipe.kinds import Job, StageAction, action

if TYPE_CHECKING:
    from facepipe.stage import Face
    from facepipe.verbs.apply_bones import ApplyBonesReport


@action("apply-bones", "rebuild a face from bone coefficients")
@dataclass(frozen=True, kw_only=True)
class ApplyCoefficients(StageAction["ApplyBonesReport"]):
    """The action."""

    face: Path = source("face stage")
    coefficients: Path = source("bone coefficients: .fpb")
    clamp: bool = option(False, "bring coefficients into the bone limits of FACE")
    name: str | None = option(None, "name of the animation (default: the file's)")

    def check(self) -> None:
        super().check()
        if self.name is not None:
            check_identifier("--name", self.name)

    def author(self, face: Face, job: Job) -> ApplyBonesReport:
        from facepipe.payload import decode
        from facepipe.verbs.apply_bones import ApplyBones, payload_bytes

        recipe, data = job.recipe(), payload_bytes(self.coefficients)
        content = decode(data, face.skeleton.joints, self.coefficients)
        name = self.name or identifier(self.coefficients.stem)
        return ApplyBones(content=content, name=name, clamp=self.clamp)(face, recipe=recipe)

    def missed(self, report: ApplyBonesReport) -> bool:
        return bool(report.beyond_limits) and not self.clamp

    def text(self, report: ApplyBonesReport, out: Path) -> str:
        names = first_names(report.animations, 4)
        return f"{out}: {names}: {report.frames} frame(s) of {report.joints} joints"
