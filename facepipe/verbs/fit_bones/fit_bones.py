"""Fit the bones of a face to targets: coefficients within limits, a SkelAnimation for each target.

A target is a blendshape of the face (jawOpen, jawOpen=0.5), `shapes` (each of them), an animation of the face (all its
frames), a face stage of its topology, a stage with points over time, a SkelAnimation of a stage (clip.usda:talk), or an
OBJ, GLB or glTF of its topology (sculpt.obj:Head says which mesh a single one of another name is; OBJ is read in the
units and axes of the face). Meshes that a target lacks don't count.

Limits are those of the rig, and over them those of a file, where later joints win: {"joints": {"*": {"t": [-0.1, 0.1],
"r": [-0.5, 0.5]}, "jaw": {"rx": [0, 0.4], "tz": [null, 0]}}, "lock": ["root:*", "eye*:s"], "units": "cm"}. Channels are
tx ty tz (units: stage, mm, cm or m) rx ry rz (radians) sx sy sz (factors), or t r s; null is no limit.

OUT is an override layer over RIG and needs that file; hand on what --flatten writes. Its skeleton plays the fit of a
single target; of several none plays. What bones can't reach is reported; --residual keeps it as a sparse blendshape,
which the animation turns on. Exit code 1: done, but a target is missed by more than the threshold.

The recipe stays on the result. --edit fits again from it with what the line changes: another RIG, other targets (all of
them), limits, masks and options; a --region joins those there are (NAME=1 undoes one). Payload and picture are made
where they are asked for.

examples:
  facepipe fit-bones rig.usda --target smile.usda -o fitted.usdc --residual
  facepipe fit-bones rig.usda --target shapes --limits limits.json --region mouth=2 --region neck=0 -o fitted.usdc
  facepipe fit-bones rig.usda --target cache.usdc -o clip.usda --coefficients clip.fpb
  facepipe fit-bones --edit fitted.usdc --threshold-mm 0.5 --no-residual --force
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from facepipe.core.errors import InputError
from facepipe.declare import beside, named_numbers, option, source, values_of
from facepipe.kinds import Job, StageAction, action
from facepipe.verbs.fit_bones.options import LIMIT_RULES, FitBonesOptions, read_rules

if TYPE_CHECKING:
    from facepipe.parts import FaceParts
    from facepipe.stage import Face
    from facepipe.verbs.fit_bones.limits import LimitRules
    from facepipe.verbs.fit_bones.target_fits import FitBonesReport
else:
    LimitRules = Any

_PICTURES = 12  # of a heat map's sheet


def _split_target(word: str) -> tuple[str | None, str]:
    from facepipe.verbs.fit_bones.targets import split_file

    return split_file(word)


def _split_initial(word: str) -> tuple[str | None, str]:
    return (word, "") if Path(word).suffix.lower() == ".fpb" else (None, word)  # animations' names have no suffix


@action("fit-bones", "bring bones to targets, within limits", remote=True)
@dataclass(frozen=True, kw_only=True)
class FitBonesToTargets(FitBonesOptions, StageAction["FitBonesReport"]):
    """The action."""

    rig: Path = source("face stage with joints and skin weights")
    targets: tuple[str, ...] = source("what to reach", flag="--target", metavar="T", split=_split_target)
    initial: str | None = source(
        "start from the first frame of an animation of RIG or of a payload (default rest)",
        default=None,
        flag="--initial",
        metavar="ANIMATION|FPB",
        split=_split_initial,
    )
    limits: LimitRules | None = option(
        None, "limits over those of the rig (default none)", metavar="JSON", parse=read_rules, value=LIMIT_RULES
    )
    regions: Mapping[str, float] = option(
        dict,
        "how much points of a region or point subset count, 0 or more (default 1)",
        flag="--region",
        metavar="NAME=WEIGHT",
        parse=named_numbers,
    )
    mask: tuple[str, ...] = option(
        (), "only points of this region or point subset count (default all do)", metavar="NAME"
    )
    coefficients: Path | None = beside("write the coefficients as a payload: .fpb", ".fpb", "write_coefficients")
    precision: Literal["float16", "float32"] = option("float32", "of the payload", kept=False)
    heatmap: Path | None = beside("draw the targets that are missed most, coloured by distance", ".png", "draw")

    def check(self) -> None:
        super().check()
        seen = set()
        for word in self.targets:
            file, name = _split_target(word)
            key = (word if file is None else Path(file).resolve(), name)
            if key in seen:
                raise InputError(f"target {word}", "given twice, expected it once")
            seen.add(key)

    def author(self, face: Face, job: Job) -> FitBonesReport:
        from facepipe.importers import read_face
        from facepipe.verbs.fit_bones.limits import LimitRules
        from facepipe.verbs.fit_bones.target_fits import FitBones, initial_coefficients
        from facepipe.verbs.fit_bones.targets import read_targets

        rig = read_face(self.rig)
        targets = tuple(read_targets(rig, self.targets, lambda path: _read(path, rig)))
        if self.coefficients and len(targets) > 1 and any(target.times is not None for target in targets):
            what = "holds one clip or several poses, expected a single --target with times"
            raise InputError(self.coefficients, what)
        fit = FitBones(
            **values_of(FitBonesOptions, self),
            limits=self.limits or LimitRules(),
            regions=self.regions,
            mask=self.mask,
            initial=None if self.initial is None else initial_coefficients(rig, self.initial),
        )
        with job.watch("fit", sum(len(target.points) for target in targets)) as bar:
            report = fit(face, targets, recipe=job.recipe(), done=bar.update)
        return replace(report, fitted=targets)

    def write_coefficients(self, face: Face, report: FitBonesReport, path: Path) -> dict[str, Any]:
        """Write the coefficients on the stage as a payload: one clip, one pose, or one pose a target."""

        import numpy as np

        from facepipe.payload import PayloadContent
        from facepipe.verbs.bone_payload import write_payload

        animations = {animation.name: animation for animation in face.animations}
        poses = [animations[name] for name in report.targets]
        values = np.concatenate([pose.coefficients for pose in poses if pose.coefficients is not None])
        times = poses[0].times if len(poses) == 1 else None
        content = PayloadContent(
            joints=face.skeleton.joints,
            coefficients=values[0] if len(poses) == 1 and times is None else values,
            times=times,
            meters_per_unit=face.meters_per_unit,
            precision=self.precision,
        )
        return write_payload(path, content, face.rig()).to_dict()

    def draw(self, face: Face, report: FitBonesReport, path: Path) -> None:
        """Draw the targets that are missed most, in the pose of their worst frame, on one scale."""
        import numpy as np

        from facepipe.pictures import HeatMap, PictureOptions, contact_sheet, picture, save_png

        misses = {name: target.distances.max_mm for name, target in report.targets.items()}
        targets = dict(zip(misses, report.fitted, strict=True))
        order = sorted(misses, key=lambda name: -misses[name])
        # at least the threshold: a good fit would show its rounding in the colours of large misses
        scale = (0.0, float(max(misses[order[0]], report.threshold_mm)))
        parts, images = face.parts(), []
        for name in order[:_PICTURES]:
            points = targets[name].points
            posed = [face.evaluate(joint_transforms=face.sample(name, frame)[0]) for frame in range(len(points))]
            off = np.linalg.norm(np.stack(posed) - points, axis=2) * face.mm_per_unit
            worst = int(off.max(axis=1).argmax())
            heatmap = HeatMap(values=off[worst], label=name, range=scale)
            image = picture(parts, posed[worst], PictureOptions(heatmap=heatmap))
            images.append((f"{name}: {misses[name]:.3g} mm", image))
        save_png(images[0][1] if len(images) == 1 else contact_sheet(images, min(4, len(images))), path)


def _read(path: Path, face: Face) -> FaceParts:
    """An OBJ in the units and axes of the face, or a glTF in its own."""
    from facepipe.importers import load, obj

    if path.suffix.lower() == ".obj":
        up_axis: Literal["Y", "Z"] = "Z" if face.up_axis == "Z" else "Y"
        return load("obj", path, obj.Options(meters_per_unit=face.meters_per_unit, up_axis=up_axis)).parts
    return load("gltf", path).parts
