"""Bone fit: 9-DOF bone coefficients, within limits, that bring a skinned face to a target."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.verbs.fit_bones.bone_fit import BoneFit
    from facepipe.verbs.fit_bones.fit_bones import FitBonesToTargets
    from facepipe.verbs.fit_bones.limits import LimitRules, read_limits
    from facepipe.verbs.fit_bones.options import FitBonesOptions
    from facepipe.verbs.fit_bones.target_fits import FitBones, FitBonesReport, TargetReport, initial_coefficients
    from facepipe.verbs.fit_bones.targets import Target, read_targets
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "BoneFit",
    "FitBones",
    "FitBonesOptions",
    "FitBonesReport",
    "FitBonesToTargets",
    "LimitRules",
    "Target",
    "TargetReport",
    "initial_coefficients",
    "read_limits",
    "read_targets",
]
