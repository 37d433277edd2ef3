"""How near a fit comes to the truth about a portrait."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from recovery_landmarks import SCHEME, FaceLandmarks
from recovery_targets import RecoveryTarget, posed

from facepipe.geometry.similarity import fit_similarity
from facepipe.parts import FaceParts, Slider
from facepipe.photo.descent.subject import Subject
from facepipe.pictures.camera import Camera
from facepipe.pictures.occlusion import ambient_occlusion
from facepipe.rig import Rig, build

if TYPE_CHECKING:
    from facepipe.photo.descent.subject import FittedCamera, PhotoFit

FloatArray = npt.NDArray[np.floating]
BoolArray = npt.NDArray[np.bool_]

MOVES_MM = 1.0  # sliders that move no point of the head farther over their whole range don't count
ACTIVE_SHARE = 0.02  # of the range, from the default
BROW, NOSE_BASE, EARS = (19, 24), 33, (0, 16)  # landmarks
OPEN_SKY = 0.15  # points that see less of their sky lie inside mouth, nostrils and eye sockets


@dataclass(frozen=True, kw_only=True)
class Recovery:
    """One fit against its target; pixels are those of the image."""

    landmark_px: float  # mean over 68: fitted sliders, expressions and camera against the landmarks without noise
    noisy_px: float  # the same against those that the fit was given
    slider: float  # mean share of the range, sliders that move the head
    nothing_slider: float  # the same for all sliders at their default
    moving: int  # how many those are
    slider_rms: float
    sliders: Mapping[str, float]  # fitted less true value over the range, each of those
    geometry_mm: float  # mean over the face's points, neutral against neutral, after rigid alignment
    default_mm: float  # the same for all sliders at their default
    posed_mm: float  # with expressions
    active: int  # sliders away from their default
    expression: float  # mean error of the weights of shapes that are on in either


def recovery(parts: FaceParts, rig: Rig, target: RecoveryTarget, fit: PhotoFit) -> Recovery:
    """The figures of one fit."""
    view = fit.views[0]
    face, mm = face_points(parts), 1000 * parts.meters_per_unit
    neutral, points = posed(parts, rig, fit.sliders, {}), posed(parts, rig, fit.sliders, view.expressions)
    seen = FaceLandmarks.of(parts).project(points, render_camera(view.camera))
    reach = slider_reach(parts, target.sliders)
    moving = [name for name, distance in reach.items() if distance * mm > MOVES_MM]
    errors = slider_errors(parts.sliders, fit.sliders, target.sliders, moving)
    nothing = slider_errors(parts.sliders, {}, target.sliders, moving)
    wrong = np.array(list(errors.values()))
    return Recovery(
        landmark_px=mean_distance(seen, target.exact),
        noisy_px=mean_distance(seen, target.landmarks),
        slider=float(np.abs(wrong).mean()),
        nothing_slider=float(np.abs(list(nothing.values())).mean()),
        moving=len(moving),
        slider_rms=float(np.sqrt((wrong**2).mean())),
        sliders=errors,
        geometry_mm=mm * aligned_error(neutral[face], target.neutral[face]),
        default_mm=mm * aligned_error(posed(parts, rig, {}, {})[face], target.neutral[face]),
        posed_mm=mm * aligned_error(points[face], target.points[face]),
        active=active_sliders(parts.sliders, fit.sliders),
        expression=weight_error(view.expressions, target.expressions),
    )


def mean_distance(found: FloatArray, truth: FloatArray) -> float:
    """Mean distance of (n, d) points."""
    return float(np.linalg.norm(np.asarray(found) - truth, axis=1).mean())


def aligned_error(found: FloatArray, truth: FloatArray) -> float:
    """Mean distance of (n, 3) points after the rigid motion that brings them closest in least squares."""
    return mean_distance(fit_similarity(found, truth, scale=False).apply(found), truth)


def slider_reach(parts: FaceParts, values: Mapping[str, float]) -> dict[str, float]:
    """How far, in stage units, each slider of a person moves the point of the head that it moves farthest.

    Each goes alone from its minimum to its maximum, the others keep `values`. All points of the first mesh count, those
    of ears and neck too.
    """
    rig = build(replace(parts, meshes=parts.meshes[:1]))

    def head(name: str, value: float) -> FloatArray:
        return posed(parts, rig, {**values, name: value}, {})

    return {
        slider.name: float(
            np.linalg.norm(head(slider.name, slider.maximum) - head(slider.name, slider.minimum), axis=1).max()
        )
        for slider in Subject.of(parts).free_sliders
    }


def slider_errors(
    sliders: Collection[Slider], found: Mapping[str, float], truth: Mapping[str, float], names: Collection[str]
) -> dict[str, float]:
    """Fitted less true value as a share of the range, of the sliders named; what is not given is at its default."""
    chosen = [slider for slider in sliders if slider.name in names]
    return {
        one.name: (found.get(one.name, one.default) - truth.get(one.name, one.default)) / (one.maximum - one.minimum)
        for one in chosen
    }


def active_sliders(sliders: Collection[Slider], values: Mapping[str, float]) -> int:
    """Number of sliders farther than `ACTIVE_SHARE` of their range from their default."""
    shares = slider_errors(sliders, values, {}, [slider.name for slider in sliders if slider.maximum > slider.minimum])
    return sum(abs(share) > ACTIVE_SHARE for share in shares.values())


def weight_error(found: Mapping[str, float], truth: Mapping[str, float]) -> float:
    """Mean difference of the weights of shapes that are on, above `ACTIVE_SHARE`, in either; 0 where none is."""
    names = {name for name, weight in (*found.items(), *truth.items()) if abs(weight) > ACTIVE_SHARE}
    wrong = [abs(found.get(name, 0.0) - truth.get(name, 0.0)) for name in sorted(names)]
    return float(np.mean(wrong)) if wrong else 0.0


def face_points(parts: FaceParts) -> BoolArray:
    """(n,) points of all meshes that count as the face: skin between hairline and chin that a viewer can see.

    Those of the first mesh in front of the outermost contour landmarks, without ears and neck, up to as far above the
    brows as the nose ends below them (the rule of thirds), and not inside mouth, nostrils or eye sockets.
    """
    mesh = parts.meshes[0]
    points = np.asarray(mesh.points, dtype=np.float64)
    landmarks = points[np.asarray(mesh.landmarks[SCHEME].indices)]
    brow = landmarks[list(BROW), 1].mean()
    chosen = (np.asarray(mesh.regions["ears"]) < 0.5) & (np.asarray(mesh.regions["neck"]) < 0.5)
    chosen &= points[:, 2] > landmarks[list(EARS), 2].mean()
    chosen &= points[:, 1] < 2 * brow - landmarks[NOSE_BASE, 1]
    chosen &= _sky(parts) > OPEN_SKY
    rest = sum(len(other.points) for other in parts.meshes[1:])
    return np.concatenate([chosen, np.zeros(rest, bool)])


def _sky(parts: FaceParts) -> FloatArray:
    """(n,) share of its sky that each point of the first mesh sees, that mesh alone."""
    from facepipe.pictures.scene import build_scene

    alone = FaceParts(meshes=parts.meshes[:1], materials=parts.materials)
    scene = build_scene(alone, None)
    return ambient_occlusion(scene.points, scene.normals, scene.triangles)


def render_camera(camera: FittedCamera) -> Camera:
    """A fitted camera as `facepipe.pictures` has it."""
    from scipy.spatial.transform import Rotation

    axes = Rotation.from_rotvec(camera.rotation).as_matrix()
    return Camera(
        axes=axes, eye=-axes.T @ np.asarray(camera.translation), focal=float(camera.focal), center=camera.center
    )
