"""Gives a face a skeleton and skin weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.threads import one_thread
from facepipe.geometry.heat_weights import fewest
from facepipe.parts import FaceParts, Recipe
from facepipe.processors.skin.from_face import from_face
from facepipe.processors.skin.from_joints import from_joints
from facepipe.processors.skin.joints_file import JointSet
from facepipe.processors.skin.optimise import optimised
from facepipe.processors.skin.options import SkinOptions
from facepipe.processors.skin.report import FitReport, SkinReport, steps
from facepipe.processors.skin.skinning import Skinning, arranged, check_joints, skinned
from facepipe.processors.skin.surface import Surface, size_warnings, surface_of
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes


@dataclass(frozen=True, kw_only=True)
class SkinFace:
    """Skeleton and weights of a face without joints, or new weights for one that has the same joints.

    Weights fall off along the surface and never cross from lip to lip or lid to lid.

    :param joints: joint positions; or
    :param source: another face, whose skeleton and weights come over, whatever its topology; both faces need the
        landmarks multipie68
    :param optimise: refine the weights for the face's own blendshapes
    """

    joints: JointSet | None = None
    source: Face | None = None
    optimise: bool = False
    options: SkinOptions = field(default_factory=SkinOptions)

    def __post_init__(self) -> None:
        if (self.joints is None) == (self.source is None):
            raise InputError("skin", "joints and a source face, or neither, expected one of them")

    @one_thread()
    def __call__(
        self, face: Face, step: Callable[[], object] = lambda: None, *, recipe: Recipe | None = None
    ) -> SkinReport:
        """Author them.

        Joints that the face has keep their order; its animations keep what they do relative to rest.

        :param step: called after every round of `optimise`
        :param recipe: authored with the result; None leaves what the face has
        :raises InputError: other joints on the face, joints far from it, regions or meshes that it hasn't, no surface;
            a source without skeleton, or landmarks missing; nothing to optimise for
        """
        parts = face.parts()
        surface = surface_of(parts, face.where)
        check_joints(surface, parts, self._joints())
        made = arranged(self._made(parts, surface), parts.skeleton.joints)
        fit: FitReport | None = None
        if self.optimise:
            weights, fit = optimised(parts, surface, made.weights, self.options, step)
        else:
            weights = fewest(made.weights, self.options.influences)
        result = skinned(parts, surface, made.skeleton, weights)
        author_changes(face, replace(result, recipe=recipe or parts.recipe))
        report = _report(surface, made, weights)
        return replace(report, fit=fit, warnings=(*size_warnings(surface), *report.warnings))

    def _joints(self) -> tuple[str, ...]:
        if self.joints is not None:
            return tuple(joint.path for joint in self.joints.joints)
        return () if self.source is None else self.source.skeleton.joints

    def _made(self, parts: FaceParts, surface: Surface) -> Skinning:
        if self.joints is not None:
            return from_joints(parts, surface, self.joints, self.options)
        assert self.source is not None
        return from_face(parts, surface, self.source.parts(), self.source.where, self.options.smoothing)


def _report(surface: Surface, made: Skinning, weights: FloatArray) -> SkinReport:
    counts = (weights > 0).sum(axis=1)
    step, slope = steps(surface, weights)
    names = surface.mesh_names
    rigid = {}
    for number, name in enumerate(names):
        own = weights[surface.mesh == number]
        held = np.flatnonzero((own == 1.0).all(axis=0))
        if len(own) and len(held):
            rigid[name] = made.skeleton.joints[held[0]]
    return SkinReport(
        joints=len(made.skeleton.joints),
        influences=int(counts.max(initial=0)),
        meshes={name: int(counts[surface.mesh == i].max(initial=0)) for i, name in enumerate(names)},
        weightless=tuple(made.skeleton.joints[i] for i in np.flatnonzero((weights <= 0).all(axis=0))),
        rigid=rigid,
        largest_step=step,
        largest_step_per_mm=slope,
        transfer=made.transfer,
        warnings=made.warnings,
    )
