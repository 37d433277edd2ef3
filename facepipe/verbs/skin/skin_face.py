"""Gives a face a skeleton and skin weights, and refines these for the face's own blendshapes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.threads import one_thread
from facepipe.geometry.heat_weights import fewest, normalised
from facepipe.geometry.skin_decomposition import decompose
from facepipe.parts import FaceParts, Recipe
from facepipe.rig import build
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes
from facepipe.verbs.skin.from_examples import LEARNING_ROUNDS, from_examples, learnt_paths
from facepipe.verbs.skin.from_face import from_face
from facepipe.verbs.skin.from_joints import JointSet, from_joints
from facepipe.verbs.skin.options import SkinOptions
from facepipe.verbs.skin.skinning import FitReport, Skinning, SkinReport, arranged, check_joints, skinned, steps
from facepipe.verbs.skin.surface import Surface, size_warnings, surface_of

_FAINT = 1e-4  # weights below are no candidates
_CANDIDATES = 8  # joints that a point may have, at least twice the influences


def _optimised(
    parts: FaceParts,
    surface: Surface,
    weights: FloatArray,
    options: SkinOptions,
    step: Callable[[], object] = lambda: None,
) -> tuple[FloatArray, FitReport]:
    """Weights (m, j), few a point, with which rigid joints come nearest to the face's blendshapes.

    A point keeps to the joints that it has some weight of, before these are cut to few, so that nothing crosses lips
    or lids that did not before. Joints stay where they are.

    :param step: called after every round
    :raises InputError: no blendshape that moves anything
    """
    rig, first = build(parts), np.unique(surface.group, return_index=True)[1]
    linear = np.asarray(parts.skeleton.transform, np.float64)[:3, :3] * parts.meters_per_unit * 1000.0
    shapes = np.empty((len(rig.shapes), len(first), 3))  # each alone at 1, in millimetres of the world
    for number, alone in enumerate(np.eye(len(rig.shapes))):
        shapes[number] = surface.points + (rig.morph(alone) - rig.points)[first] @ linear.T
    moved = np.linalg.norm(shapes - surface.points, axis=2).max(axis=0, initial=0.0) > 0
    if not moved.any():
        raise InputError(surface.where, "no blendshapes to optimise for, expected some that move points")
    width = min(max(_CANDIDATES, 2 * options.influences), weights.shape[1])
    candidates = np.argsort(-weights, axis=1, kind="stable")[:, :width]
    start = np.take_along_axis(weights, candidates, axis=1)
    # heat leaves traces of most joints nearly everywhere: these are no weight that a point has
    start = normalised(np.where(start >= _FAINT, start, 0.0))
    fitted = decompose(
        surface.points,
        shapes,
        surface.edges,
        candidates,
        start,
        most=options.influences,
        iterations=options.iterations,
        evenness=options.evenness,
        step=step,
    )
    refined = np.zeros_like(weights)
    np.put_along_axis(refined, candidates, fitted.weights, axis=1)
    before, after = fitted.before[:, moved], fitted.after[:, moved]
    return refined, FitReport(
        shapes=len(shapes),
        points=int(moved.sum()),
        rms_before_mm=float(np.sqrt((before**2).mean())),
        rms_after_mm=float(np.sqrt((after**2).mean())),
        max_before_mm=float(before.max()),
        max_after_mm=float(after.max()),
    )


@dataclass(frozen=True, kw_only=True)
class SkinFace:
    """Skeleton and weights of a face without joints, or new weights for one that has the same joints.

    Weights fall off along the surface and never cross from lip to lip or lid to lid.

    :param joints: joint positions; or
    :param source: another face, whose skeleton and weights come over, whatever its topology; both faces need the
        landmarks multipie68; or
    :param examples: name -> face of the same topology, as `read_examples` gives them: joints and weights are learnt
    :param optimise: refine the weights for the face's own blendshapes
    """

    joints: JointSet | None = None
    source: Face | None = None
    examples: Mapping[str, FaceParts] | None = None
    optimise: bool = False
    options: SkinOptions = field(default_factory=SkinOptions)

    def __post_init__(self) -> None:
        if sum(way is not None for way in (self.joints, self.source, self.examples)) != 1:
            raise InputError("skin", "none or several of joints, a source face and examples, expected one of them")
        if self.optimise and self.examples is not None:
            raise InputError("skin", "optimised joints that are learnt from examples, expected only one of them")

    @property
    def rounds(self) -> int:
        """How often `step` is called."""
        return self.options.iterations if self.optimise else LEARNING_ROUNDS if self.examples else 0

    @one_thread()
    def __call__(
        self, face: Face, step: Callable[[], object] = lambda: None, *, recipe: Recipe | None = None
    ) -> SkinReport:
        """Author them.

        Joints that the face has keep their order; its animations keep what they do relative to rest.

        :param step: called after every round of `optimise` or learning
        :param recipe: authored with the result; None leaves what the face has
        :raises InputError: other joints on the face, joints far from it, regions or meshes that it hasn't, no surface;
            a source without skeleton, or landmarks missing; nothing to optimise for or to learn
        :raises TopologyError: an example of another topology
        """
        parts = face.parts()
        surface = surface_of(parts, face.where)
        if self.joints is not None:
            check_joints(surface, parts, tuple(joint.path for joint in self.joints.joints))
            made = from_joints(parts, surface, self.joints, self.options)
        elif self.examples is not None:
            check_joints(surface, parts, learnt_paths(self.options.count))
            made = from_examples(parts, surface, self.examples, self.options, step)
        else:
            assert self.source is not None
            check_joints(surface, parts, self.source.skeleton.joints)
            made = from_face(parts, surface, self.source.parts(), self.source.where, self.options.smoothing)
        made = arranged(made, parts.skeleton.joints)
        fit: FitReport | None = None
        if self.optimise:
            weights, fit = _optimised(parts, surface, made.weights, self.options, step)
        else:
            # cut here alone: `optimise` cuts while it fits, to the joints that the shapes need
            weights = fewest(made.weights, self.options.influences)
        result = skinned(parts, surface, made.skeleton, weights)
        result = replace(result, bone_limits=made.limits or parts.bone_limits)
        author_changes(face, replace(result, recipe=recipe or parts.recipe))
        report = _report(surface, made, weights)
        return replace(report, fit=fit, warnings=(*size_warnings(surface), *report.warnings))


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
        learnt=made.learnt,
        warnings=made.warnings,
    )
