"""Give a face a skeleton and skin weights: from joint positions, another face's skeleton, or example faces.

--joints holds where joints are, in the world: {"unit": "mm", "joints": {"head": {"position": [0, 60, 20]}, "head/jaw":
{"position": [0, 0, 20], "surface": false}, "head/jaw/chin": {"position": [0, -72, 100], "regions": ["mouth_lower"]}},
"parts": {"Teeth*": {"upper": "head", "lower": "head/jaw"}}}.
A joint may have "rotation" (quaternion x y z w relative to its parent's axes), "radius" (no weight beyond, along the
surface), "regions" (of the face, or mouth_upper, mouth_lower, eye_left_upper ...) and "surface" (false: a pivot, which
moves loose parts only). "parts" gives meshes whole to joints; units are stage, mm, cm or m. Weights fall off along the
surface and never cross from lip to lip or lid to lid.

--from takes the skeleton and weights of another face, whatever its topology: a smooth warp by the landmarks multipie68,
which both need, lays it over FACE; joints move along, points take the weights of the nearest places, lips from lips;
on one topology, of the same points.
--optimise then refines the weights, so that the joints alone come nearer to the blendshapes that FACE has: RMS and max
distance of the moved points, before and after, with the best rigid motion of each joint. Joints stay where they are,
and only weights are authored. For bone coefficients of each shape, within limits and with scale, fit the result:
facepipe fit-bones OUT --target shapes -o FITTED.

--learn-from takes faces of FACE's topology, one database (.fpdb) or face stages, and learns --count joints with which
bone coefficients come nearest to them: who people are, as bones. Where joints stand, and whose points are, follows from
how the faces differ; the limits are what they needed and a quarter more. facepipe fit-bones OUT --target FACE -o FITTED
then brings the bones to a face.

A face that has the same joints keeps their order; where they stand may change, what its animations do relative to rest
does not. OUT is an override layer over FACE.

examples:
  facepipe skin head.usdc --joints joints.json -o skinned.usdc --picture weights.png
  facepipe skin ict.usdc --from makehuman.usdc -o rigged.usdc --optimise
  facepipe fit-bones rigged.usdc --target shapes -o fitted.usdc
  facepipe skin head.usdc --learn-from people.fpdb --count 60 -o people_bones.usda
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.declare import beside, option, source
from facepipe.kinds import Job, StageAction, action
from facepipe.verbs.skin.options import SkinOptions

if TYPE_CHECKING:
    from facepipe.stage import Face
    from facepipe.verbs.skin.skinning import SkinReport

# option -> the way to skin that it is of, and what that is given as
_WAYS = {
    "sharpness": ("joints", "--joints"),
    "smoothing": ("source", "--from"),
    "count": ("learn_from", "--learn-from"),
    "iterations": ("optimise", "--optimise"),
    "evenness": ("optimise", "--optimise"),
}


@action("skin", "give a face a skeleton and skin weights", remote=True)
@dataclass(frozen=True, kw_only=True)
class Skin(SkinOptions, StageAction["SkinReport"]):
    """The action."""

    face: Path = source("face stage without joints, or with the same ones")
    joints: Path | None = source("where joints are", default=None, flag="--joints", metavar="JSON")
    learn_from: tuple[Path, ...] = source(
        "faces of the same topology to learn joints and weights from: one .fpdb, or stages",
        default=(),
        flag="--learn-from",
        metavar="FACE",
        before=(),
    )
    source: Path | None = source("a skinned face, of any topology", default=None, flag="--from", metavar="OTHER_FACE")
    optimise: bool = option(False, "refine the weights for the face's own blendshapes")
    picture: Path | None = beside("draw the weights on the face, a colour a joint", ".png", "draw")

    @classmethod
    def line_values(cls, arguments: Any, values: dict[str, Any]) -> dict[str, Any]:
        for name, (way, flag) in _WAYS.items():
            if hasattr(arguments, name) and not values.get(way):
                raise InputError(f"--{name}", f"given without {flag}, expected both or neither")
        return values

    def check(self) -> None:
        super().check()
        if (self.joints is not None) + (self.source is not None) + bool(self.learn_from) != 1:
            what = "none or several of joints, a source face and faces to learn from"
            raise InputError("skin", f"{what}, expected one of them (--joints, --from, --learn-from)")
        if self.optimise and self.learn_from:
            raise InputError("--optimise", "given with --learn-from, expected only one of them")

    def author(self, face: Face, job: Job) -> SkinReport:
        from facepipe.importers import read_face
        from facepipe.verbs.skin.from_examples import read_examples
        from facepipe.verbs.skin.from_joints import read_joints
        from facepipe.verbs.skin.skin_face import SkinFace

        skin = SkinFace(
            joints=None if self.joints is None else read_joints(self.joints),
            source=None if self.source is None else read_face(self.source),
            examples=read_examples(self.learn_from) if self.learn_from else None,
            optimise=self.optimise,
            options=self,
        )
        with job.watch("optimise" if self.optimise else "learn", skin.rounds) as bar:
            return skin(face, bar.update, recipe=job.recipe())

    def draw(self, face: Face, report: SkinReport, path: Path) -> None:
        """The picture of the weights."""
        from facepipe.pictures import PictureOptions, RegionColors, picture, save_png

        weights = face.rig().influences.toarray()
        names = [joint.rpartition("/")[2] for joint in face.skeleton.joints]
        masks = {
            name if names.count(name) == 1 else path: column
            for name, path, column in zip(names, face.skeleton.joints, weights.T, strict=False)
            if column.any()
        }
        image = picture(face.parts(), face.evaluate(), PictureOptions(regions=RegionColors(masks=masks)))
        save_png(image, path)

    def text(self, report: SkinReport, out: Path) -> str:
        lines = [f"{out}: {report.joints} joints, at most {report.influences} a point"]
        lines += [f"weights change by {report.largest_step_per_mm:.3f} a mm at most"]
        if report.transfer is not None:
            away = report.transfer.surface_mm
            what = "of one topology, points lie" if report.transfer.same_topology else "points lie"
            what += f" {away['mean']:.2f} mm from {'their own' if report.transfer.same_topology else 'its surface'}"
            lines.append(f"from {report.transfer.source}: {what}, p95 {away['p95']:.2f}")
        if report.fit is not None:
            fit = report.fit
            misses = f"RMS {fit.rms_before_mm:.3f} -> {fit.rms_after_mm:.3f} mm, max {fit.max_before_mm:.1f} -> "
            lines.append(f"{fit.shapes} shapes by rigid joints alone: {misses}{fit.max_after_mm:.1f} mm")
            lines.append(f"bone coefficients of each shape: facepipe fit-bones {out} --target shapes -o FITTED")
        if report.learnt is not None:
            learnt = report.learnt
            left = f"bones leave {learnt.mean_mm:.3f} mm, p95 {learnt.p95_mm:.2f}, max {learnt.max_mm:.1f}"
            faces = f"{learnt.faces} face{'s' * (learnt.faces != 1)}"
            lines.append(f"learnt from {faces}, {learnt.apart_mm:.2f} mm from this one: {left}")
            low, high = learnt.scale
            needed = f"{learnt.translation_mm:.1f} mm, {learnt.rotation:.2f} radians, scales {low:.2f} to {high:.2f}"
            lines.append(f"limits: a quarter beyond what they need, up to {needed}")
        lines += [f"{mesh}: held by {joint}" for mesh, joint in report.rigid.items()]
        if report.weightless:
            some = ", ".join(joint.rpartition("/")[2] for joint in report.weightless[:8])
            lines.append(
                f"{len(report.weightless)} joints move no point: {some}{' ...' * (len(report.weightless) > 8)}"
            )
        return "\n".join(lines)
