"""USD's own validation framework: our checks registered with it, its validators run for us.

The Python API of `pxr.UsdValidation` that takes checks is there from OpenUSD 26.05 on; elsewhere nothing happens.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from pxr import Sdf, Usd

from facepipe.checks.checks import CHECKS, Check, Severity, problems, trail
from facepipe.checks.views import FaceView
from facepipe.core.reports import Finding
from facepipe.stage.files import quiet_diagnostics
from facepipe.stage.guard import USD_ERRORS, reason

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
    with quiet_diagnostics():
        try:
            errors = UsdValidation.ValidationContext(validators).Validate(stage)
            findings = [_finding(stage, error) for error in errors]
        except USD_ERRORS as error:
            message = f"USD's own validators could not be run: {reason(error)}"
            return [
                Finding(check="facepipe:ReadableValues", severity="error", where=trail(stage, "/"), message=message)
            ]
    return sorted(findings, key=lambda one: (one.check, one.where, one.message))


def _finding(stage: Usd.Stage, error: Any) -> Finding:
    from pxr import UsdValidation

    kinds = UsdValidation.ValidationErrorType
    severities: dict[Any, Severity] = {kinds.Error: "error", kinds.Warn: "warning"}
    return Finding(
        check=str(error.GetIdentifier()),
        severity=severities.get(error.GetType(), "info"),
        where=trail(stage, next(_paths(error), "/")),
        message=" ".join(str(error.GetMessage()).split()),
    )


def _paths(error: Any) -> Iterator[str]:
    for site in error.GetSites():
        if site.IsPrim():
            yield str(site.GetPrim().GetPath())
        elif site.IsProperty():
            yield str(site.GetProperty().GetPath())
