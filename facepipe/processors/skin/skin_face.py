"""Gives a face a skeleton and skin weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.threads import one_thread
from facepipe.geometry.heat_weights import fewest
from facepipe.parts import FaceParts, Recipe, all_regions
from facepipe.processors.skin.eyeballs import eyeballs_of
from facepipe.processors.skin.from_face import from_face
from facepipe.processors.skin.from_joints import joint_weights
from facepipe.processors.skin.joints_file import JointSet, JointSpec
from facepipe.processors.skin.loose_parts import following, hold, hold_parts, in_eyeballs, joints_in
from facepipe.processors.skin.optimise import optimised
from facepipe.processors.skin.options import SkinOptions
from facepipe.processors.skin.placement import check_near, joint_warnings, size_warnings
from facepipe.processors.skin.report import FitReport, SkinReport, steps
from facepipe.processors.skin.skeletons import skeleton_of
from facepipe.processors.skin.skinning import Skinning, arranged, check_joints, skinned
from facepipe.processors.skin.slits import LOWER, UPPER, Slit, slits_of
from facepipe.processors.skin.surface import Surface, surface_of
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes

_LEAST = 1e-6  # mm: a radius below counts as this
_BLUR = 0.15  # of a slit's width, at the border between its two sides


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


def from_joints(parts: FaceParts, surface: Surface, joints: JointSet, options: SkinOptions) -> Skinning:
    """Skeleton and weights from joint positions."""
    scale = joints.scale(parts.meters_per_unit)
    positions = np.array([joint.position for joint in joints.joints]) * scale
    millimetres = positions * parts.meters_per_unit * 1000.0
    check_near(surface, joints, millimetres)
    slits = slits_of(surface)
    eyeballs = eyeballs_of(surface)
    apart = [joint.surface is True or bool(joint.regions) for joint in joints.joints]  # of the face for sure
    turned = joints_in(eyeballs, millimetres, np.array(apart))
    held = in_eyeballs(eyeballs, millimetres)
    moves = np.array([_moves(joint, one) for joint, one in zip(joints.joints, held, strict=True)])
    if not moves.any():
        raise InputError(joints.where, "no joint moves the face itself, expected one outside eyeballs, or `surface`")
    chosen = [joint for joint, one in zip(joints.joints, moves, strict=True) if one]
    to_mm = scale * parts.meters_per_unit * 1000.0
    radii = np.array([np.inf if joint.radius is None else max(joint.radius * to_mm, _LEAST) for joint in chosen])
    masks = [_mask(parts, surface, slits, joint, joints.where) for joint in chosen]
    own = joint_weights(surface, chosen, millimetres[moves], radii, masks, slits, options.sharpness)
    weights = np.zeros((len(surface.points), len(moves)))
    weights[:, moves] = following(surface, own)
    for number, joint in turned.items():
        hold(weights, eyeballs[number].points, joint)
    paths = tuple(joint.path for joint in joints.joints)
    mouth = next((slit for slit in slits if slit.name == "mouth"), None)
    hold_parts(surface, weights, joints.parts, paths, mouth)
    rotations = np.array([joint.rotation for joint in joints.joints])
    warning = "no multipie68 landmarks: joints beside lips and lids may move the other one round the corner"
    warnings = (*joint_warnings(surface, joints, millimetres), *(() if slits else (warning,)))
    return Skinning(
        skeleton=skeleton_of(parts.skeleton, paths, positions, rotations),
        weights=weights,
        warnings=warnings,
    )


def _moves(joint: JointSpec, in_eyeball: bool) -> bool:
    return joint.surface if joint.surface is not None else bool(joint.regions) or not in_eyeball


def _mask(
    parts: FaceParts, surface: Surface, slits: tuple[Slit, ...], joint: JointSpec, where: str
) -> FloatArray | None:
    """(m,) how much of each point the regions of a joint hold."""
    if not joint.regions:
        return None
    first = np.unique(surface.group, return_index=True)[1]
    known: dict[str, FloatArray] = {
        name: np.asarray(mask, np.float64)[first] for name, mask in all_regions(parts.meshes).items()
    }
    for slit in slits:
        for side, sign in (("upper", UPPER), ("lower", LOWER)):
            known.setdefault(f"{slit.name}_{side}", slit.share(sign, _BLUR))
    for name in joint.regions:
        if name not in known:
            some = ", ".join(known) or "none, it has neither regions nor landmarks"
            raise InputError(f"{where} -> {joint.path} -> regions", f"no '{name[:60]}', expected some of {some}")
    return np.asarray(np.clip(np.sum([known[name] for name in joint.regions], axis=0), 0.0, 1.0))


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
