"""Rebuild a face from a payload: bone coefficients as an animation on an override layer, or a person as its neutral.

COEFFICIENTS is a payload (.fpb) for the joints of FACE. OUT holds a SkelAnimation below FACE: a pose, a clip where the
payload has sample times, or poses NAME_1, NAME_2 ... where it has frames without times; the (first) one is what the
skeleton plays. An .npz holds `points`, (n, 3) or (frames, n, 3) in stage units, and `times`. Exit code 1: done, but
coefficients are beyond the limits of FACE; --clamp brings them into these.

A payload of `facepipe person` has who somebody is: FACE, the built-in head, or a face of the --database or the very
template that it was made with, gets that person's neutral, and its joints, lids and cards go with it. Exit code 1:
done, but the payload has sections that this version leaves out.

examples:
  facepipe apply-bones head.usdc --info person.fpb
  facepipe apply-bones head.usdc person.fpb -o person.usdc
  facepipe apply-bones head.usdc person.fpb -o points.npz
  facepipe apply-bones head.usdc anna.fpb -o anna_again.usdc
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.core.names import check_identifier, first_names, identifier
from facepipe.core.reports import Report
from facepipe.declare import option, source
from facepipe.kinds import Job, StageAction, action

if TYPE_CHECKING:
    from facepipe.core.arrays import FloatArray
    from facepipe.parts import Recipe
    from facepipe.payload import PayloadContent
    from facepipe.payload.person import PersonContent
    from facepipe.stage import Face
    from facepipe.verbs.person_basis import Basis

MAX_POSES = 4096  # prims that one payload may make


@dataclass(frozen=True, kw_only=True)
class ApplyBonesReport(Report):
    """What was authored."""

    animations: tuple[str, ...]
    joints: int  # that move
    frames: int
    beyond_limits: tuple[str, ...] = ()  # "joint:channel" where some frame is beyond the face's limits
    authored: tuple[str, ...] = ()
    basis: str | None = None  # of a person: what its payload is relative to
    left_out: tuple[int, ...] = ()  # of a person: kinds of sections that are not known


@action("apply-bones", "rebuild a face from bone coefficients", remote=True)
@dataclass(frozen=True, kw_only=True)
class ApplyCoefficients(StageAction[ApplyBonesReport]):
    """The action."""

    face: Path = source("face stage")
    coefficients: Path = source("bone coefficients, or a person: .fpb")
    database: Path | None = source(
        "faces whose modes a person is made of: .fpdb, or their .fpbasis",
        default=None,
        flag="--database",
        metavar="FPDB",
        before=None,
    )
    clamp: bool = option(False, "bring coefficients into the bone limits of FACE")
    name: str | None = option(None, "name of the animation (default: the file's)")
    as_section: bool = option(
        False, "keep a person as the payload's bytes over FACE's own points", flag="--section", before=False
    )

    def check(self) -> None:
        super().check()
        if self.name is not None:
            check_identifier("--name", self.name)

    def author(self, face: Face, job: Job) -> ApplyBonesReport:
        from facepipe.payload import decode
        from facepipe.verbs.bone_payload import payload_bytes

        recipe = job.recipe()
        if self.is_person():
            return self._person(face, recipe)
        if self.as_section:
            raise InputError("--section", f"given with bone coefficients ({self.coefficients}), expected a person")
        data = payload_bytes(self.coefficients)
        content = decode(data, face.skeleton.joints, self.coefficients)
        name = self.name or identifier(self.coefficients.stem)
        return apply_bones(face, content, name, clamp=self.clamp, recipe=recipe)

    def is_person(self) -> bool:
        """Whether the payload is who somebody is.

        :raises InputError: it can't be read
        """
        from facepipe.payload.sections import has_sections
        from facepipe.verbs.bone_payload import payload_bytes

        return has_sections(payload_bytes(self.coefficients))

    def person(self, face: Face) -> tuple[PersonContent, Basis, FloatArray]:
        """Who the payload has, the basis that it is on, and (n, 3) points in millimetres, of the basis.

        :raises InputError: a payload that is damaged, or not for this face
        """
        from facepipe.payload.person import decode_person
        from facepipe.verbs.apply_person import basis_for
        from facepipe.verbs.bone_payload import payload_bytes

        for given, flag in ((self.clamp, "--clamp"), (self.name is not None, "--name")):
            if given:
                raise InputError(flag, f"given with a person ({self.coefficients}), expected bone coefficients")
        content = decode_person(payload_bytes(self.coefficients), self.coefficients)
        basis = basis_for(content, face.parts(), self.coefficients, str(self.face), self.database)
        return content, basis, basis.rebuilt(content, self.coefficients)

    def left_out_lines(self, content: PersonContent) -> tuple[str, ...]:
        """A line for each section that this version does not know."""
        return tuple(f"{self.coefficients}: left out: section of kind {kind}, not known" for kind in content.skipped)

    def _person(self, face: Face, recipe: Recipe) -> ApplyBonesReport:
        from facepipe.verbs.apply_person import apply_person, keep_person

        content, basis, points = self.person(face)
        warnings: tuple[str, ...] = ()
        if self.as_section:
            authored = keep_person(face, content, basis, recipe=recipe)
        else:
            authored, warnings = apply_person(face, points, basis, basis.rig_change(content), recipe=recipe)
        left_out = [*self.left_out_lines(content), *self._dress(face, content)]
        moved: ApplyBonesReport | None = None
        if content.coefficients:
            from facepipe.payload import decode

            where = f"{self.coefficients} -> coefficients"
            pose = decode(content.coefficients, face.skeleton.joints, where)
            now = type(face)(face.stage, face.prim)  # with who the person is
            moved = apply_bones(now, pose, identifier(self.coefficients.stem), recipe=recipe)
        return ApplyBonesReport(
            animations=() if moved is None else moved.animations,
            joints=0 if moved is None else moved.joints,
            frames=0 if moved is None else moved.frames,
            authored=authored,
            basis=basis.name,
            left_out=content.skipped,
            beyond_limits=() if moved is None else moved.beyond_limits,
            warnings=(*left_out, *warnings, *(() if moved is None else moved.warnings)),
        )

    def _dress(self, face: Face, content: PersonContent) -> tuple[str, ...]:
        """Author the look and pictures of a person; lines of what is left out."""
        lines: list[str] = []
        if content.look:
            from facepipe.heads.look_code import decode_look
            from facepipe.verbs.person_basis import is_head
            from facepipe.verbs.person_look import author_look

            look, missing = decode_look(content.look, f"{self.coefficients} -> look")
            lines += [
                f"{self.coefficients}: look: {name} that this head does not have, a plain one" for name in missing
            ]
            if is_head(face.parts(), str(self.face)):
                lines += author_look(face, look)
            else:
                lines.append(f"{self.coefficients}: left out: the look, which is of the built-in head")
        if content.pictures:
            from facepipe.verbs.person_look import author_pictures

            lines += author_pictures(face, content.pictures, str(self.coefficients))
        return tuple(lines)

    def missed(self, report: ApplyBonesReport) -> bool:
        return bool(report.left_out) or (bool(report.beyond_limits) and not self.clamp)

    def text(self, report: ApplyBonesReport, out: Path) -> str:
        if report.basis is not None:
            return f"{out}: a person on {report.basis}"
        names = first_names(report.animations, 4)
        return f"{out}: {names}: {report.frames} frame(s) of {report.joints} joints"


def apply_bones(
    face: Face, content: PayloadContent, name: str, *, clamp: bool = False, recipe: Recipe | None = None
) -> ApplyBonesReport:
    """Author coefficients as a SkelAnimation: a pose, or a clip of frames with times.

    Frames without times become poses ``<name>_1``, ``<name>_2`` ... Joints that never leave rest are in none of them.
    The face's skeleton plays the (first) animation: what opens the stage shows the rebuilt face. A pose is the person
    from then on, a clip is not.

    :param clamp: bring coefficients into the face's limits; else what is beyond them is a warning
    :param recipe: authored with the result; None leaves what the face has
    :raises InputError: other joints or units than the face has, a name that is taken, too many poses, limits that
        cross, or scales that SkelAnimation can't hold
    """
    import numpy as np

    from facepipe.parts import Animation
    from facepipe.rig import rest_coefficients
    from facepipe.stage.author_changes import author_changes
    from facepipe.stage.face import on_frames, play
    from facepipe.verbs.bone_payload import beyond_limits, check_fits, limit_warnings, within_limits

    check_fits(face, content)
    parts, beyond, times = face.parts(), beyond_limits(face, content), content.times
    frames = (within_limits(face, content) if clamp else content).frames
    times = None if times is None else on_frames(face, times)
    moving = np.flatnonzero((frames != rest_coefficients(1)).any(axis=(0, 2)))
    moving = moving if moving.size else np.arange(len(content.joints))
    joints, values = tuple(content.joints[joint] for joint in moving), frames[:, moving]
    if times is not None or np.ndim(content.coefficients) == 2:
        added: tuple[Animation, ...] = (Animation(name=name, times=times, joints=joints, coefficients=values),)
    elif len(values) > MAX_POSES:
        raise InputError(name, f"{len(values)} poses without times, expected at most {MAX_POSES}")
    else:
        added = tuple(
            Animation(name=f"{name}_{number}", joints=joints, coefficients=pose[None])
            for number, pose in enumerate(values, 1)
        )
    taken = sorted({animation.name for animation in parts.animations} & {one.name for one in added})
    if taken:
        raise InputError(face.where, f"has an animation '{taken[0]}' already, expected another name")
    changed = replace(
        parts,
        animations=(*parts.animations, *added),
        # a pose is the person, which exports deliver as the rest state; a clip is a layer on top of it
        person=parts.person if times is not None else added[0].name,
        recipe=recipe or parts.recipe,
    )
    authored = author_changes(face, changed)
    play(face, added[0].name)
    return ApplyBonesReport(
        animations=tuple(one.name for one in added),
        joints=len(joints),
        frames=len(content.frames),
        beyond_limits=beyond,
        authored=authored,
        warnings=limit_warnings(beyond, clamped=clamp),
    )
