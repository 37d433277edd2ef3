"""Fits the bones of a face to targets: how much its points count, where the fit starts, and what is authored."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import suggestion
from facepipe.core.threads import one_thread
from facepipe.parts import Blendshape, FaceParts, Recipe, all_regions
from facepipe.payload import decode
from facepipe.rig import matrix_coefficients, rest_coefficients
from facepipe.stage import Face
from facepipe.stage.animation_source import play
from facepipe.stage.author_changes import author_changes
from facepipe.verbs.bone_payload import SUFFIX, check_fits, payload_bytes
from facepipe.verbs.fit_bones.limits import LimitRules
from facepipe.verbs.fit_bones.options import FitBonesOptions
from facepipe.verbs.fit_bones.report import FitBonesReport
from facepipe.verbs.fit_bones.target_fits import FittedTarget, TargetFits
from facepipe.verbs.fit_bones.targets import Target

_LARGEST_WEIGHT = 1e12
_NO_REGIONS = "none, the face has neither regions nor point subsets"


@dataclass(frozen=True, kw_only=True)
class FitBones(FitBonesOptions):
    """Coefficients, within limits, that bring a skinned face to targets; a SkelAnimation for each.

    The face's skeleton plays that of a single target: what opens the stage shows the fit. Where that target is another
    face, the fit is the person from then on.

    Source: the bone driving coefficients document, claims 1-5.

    >>> face = facepipe.open("rig.usda")
    >>> targets = read_targets(face, ["smile.usda", "jawOpen"])
    >>> with face.deriving("fitted.usda") as result:
    ...     report = FitBones(residual=True)(result, targets)

    :param limits: over those of the rig
    :param regions: region or point subset -> how much its points count, 0 or more
    :param mask: regions or point subsets outside which no point counts; empty: all do
    :param initial: (m, 9) coefficients to start from, brought into the limits; default rest
    :raises InputError: options out of range
    """

    limits: LimitRules = field(default_factory=LimitRules)
    regions: Mapping[str, float] = field(default_factory=dict)
    mask: Sequence[str] = ()
    initial: FloatArray | None = None

    @one_thread()
    def __call__(
        self,
        face: Face,
        targets: Sequence[Target],
        *,
        recipe: Recipe | None = None,
        done: Callable[[], object] = lambda: None,
    ) -> FitBonesReport:
        """Fit, and author the result on `face`.

        :param recipe: authored with the result; None leaves what the face has
        :param done: called after every frame
        :raises InputError, TopologyError: a face without bones, singular binds, or targets, limits and regions that
            don't fit it, or joints that a symmetric fit can't pair; nothing is authored then
        :raises FitError: limits that let a joint shrink to nothing, and a fit that did
        """
        start = time.perf_counter()
        weights = point_weights(face.parts(), self.regions, self.mask)
        fits = TargetFits(face, targets, self, limits=self.limits, weights=weights, initial=self.initial)
        fitted = fits.fit_all(done)
        parts = fits.parts
        meshes = tuple(
            replace(mesh, blendshapes=(*mesh.blendshapes, *_residual_shapes(fitted, number)))
            for number, mesh in enumerate(parts.meshes)
        )
        is_person = len(fitted) == 1 and targets[0].person
        result = replace(
            parts,
            meshes=meshes,
            animations=(*parts.animations, *(target.animation for target in fitted)),
            person=fitted[0].animation.name if is_person else parts.person,
            recipe=recipe or parts.recipe,
        )
        authored = author_changes(face, result)
        if len(fitted) == 1:
            play(face, fitted[0].animation.name)
        return replace(fits.report(fitted), authored=authored, seconds=time.perf_counter() - start)


def _residual_shapes(fitted: Sequence[FittedTarget], mesh: int) -> tuple[Blendshape, ...]:
    """The residual shapes of one mesh."""
    shapes = (meshes[mesh] for target in fitted for meshes in target.shapes)
    return tuple(shape for shape in shapes if shape is not None)


def point_weights(parts: FaceParts, regions: Mapping[str, float], mask: Sequence[str]) -> FloatArray:
    """(n,) how much each point counts in a fit.

    :param regions: region or point subset -> factor, 0 or more; where a mask is soft, or in none, the rest counts as 1
    :param mask: regions or point subsets outside which nothing counts; empty: all counts
    :raises InputError: unknown names, factors that are negative or not finite, or no point that counts
    """
    known = _masks(parts)
    weights = np.ones(parts.point_count)
    for name, factor in sorted(regions.items()):  # sums depend on the order, which a recipe does not keep
        where = f"region {name}"
        if not (isinstance(factor, int | float) and math.isfinite(factor) and 0 <= factor <= _LARGEST_WEIGHT):
            raise InputError(where, f"weight {factor}, expected a number from 0 to {_LARGEST_WEIGHT:g}")
        weights += _mask(known, name, where) * (factor - 1.0)
    weights = np.maximum(weights, 0.0)
    if mask:
        weights *= np.clip(sum(_mask(known, name, f"mask {name}") for name in mask), 0.0, 1.0)
    weights[weights < 1e-6 * weights.max(initial=0.0)] = 0.0  # what rounding of masks leaves of 0
    if not weights.any():
        raise InputError("weights", "all points weigh 0, expected some that count")
    return weights


def _masks(parts: FaceParts) -> dict[str, FloatArray]:
    """Region or point subset -> (n,) mask 0..1; of a name that both have the region."""
    starts = np.cumsum([0, *(len(mesh.points) for mesh in parts.meshes)])
    masks: dict[str, FloatArray] = {}
    for mesh, start in zip(parts.meshes, starts, strict=False):
        for name, indices in mesh.point_subsets.items():
            masks.setdefault(name, np.zeros(starts[-1]))[np.asarray(indices, dtype=np.int64) + start] = 1.0
    regions = all_regions(parts.meshes)
    return masks | {name: np.clip(np.asarray(mask, np.float64), 0.0, 1.0) for name, mask in regions.items()}


def _mask(known: Mapping[str, FloatArray], name: str, where: str) -> FloatArray:
    if name not in known:
        raise InputError(where, f"no such region or point subset{suggestion(name, sorted(known), _NO_REGIONS)}")
    return known[name]


def initial_coefficients(face: Face, word: str) -> FloatArray:
    """(m, 9) coefficients of the first sample of an animation (those of transforms without shear), or of a .fpb file.

    :raises InputError: no such animation, or a file that can't be read or is for another face
    """
    joints = face.skeleton.joints
    if Path(word).suffix.lower() == SUFFIX:
        content = decode(payload_bytes(Path(word)), joints, word)
        check_fits(face, content)
        return np.asarray(content.frames[0])
    animation = next((animation for animation in face.animations if animation.name == word), None)
    if animation is None:
        known = [animation.name for animation in face.animations]
        raise InputError(f"initial {word}", f"no such animation{suggestion(word, known)}")
    if animation.coefficients is None:
        local, _ = face.sample(word)
        # local = rest C: the coefficients are of C
        return matrix_coefficients(np.linalg.solve(face.rig().rest, local))
    coefficients = rest_coefficients(len(joints))
    for joint, row in zip(animation.joints, animation.coefficients[0], strict=True):
        if joint in joints:
            coefficients[joints.index(joint)] = row
    return coefficients
