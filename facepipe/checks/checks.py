"""Every check of a stage by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pxr import Sdf, Usd

from facepipe.checks import control_checks as control
from facepipe.checks import layout_checks as layout
from facepipe.checks import point_checks as points
from facepipe.checks import skeleton_checks as skeleton
from facepipe.checks.views import FaceView, Problem
from facepipe.core.reports import Finding
from facepipe.stage.files import quiet_diagnostics
from facepipe.stage.guard import USD_ERRORS, reason, usd_errors

Severity = Literal["error", "warning", "info"]
KEYWORD = "facepipe"

# Left out: usdGeomValidators:StageMetadataChecker (our StageUnits), usdValidation:CompositionErrorTest (our
# Composition), usdSkelValidators:SkelBindingApiAppliedValidator (our SkelBindingAPI): the same findings once more.
BUILT_IN = (
    "usdValidation:AttributeTypeMismatch",
    "usdValidation:StageMetadataChecker",
    "usdGeomValidators:EncapsulationChecker",
    "usdGeomValidators:SubsetFamilies",
    "usdGeomValidators:SubsetParentIsImageable",
    "usdSkelValidators:SkelBindingApiValidator",
    "usdShadeValidators:EncapsulationRulesValidator",
    "usdShadeValidators:EncapsulationMaterialValidator",
    "usdShadeValidators:MaterialBindingApiAppliedValidator",
    "usdShadeValidators:MaterialBindingCollectionValidator",
    "usdShadeValidators:MaterialBindingRelationships",
    "usdShadeValidators:NormalMapTextureValidator",
    "usdShadeValidators:ShaderSdrCompliance",
    "usdShadeValidators:SubsetMaterialBindFamilyName",
    "usdShadeValidators:SubsetsMaterialBindFamily",
    "usdUtilsValidators:MissingReferenceValidator",
    "usdUtilsValidators:FileExtensionValidator",
    "usdUtilsValidators:PackageEncapsulationValidator",
    "usdUtilsValidators:RootPackageValidator",
    "usdUtilsValidators:UsdzPackageValidator",
)


@dataclass(frozen=True)
class Check:
    """A named check: what must hold stands in the docstring of its function."""

    name: str
    function: Callable[[FaceView], Iterable[Problem]]
    severity: Severity = "error"

    @property
    def full_name(self) -> str:
        """Its name in findings and in USD's registry."""
        return f"facepipe:{self.name}"

    @property
    def doc(self) -> str:
        """What must hold."""
        return " ".join((self.function.__doc__ or "").split())


CHECKS: tuple[Check, ...] = (
    Check("Composition", layout.composition),
    Check("StageUnits", layout.stage_units),
    Check("FacePrim", layout.face_prim),
    Check("DefaultPrim", layout.default_prim, "warning"),
    Check("SkelRoot", layout.skel_root),
    Check("SkeletonCount", layout.skeleton_count),
    Check("SkelBindingAPI", layout.skel_binding_api),
    Check("SkeletonBound", layout.skeleton_bound),
    Check("HasMesh", layout.has_mesh),
    Check("Plausible", layout.plausible, "warning"),
    Check("Textures", layout.textures),
    Check("ReadableValues", layout.readable_values),
    Check("Finite", layout.finite),
    Check("MeshTopology", points.topology),
    Check("PrimvarCount", points.primvar_count),
    Check("NormalCount", points.normal_count),
    Check("SkinElementSize", skeleton.element_size),
    Check("SkinInfluenceCount", skeleton.influence_count),
    Check("SkinJointIndices", skeleton.joint_indices),
    Check("SkinWeightsSum", skeleton.weights_sum),
    Check("SkinWeightsNegative", skeleton.weights_negative),
    Check("SkinMeshJoints", skeleton.mesh_joints),
    Check("GeomBindTransformAuthored", skeleton.geom_bind_authored, "warning"),
    Check("GeomBindTransformSingular", skeleton.geom_bind_invertible),
    Check("JointTransformCount", skeleton.transform_count),
    Check("JointOrder", skeleton.joint_order),
    Check("JointNames", skeleton.joint_names),
    Check("BindTransformSingular", skeleton.transforms_invertible),
    Check("JointTransformAffine", skeleton.transforms_affine),
    Check("JointScaleNegative", skeleton.joint_scale),
    Check("BoneLimits", skeleton.limits),
    Check("AnimationCount", skeleton.animation_count),
    Check("AnimationTransforms", skeleton.animation_transforms),
    Check("AnimationNames", skeleton.animation_names, "warning"),
    Check("AnimationRotations", skeleton.rotations_unit, "warning"),
    Check("BlendshapeTargetCount", skeleton.target_count),
    Check("BlendshapeTargetDangling", skeleton.target_dangling),
    Check("BlendshapeNames", skeleton.shape_names),
    Check("BlendshapePointIndices", skeleton.point_indices),
    Check("BlendshapePointTwice", skeleton.point_indices_twice),
    Check("BlendshapePointsUnsorted", skeleton.point_indices_sorted, "warning"),
    Check("BlendshapeOffsetCount", skeleton.offset_count),
    Check("InbetweenWeight", skeleton.inbetween_weight),
    Check("RegionCount", points.region_count),
    Check("RegionRange", points.region_range),
    Check("RegionSum", points.region_sum),
    Check("SubsetIndices", points.subset_indices),
    Check("LandmarkIndices", points.landmark_indices),
    Check("LandmarkNames", points.landmark_names),
    Check("AnchorIndex", points.anchor_index),
    Check("SliderLists", control.slider_lists),
    Check("SliderRange", control.slider_range),
    Check("SliderValue", control.slider_value, "warning"),
    Check("SliderTargets", control.slider_targets),
    Check("SliderCurves", control.slider_curves),
    Check("SliderMirrors", control.slider_mirrors),
    Check("SliderNetwork", control.slider_network),
    Check("NeuralRigFile", control.neural_rig_file),
    Check("NeuralRigDigest", control.neural_rig_digest),
    Check("NeuralRigTopology", control.neural_rig_topology),
    Check("PhotoCameras", layout.photo_cameras),
    Check("PhotoLight", layout.photo_light),
    Check("PhotoKeyLight", layout.photo_key),
    Check("PhotoPoses", layout.photo_poses, "warning"),
    Check("PersonPose", control.person_pose),
    Check("RecipeOptions", control.recipe_options),
    Check("RecipeDigests", control.recipe_digests, "warning"),
)


def check_stage(stage: Usd.Stage) -> list[Finding]:
    """The findings of our checks on a stage, in the order of `CHECKS`."""
    with usd_errors(stage.GetRootLayer().realPath), np.errstate(all="ignore"):  # NaN is what some checks look for
        face = FaceView(stage)
        return [
            Finding(
                check=one.full_name, severity=one.severity, where=trail(stage, path), message=" ".join(text.split())
            )
            for one in CHECKS
            for path, text in problems(one, face)
        ]


def problems(check: Check, face: FaceView) -> list[Problem]:
    """The problems that a check finds; one where it could not be run."""
    problems: list[Problem] = []
    try:
        problems.extend(check.function(face))
    except USD_ERRORS as error:
        problems.append(Problem("/", f"could not be checked: {reason(error)}"))
    return problems


def trail(stage: Usd.Stage, path: str) -> str:
    """File and path for a finding."""
    file = stage.GetRootLayer().realPath
    return f"{Path(file).name} -> <{path}>" if file else f"<{path}>"


def available() -> bool:
    """Whether this USD takes checks written in Python."""
    try:
        from pxr import UsdValidation
    except ImportError:
        return False
    return hasattr(UsdValidation, "ValidatorMetadata") and hasattr(
        UsdValidation.ValidationRegistry, "RegisterStageValidator"
    )


def register() -> bool:
    """Register every check as a validator ``facepipe:<name>``; again does nothing. False where USD can't take them."""
    if not available():
        return False
    from pxr import UsdValidation

    registry = UsdValidation.ValidationRegistry()
    for check in CHECKS:
        if not registry.HasValidator(check.full_name):
            metadata = UsdValidation.ValidatorMetadata(name=check.full_name, keywords=[KEYWORD], doc=check.doc)
            registry.RegisterStageValidator(metadata, _task(check))
    return True


def _task(check: Check) -> Callable[..., list[Any]]:
    from pxr import UsdValidation

    kinds = UsdValidation.ValidationErrorType
    kind = {"error": kinds.Error, "warning": kinds.Warn, "info": kinds.Info}[check.severity]

    def task(stage: Usd.Stage, *_time_range: Any) -> list[Any]:
        return [
            UsdValidation.ValidationError(
                check.name, kind, [UsdValidation.ValidationErrorSite(stage, Sdf.Path(path))], message
            )
            for path, message in problems(check, FaceView(stage))
        ]

    return task


def check_built_in(stage: Usd.Stage) -> list[Finding]:
    """What USD's own validators find on a stage; nothing where they can't be run from Python."""
    if not available():
        return []
    from pxr import UsdValidation

    registry = UsdValidation.ValidationRegistry()
    validators = [registry.GetOrLoadValidatorByName(name) for name in BUILT_IN if registry.HasValidator(name)]
    if not validators:
        return []
    kinds, findings = UsdValidation.ValidationErrorType, []
    severities: dict[Any, Severity] = {kinds.Error: "error", kinds.Warn: "warning"}
    with quiet_diagnostics():
        try:
            for error in UsdValidation.ValidationContext(validators).Validate(stage):
                sites = [one for one in error.GetSites() if one.IsPrim() or one.IsProperty()]
                first = (sites[0].GetPrim() if sites[0].IsPrim() else sites[0].GetProperty()) if sites else None
                where = trail(stage, "/" if first is None else str(first.GetPath()))
                name, message = str(error.GetIdentifier()), " ".join(str(error.GetMessage()).split())
                severity = severities.get(error.GetType(), "info")
                findings.append(Finding(check=name, severity=severity, where=where, message=message))
        except USD_ERRORS as error:
            message, where = f"USD's own validators could not be run: {reason(error)}", trail(stage, "/")
            return [Finding(check="facepipe:ReadableValues", severity="error", where=where, message=message)]
    return sorted(findings, key=lambda one: (one.check, one.where, one.message))
