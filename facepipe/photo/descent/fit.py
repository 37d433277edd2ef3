"""Sliders, expressions and cameras of a face from photos of one person (photo-to-face-sliders, claims 1-6)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.geometry.landmarks import eye_distance, quarter_turned, quarters_to_upright
from facepipe.networks.onnx_file import Kind
from facepipe.parts import FaceParts
from facepipe.photo.descent.descent import Descent, Unknowns, descend
from facepipe.photo.descent.joint_loss import FEATURES, JointLoss
from facepipe.photo.descent.landmark_fit import LandmarkFit, Priors, State
from facepipe.photo.descent.landmark_rig import COUNT, dense_points, front_axes, landmark_points
from facepipe.photo.descent.lighting import in_better_light, lit, renew_shadows
from facepipe.photo.descent.subject import NUMBERS, FittedCamera, FittedView, PhotoFit, PoseSpace, Subject
from facepipe.photo.descent.working_photo import WorkingPhoto, to_srgb
from facepipe.photo.features.extractor import Extractor
from facepipe.photo.options import PhotoFitOptions
from facepipe.photo.renderer.face_model import FaceModel
from facepipe.photo.renderer.light import DARK
from facepipe.rig.torch.one_thread import one_thread

_PHOTO = "expected an array of floating-point sRGB 0 to 1"
_LANDMARKS = "expected a finite array ({}, 2) of pixels"
# A clockwise quarter turn: the harmonic that each of the nine comes from, and its sign (`renderer.light.basis`)
_HARMONICS = [0, 3, 2, 1, 4, 7, 6, 5, 8]
_SIGNS = np.array((1, -1, 1, 1, -1, -1, 1, 1, -1))
_GRID = 1024  # to a pixel: landmarks on it are the same numbers however often they are turned
Mask = Callable[[FloatArray, FloatArray], FloatArray]

_NOT_FINITE = "the loss was not finite at step {}: the best of the steps before is kept"


def check_photos(photos: Sequence[FloatArray], landmarks: Sequence[FloatArray], dense: int = 0) -> list[FloatArray]:
    """The landmarks in float64.

    :param dense: how many the face has beside the 68
    :raises InputError: no photo, or arrays that are no photos with a face's landmarks
    """
    if len(photos) == 0 or len(photos) != len(landmarks):
        raise InputError("photos", f"{len(photos)} with {len(landmarks)} sets of landmarks, expected one for each")
    expected = _LANDMARKS.format(f"{COUNT} or {COUNT + dense}" if dense else COUNT)
    for number, (photo, marks) in enumerate(zip(photos, landmarks, strict=True)):
        where = f"photo {number}"
        _check_array(where, photo, "f", _PHOTO)
        if photo.ndim != 3 or photo.shape[2] != 3 or not photo.size:
            raise InputError(where, f"shape {photo.shape}, expected finite (height, width, 3)")
        if not np.isfinite(photo).all():
            raise InputError(where, "NaN or infinity, expected finite (height, width, 3)")
        if photo.max() > 1 or photo.min() < 0:
            raise InputError(where, f"values {photo.min():g} to {photo.max():g}, expected 0 to 1")
        where = f"landmarks {number}"
        _check_array(where, marks, "fiu", expected)
        if marks.shape not in ((COUNT, 2), (COUNT + dense, 2)):
            raise InputError(where, f"shape {marks.shape}, {expected}")
        if not np.isfinite(marks).all():
            raise InputError(where, f"NaN or infinity, {expected}")
        if not eye_distance(marks) > 0:
            raise InputError(where, "outer corners of the eyes at one place, expected those of a face")
    return [np.asarray(marks, dtype=np.float64) for marks in landmarks]


def check_confidences(confidences: Sequence[FloatArray], counts: Sequence[int]) -> list[FloatArray]:
    """The confidences of so many landmarks of each photo in float64.

    :raises InputError: another number of them, or arrays that are no numbers 0 to 1
    """
    if len(confidences) != len(counts):
        raise InputError("confidences", f"{len(confidences)} of {len(counts)} photos, expected one for each")
    checked = [
        _numbers(f"confidences {number}", each, (count,), "one for each landmark")
        for number, (each, count) in enumerate(zip(confidences, counts, strict=True))
    ]
    for number, each in enumerate(checked):
        if not 0 <= each.min() <= each.max() <= 1:
            raise InputError(f"confidences {number}", f"values {each.min():g} to {each.max():g}, expected 0 to 1")
    return checked


def check_start(start: State, subject: Subject, spaces: Sequence[PoseSpace]) -> State:
    """The same in float64.

    :raises InputError: a state of another face, of another number of photos, or of what can't be
    """
    views = len(spaces)
    checked = State(
        shares=_numbers("start -> shares", start.shares, (len(subject.sliders),), "one for each free slider"),
        expressions=_numbers(
            "start -> expressions", start.expressions, (views, len(subject.expressions)), "photos, expressions"
        ),
        poses=_numbers("start -> poses", start.poses, (views, NUMBERS), "photos, numbers of a pose"),
    )
    for name, values in (("shares", checked.shares), ("expressions", checked.expressions)):
        if values.size and not 0 <= values.min() <= values.max() <= 1:
            raise InputError(f"start -> {name}", f"values {values.min():g} to {values.max():g}, expected 0 to 1")
    for number, (space, pose) in enumerate(zip(spaces, checked.poses, strict=True)):
        camera = space.camera(torch.as_tensor(pose, dtype=torch.float32))  # in which it is drawn: exp may overflow
        if not (camera.translation.isfinite().all() and camera.focal.isfinite() and camera.focal > 0):
            raise InputError(f"start -> poses -> photo {number}", "beyond every camera, expected a pose of a head")
    return checked


def _numbers(where: str, values: FloatArray, shape: tuple[int, ...], what: str) -> FloatArray:
    expected = f"expected finite {shape}: {what}"
    _check_array(where, values, "f", expected)
    if values.shape != shape:
        raise InputError(where, f"shape {values.shape}, {expected}")
    if not np.isfinite(values).all():
        raise InputError(where, f"NaN or infinity, {expected}")
    return np.asarray(values, dtype=np.float64)


def check_extractors(extractors: Mapping[Kind, Extractor]) -> None:
    """:raises InputError: a network for no term of the joint loss, or one that doesn't give what it is there for"""
    for kind, extractor in extractors.items():
        where = f"extractors -> {kind}"
        if kind not in FEATURES:
            raise InputError(where, f"no term of the joint loss, expected one of {', '.join(FEATURES)}")
        if not isinstance(extractor, Extractor) or kind not in extractor.kinds:
            gives = (
                f"a network of {', '.join(extractor.kinds)}"
                if isinstance(extractor, Extractor)
                else f"a {type(extractor).__name__}"
            )
            raise InputError(where, f"{gives}, expected a network of {kind} (`load_extractor`)")


def _check_array(where: str, values: object, kinds: str, expected: str) -> None:
    if not isinstance(values, np.ndarray):
        raise InputError(where, f"a {type(values).__name__}, {expected}")
    if values.dtype.kind not in kinds:
        raise InputError(where, f"numbers of type {values.dtype}, {expected}")


@dataclass(frozen=True, kw_only=True)
class UprightPhotos:
    """Photos turned counter-clockwise by quarters, each until its face is within 45 degrees of upright.

    A fit carries last digits of where it starts to first ones of where it ends: a photo and the same one on its side
    must have the same landmarks to the last digit.
    """

    photos: tuple[FloatArray, ...]  # (h, w, 3)
    landmarks: tuple[FloatArray, ...]  # (68, 2) pixels
    quarters: tuple[int, ...]

    @classmethod
    def from_photos(cls, photos: Sequence[FloatArray], landmarks: Sequence[FloatArray]) -> UprightPhotos:
        """:param photos: as they are, (h, w, 3)"""
        quarters = tuple(map(quarters_to_upright, landmarks))
        turned = [np.ascontiguousarray(np.rot90(*pair)) for pair in zip(photos, quarters, strict=True)]
        each = zip(landmarks, quarters, map(_size, photos), strict=True)
        marks = tuple(np.round(quarter_turned(*one) * _GRID) / _GRID for one in each)
        return cls(photos=tuple(turned), landmarks=marks, quarters=quarters)

    def start(self, start: State) -> State:
        """A state of the photos as they were, as one of these."""
        poses = start.poses.copy()
        for pose, photo, quarters in zip(poses, self.photos, self.quarters, strict=True):
            if quarters:
                width, height = _size(photo)
                before, side = (height, width) if quarters % 2 else (width, height), max(width, height)
                pose[:3] = (_about_axis(quarters) * Rotation.from_rotvec(pose[:3])).as_rotvec()
                pose[3:5] = quarter_turned(pose[3:5] * side, quarters, before) / side
        return replace(start, poses=poses)

    def turned_back(self, views: Sequence[FittedView]) -> tuple[FittedView, ...]:
        """Views of these, as views of the photos as they were."""
        result = []
        for view, quarters, size in zip(views, self.quarters, map(_size, self.photos), strict=True):
            if not quarters:
                result.append(view)
                continue
            turn, camera, light = _about_axis(-quarters), view.camera, view.light
            for _ in range(quarters):
                light = _SIGNS[:, None] * light[_HARMONICS]
            x, y = quarter_turned(np.array(camera.center), -quarters, size)
            turned = replace(
                view,
                camera=FittedCamera(
                    rotation=(turn * Rotation.from_rotvec(camera.rotation)).as_rotvec(),
                    translation=turn.apply(camera.translation),
                    focal=camera.focal,
                    center=(float(x), float(y)),
                ),
                light=light,
                key=np.concatenate([turn.apply(view.key[:3]), view.key[3:]]),
                landmarks=quarter_turned(view.landmarks, -quarters, size),
                targets=quarter_turned(view.targets, -quarters, size),
            )
            result.append(turned)
        return tuple(result)


def _about_axis(quarters: int) -> Rotation:
    """Of camera coordinates, counter-clockwise as the photo shows it."""
    return Rotation.from_rotvec([0.0, 0.0, quarters * np.pi / 2])


def _size(photo: FloatArray) -> tuple[int, int]:
    """Width and height."""
    return photo.shape[1], photo.shape[0]


def fit_result(loss: JointLoss, descent: Descent) -> PhotoFit:
    """The best of a descent as sliders, expressions, cameras and light."""
    fit, best = loss.fit, descent.best
    subject, state = fit.subject, best.state()
    landmarks, errors = fit.landmarks(state), fit.errors(state)
    views = []
    for view, space in enumerate(fit.spaces):
        camera = space.camera(torch.as_tensor(state.poses[view]))
        weights = zip(subject.expressions, state.expressions[view], strict=True)
        key = best.key[view].numpy().astype(np.float64)
        length = float(np.linalg.norm(key[:3]))
        # as `KeyLight` takes it: a unit direction, colour and shine of 0 or more; a lamp without a direction is none
        unit = np.concatenate([key[:3] / length, np.maximum(key[3:7], 0.0), key[7:]]) if length > 0 else np.array(DARK)
        one = FittedView(
            expressions={subject.rig.shapes[i]: float(np.float32(weight)) for i, weight in weights},
            camera=FittedCamera(
                rotation=camera.rotation.numpy(),
                translation=camera.translation.numpy(),
                focal=float(camera.focal),
                center=(float(camera.center[0]), float(camera.center[1])),
            ),
            light=best.light[view].numpy().astype(np.float64),
            key=unit,
            landmarks=landmarks[view],
            targets=fit.targets[view][:COUNT],
            landmark_error=float(errors[view].mean()),
        )
        views.append(one)
    values = np.asarray(subject.slider_values(state.shares), dtype=np.float32)
    names = loss.model.colors.names
    warnings = () if descent.stopped != "not-finite" else (_NOT_FINITE.format(len(descent.history) - 1),)
    return PhotoFit(
        sliders={subject.parts.sliders[i].name: float(values[i]) for i in subject.sliders},
        views=tuple(views),
        tint={
            name: (float(r), float(g), float(b)) for name, (r, g, b) in zip(names, best.tint.exp(), strict=True) if name
        },
        history=descent.history,
        kept=descent.kept,
        steps=max(len(descent.history) - 1, 0),
        stopped=descent.stopped,
        warnings=warnings,
    )


@one_thread()
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
    done: Callable[[Callable[[], FloatArray]], None] | None = None,
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
    :param done: called after each step with what draws the fit so far over the first photo's head, (h, w, 3) sRGB 0..1
    :raises InputError: no photo, arrays or a start that don't fit, networks of other kinds, a face without the 68
        landmarks or without sliders
    """
    landmarks = check_photos(photos, landmarks, len(dense_points(parts)))
    confidences = None if confidences is None else check_confidences(confidences, [len(each) for each in landmarks])
    check_extractors(extractors or {})
    upright, priors = UprightPhotos.from_photos(photos, landmarks), priors_of(options, slider_sigma)
    subject = Subject.of(parts, expressions)
    spaces = [pose_space(subject, photo.shape[1], photo.shape[0]) for photo in upright.photos]
    start = None if start is None else upright.start(check_start(start, subject, spaces))
    fit = LandmarkFit(subject, upright.landmarks, spaces, priors, confidences=confidences)
    state = fit.solve(fit.start() if start is None else start)
    if extractors is None and options.iterations:
        from facepipe.photo.features.extractor import own_extractors

        extractors = own_extractors([kind for kind in FEATURES if getattr(options, kind)])
    networks = extractors if extractors and options.iterations else {}
    working = [
        WorkingPhoto.from_photo(photo, marks[:COUNT], options.size, mask and mask(photo, marks[:COUNT]))
        for photo, marks in zip(upright.photos, upright.landmarks, strict=True)
    ]
    model = FaceModel(parts, rig=subject.rig, drawn_only=True, largest_texture=options.size)
    loss = JointLoss(model, fit, working, networks, options)
    begin = _better_begin(loss, state, start)
    stepped = None if done is None else lambda at: done(partial(_drawn, loss, at, upright.quarters[0]))
    found = fit_result(loss, descend(loss, begin, options, stepped, renew=partial(renew_shadows, loss)))
    return replace(found, views=upright.turned_back(found.views))


def _drawn(loss: JointLoss, at: Unknowns, quarters: int) -> FloatArray:
    """The first photo's head as it is fitted, turned as the photo was."""
    with torch.no_grad():
        image = to_srgb(loss.image(at, 0)[..., :3])
    return np.rot90(image.numpy(), -quarters)


def _better_begin(loss: JointLoss, state: State, start: State | None) -> Unknowns:
    """A state, or a guess if it has less joint loss, each in the light that suits it: few steps may not find that."""
    begin = lit(loss, state)
    loss.calibrate(begin)
    begin = in_better_light(loss, begin)
    if start is None:
        return begin
    shadows = list(loss.shadows)
    with torch.no_grad():
        reached = float(loss(begin)["total"])
    guessed = in_better_light(loss, lit(loss, start))
    with torch.no_grad():
        if float(loss(guessed)["total"]) < reached:
            return guessed
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
    """What stage one takes as likely; `slider_sigma` as for `fit_photos`."""
    priors = Priors(
        landmark_sigma=options.landmark_sigma,
        expression_sparsity=COUNT * options.expression_sparsity,
        slider_sparsity=COUNT * options.sparsity,
        focal_sigma=options.focal_sigma,
    )
    return priors if slider_sigma is None else replace(priors, slider_sigma=slider_sigma, slider_sparsity=0.0)
