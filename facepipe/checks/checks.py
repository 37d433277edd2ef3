"""Every check of a stage by name, and USD's own validation framework: ours registered with it, its validators run."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pxr import Sdf, Usd

from facepipe.checks import face_checks, mesh_checks
from facepipe.checks.views import FaceView, Problem
from facepipe.core.reports import Finding
from facepipe.stage.files import quiet_diagnostics
from facepipe.stage.values import USD_ERRORS, reason, usd_errors

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
    Check("Composition", face_checks.composition),
    Check("StageUnits", face_checks.stage_units),
    Check("FacePrim", face_checks.face_prim),
    Check("DefaultPrim", face_checks.default_prim, "warning"),
    Check("SkelRoot", face_checks.skel_root),
    Check("SkeletonCount", face_checks.skeleton_count),
    Check("SkelBindingAPI", face_checks.skel_binding_api),
    Check("SkeletonBound", face_checks.skeleton_bound),
    Check("HasMesh", face_checks.has_mesh),
    Check("Plausible", face_checks.plausible, "warning"),
    Check("Textures", face_checks.textures),
    Check("MaterialVariants", face_checks.material_variants),
    Check("ReadableValues", face_checks.readable_values),
    Check("Finite", face_checks.finite),
    Check("MeshTopology", mesh_checks.topology),
    Check("PrimvarCount", mesh_checks.primvar_count),
    Check("NormalCount", mesh_checks.normal_count),
    Check("SkinElementSize", mesh_checks.element_size),
    Check("SkinInfluenceCount", mesh_checks.influence_count),
    Check("SkinJointIndices", mesh_checks.joint_indices),
    Check("SkinWeightsSum", mesh_checks.weights_sum),
    Check("SkinWeightsNegative", mesh_checks.weights_negative),
    Check("SkinMeshJoints", mesh_checks.mesh_joints),
    Check("GeomBindTransformAuthored", mesh_checks.geom_bind_authored, "warning"),
    Check("GeomBindTransformSingular", mesh_checks.geom_bind_invertible),
    Check("JointTransformCount", mesh_checks.transform_count),
    Check("JointOrder", mesh_checks.joint_order),
    Check("JointNames", mesh_checks.joint_names),
    Check("BindTransformSingular", mesh_checks.transforms_invertible),
    Check("JointTransformAffine", mesh_checks.transforms_affine),
    Check("JointScaleNegative", mesh_checks.joint_scale),
    Check("BoneLimits", mesh_checks.limits),
    Check("AnimationCount", mesh_checks.animation_count),
    Check("AnimationTransforms", mesh_checks.animation_transforms),
    Check("AnimationNames", mesh_checks.animation_names, "warning"),
    Check("AnimationRotations", mesh_checks.rotations_unit, "warning"),
    Check("BlendshapeTargetCount", mesh_checks.target_count),
    Check("BlendshapeTargetDangling", mesh_checks.target_dangling),
    Check("BlendshapeNames", mesh_checks.shape_names),
    Check("BlendshapePointIndices", mesh_checks.point_indices),
    Check("BlendshapePointTwice", mesh_checks.point_indices_twice),
    Check("BlendshapePointsUnsorted", mesh_checks.point_indices_sorted, "warning"),
    Check("BlendshapeOffsetCount", mesh_checks.offset_count),
    Check("InbetweenWeight", mesh_checks.inbetween_weight),
    Check("RegionCount", mesh_checks.region_count),
    Check("RegionRange", mesh_checks.region_range),
    Check("RegionSum", mesh_checks.region_sum),
    Check("SubsetIndices", mesh_checks.subset_indices),
    Check("LandmarkIndices", mesh_checks.landmark_indices),
    Check("LandmarkNames", mesh_checks.landmark_names),
    Check("AnchorIndex", mesh_checks.anchor_index),
    Check("SliderLists", face_checks.slider_lists),
    Check("SliderRange", face_checks.slider_range),
    Check("SliderValue", face_checks.slider_value, "warning"),
    Check("SliderTargets", face_checks.slider_targets),
    Check("SliderCurves", face_checks.slider_curves),
    Check("SliderMirrors", face_checks.slider_mirrors),
    Check("SliderNetwork", face_checks.slider_network),
    Check("NeuralRigFile", face_checks.neural_rig_file),
    Check("NeuralRigDigest", face_checks.neural_rig_digest),
    Check("NeuralRigTopology", face_checks.neural_rig_topology),
    Check("PhotoCameras", face_checks.photo_cameras),
    Check("PhotoLight", face_checks.photo_light),
    Check("PhotoKeyLight", face_checks.photo_key),
    Check("PhotoPoses", face_checks.photo_poses, "warning"),
    Check("PersonPose", face_checks.person_pose),
    Check("RecipeOptions", face_checks.recipe_options),
    Check("RecipeDigests", face_checks.recipe_digests, "warning"),
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
