"""Fits the bones of a face to targets."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from facepipe.core.arrays import FloatArray
from facepipe.core.threads import one_thread
from facepipe.parts import Blendshape, Recipe
from facepipe.processors.fit_bones.limits import LimitRules
from facepipe.processors.fit_bones.options import FitBonesOptions
from facepipe.processors.fit_bones.point_weights import point_weights
from facepipe.processors.fit_bones.report import FitBonesReport
from facepipe.processors.fit_bones.target_fits import TargetFits
from facepipe.processors.fit_bones.target_results import FoundTarget
from facepipe.processors.fit_bones.targets import Target
from facepipe.stage import Face
from facepipe.stage.animation_source import play
from facepipe.stage.author_changes import author_changes


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
        found = fits.fit_all(done)
        parts = fits.parts
        meshes = tuple(
            replace(mesh, blendshapes=(*mesh.blendshapes, *_of_mesh(found, number)))
            for number, mesh in enumerate(parts.meshes)
        )
        animations = (*parts.animations, *(one.animation for one in found))
        whole = len(found) == 1 and targets[0].person
        result = replace(
            parts,
            meshes=meshes,
            animations=animations,
            person=found[0].animation.name if whole else parts.person,
            recipe=recipe or parts.recipe,
        )
        authored = author_changes(face, result)
        if len(found) == 1:
            play(face, found[0].animation.name)
        return replace(fits.report(found), authored=authored, seconds=time.perf_counter() - start)


def _of_mesh(found: Sequence[FoundTarget], number: int) -> tuple[Blendshape, ...]:
    """The residual shapes of one mesh."""
    own = [shapes[number] for one in found for shapes in one.shapes]
    return tuple(shape for shape in own if shape is not None)
