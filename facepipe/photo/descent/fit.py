"""Sliders, expressions and cameras of a face from photos of one person (photo-to-face-sliders, claims 1-6)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from facepipe.core.arrays import FloatArray
from facepipe.networks.description import Kind
from facepipe.parts import FaceParts
from facepipe.photo.descent.descent import Descent, Unknowns, descend
from facepipe.photo.descent.fit_input import check_confidences, check_extractors, check_photos, check_start
from facepipe.photo.descent.joint_loss import FEATURES, JointLoss
from facepipe.photo.descent.landmark_fit import LandmarkFit, Priors, State
from facepipe.photo.descent.landmark_rig import COUNT, dense_points, front_axes, landmark_points
from facepipe.photo.descent.lighting import in_better_light, lit, renew_shadows
from facepipe.photo.descent.pose import PoseSpace
from facepipe.photo.descent.result import FittedCamera, FittedView, PhotoFit
from facepipe.photo.descent.subject import Subject
from facepipe.photo.descent.upright import UprightPhotos
from facepipe.photo.descent.working_photo import WorkingPhoto
from facepipe.photo.features.extractor import Extractor
from facepipe.photo.options import PhotoFitOptions
from facepipe.photo.renderer.face_model import FaceModel
from facepipe.photo.renderer.light import DARK
from facepipe.rig.torch.one_thread import one_thread

Mask = Callable[[FloatArray, FloatArray], FloatArray]

_NOT_FINITE = "the loss was not finite at step {}: the best of the steps before is kept"


def fit_result(loss: JointLoss, descent: Descent) -> PhotoFit:
    """The best of a descent as sliders, expressions, cameras and light."""
    subject, best = loss.fit.subject, descent.best
    state = best.state()
    values = np.asarray(subject.slider_values(state.shares), dtype=np.float32)
    names = loss.model.colors.names
    warnings = () if descent.stopped != "not-finite" else (_NOT_FINITE.format(len(descent.history) - 1),)
    return PhotoFit(
        sliders={subject.parts.sliders[i].name: float(values[i]) for i in subject.sliders},
        views=tuple(_view(loss, best, state, view) for view in range(len(loss.photos))),
        tint={name: _color(factor) for name, factor in zip(names, best.tint.exp(), strict=True) if name},
        history=descent.history,
        kept=descent.kept,
        steps=max(len(descent.history) - 1, 0),
        stopped=descent.stopped,
        warnings=warnings,
    )


def _view(loss: JointLoss, best: Unknowns, state: State, view: int) -> FittedView:
    fit = loss.fit
    camera = fit.spaces[view].camera(torch.as_tensor(state.poses[view]))
    shapes = fit.subject.rig.shapes
    weights = zip(fit.subject.expressions, state.expressions[view], strict=True)
    return FittedView(
        expressions={shapes[i]: float(np.float32(weight)) for i, weight in weights},
        camera=FittedCamera(
            rotation=camera.rotation.numpy(),
            translation=camera.translation.numpy(),
            focal=float(camera.focal),
            center=(float(camera.center[0]), float(camera.center[1])),
        ),
        light=best.light[view].numpy().astype(np.float64),
        key=_lamp(best.key[view].numpy().astype(np.float64)),
        landmarks=fit.landmarks(state)[view],
        targets=fit.targets[view][:COUNT],
        landmark_error=float(fit.errors(state)[view].mean()),
    )


def _lamp(key: FloatArray) -> FloatArray:
    """(8,) as `KeyLight` takes it: a unit direction, colour and shine of 0 or more."""
    length = float(np.linalg.norm(key[:3]))
    if not length > 0:
        return np.array(DARK)
    return np.concatenate([key[:3] / length, np.maximum(key[3:7], 0.0), key[7:]])


def _color(factor: torch.Tensor) -> tuple[float, float, float]:
    red, green, blue = map(float, factor)
    return red, green, blue


def fit_photos(
    parts: FaceParts,
    photos: Sequence[FloatArray],
    landmarks: Sequence[FloatArray],
    options: PhotoFitOptions,
    *,
    confidences: Sequence[FloatArray] | None = None,
    expressions: Sequence[str] | None = None,
    extractors: Mapping[Kind, Extractor] | None = None,
    start: State | None = None,
    slider_sigma: float | None = None,
    mask: Mask | None = None,
    done: Callable[[int], None] | None = None,
) -> PhotoFit:
    """The person, and the expression, camera and light of each photo.

    Photos are fitted by quarter turns that bring the face nearest to upright, and cameras and light turned back.
    Stage one fits landmarks, stage two descends on the joint loss from there; or from `start` itself, if its joint loss
    is less: landmarks alone don't show what a guess has seen in the pictures.

    :param photos: (h, w, 3) sRGB 0..1
    :param landmarks: (68, 2) Multi-PIE landmarks of each, pixels from its top left corner, or (68 + d, 2) with those of
        the face's scheme ``dense``
    :param confidences: one for each of a photo's landmarks, 0 to 1: what their squared errors count beside each other;
        None: all alike
    :param expressions: shapes that are expressions; None: those with ARKit's names
    :param extractors: networks by kind (content, identity, attributes); None: our own
    :param slider_sigma: standard deviation of the sliders, of their range, where that is known (identity modes);
        None: the usual one, and the fewer sliders are off their defaults, the likelier
    :param start: where to start from instead of the defaults, as `facepipe train-photo` guesses it
    :param mask: tells which pixels of a photo with these landmarks are face, as shares (h, w); None: all
    :param done: called with 1 after each step
    :raises InputError: no photo, arrays or a start that don't fit, networks of other kinds, a face without the 68
        landmarks or without sliders
    """
    landmarks = check_photos(photos, landmarks, len(dense_points(parts)))
    confidences = None if confidences is None else check_confidences(confidences, [len(each) for each in landmarks])
    check_extractors(extractors or {})
    upright = UprightPhotos.from_photos(photos, landmarks)
    with one_thread():
        priors = priors_of(options, slider_sigma)
        fit = _fit(parts, upright, confidences, options, priors, expressions, extractors, start, mask, done)
    return replace(fit, views=upright.turned_back(fit.views))


def _fit(
    parts: FaceParts,
    upright: UprightPhotos,
    confidences: Sequence[FloatArray] | None,
    options: PhotoFitOptions,
    priors: Priors,
    expressions: Sequence[str] | None,
    extractors: Mapping[Kind, Extractor] | None,
    start: State | None,
    mask: Mask | None,
    done: Callable[[int], None] | None,
) -> PhotoFit:
    subject = Subject.of(parts, expressions)
    spaces = [pose_space(subject, photo.shape[1], photo.shape[0]) for photo in upright.photos]
    start = None if start is None else upright.start(check_start(start, subject, spaces))
    fit = LandmarkFit(subject, upright.landmarks, spaces, priors, confidences=confidences)
    state = fit.solve(fit.start() if start is None else start)
    networks = _extractors(extractors, options) if options.iterations else {}
    model = FaceModel(parts, largest_texture=options.size)
    working = [
        WorkingPhoto.from_photo(photo, marks[:COUNT], options.size, mask and mask(photo, marks[:COUNT]))
        for photo, marks in zip(upright.photos, upright.landmarks, strict=True)
    ]
    loss = JointLoss(model, fit, working, networks, options)
    begin = lit(loss, state)
    loss.calibrate(begin)
    begin = in_better_light(loss, begin) if start is None else _better(loss, begin, start)
    descent = descend(loss, begin, options, done, renew=partial(renew_shadows, loss))
    return fit_result(loss, descent)


def _better(loss: JointLoss, begin: Unknowns, start: State) -> Unknowns:
    """The one with less joint loss, each in the light that suits it: there may be few steps to find that in."""
    begin, shadows = in_better_light(loss, begin), list(loss.shadows)
    with torch.no_grad():
        reached = float(loss(begin)["total"])
    other = in_better_light(loss, lit(loss, start))
    with torch.no_grad():
        if float(loss(other)["total"]) < reached:
            return other
    loss.shadows[:] = shadows
    return begin


def pose_space(subject: Subject, width: int, height: int) -> PoseSpace:
    """What poses of a subject mean in a photo of that many pixels.

    :raises InputError: the face lacks the 68 landmarks
    """
    points, _ = landmark_points(subject.parts)
    axes = np.stack(front_axes(subject.parts, subject.rig), axis=1)
    rig = subject.rig
    world = rig.points @ rig.parent_world[:3, :3].T + rig.parent_world[:3, 3]
    return PoseSpace(
        middle=world[points].mean(axis=0),
        size=float(np.ptp(axes[:, 1])),
        center=(width / 2, height / 2),
        side=float(max(width, height)),
    )


def priors_of(options: PhotoFitOptions, slider_sigma: float | None = None) -> Priors:
    """What stage one takes as likely.

    :param slider_sigma: as for `fit_photos`
    """
    priors = Priors(
        landmark_sigma=options.landmark_sigma,
        expression_sparsity=COUNT * options.expression_sparsity,
        slider_sparsity=COUNT * options.sparsity,
        focal_sigma=options.focal_sigma,
    )
    return priors if slider_sigma is None else replace(priors, slider_sigma=slider_sigma, slider_sparsity=0.0)


def _extractors(given: Mapping[Kind, Extractor] | None, options: PhotoFitOptions) -> Mapping[Kind, Extractor]:
    if given is not None:
        return given
    from facepipe.photo.features.own import own_extractors

    return own_extractors([kind for kind in FEATURES if getattr(options, kind)])
