"""Authors what a photo fit found on the stage, checked first: sliders, poses, and the cameras of the photos."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray, IntArray, require_finite
from facepipe.core.errors import FitError, InputError
from facepipe.core.names import suggestion, unique_identifiers
from facepipe.geometry.landmarks import eye_distance
from facepipe.parts import Animation, FaceParts, KeyLamp, PhotoView, Recipe, Slider
from facepipe.photo.fit.report import PhotoFitReport, PhotoReport, loss_ends
from facepipe.stage import Face
from facepipe.stage.animation_source import play
from facepipe.stage.author_changes import author_changes
from facepipe.verbs.sliders import SetSliders, SetSlidersReport
from facepipe.verbs.sliders.author_sliders import pose

if TYPE_CHECKING:
    from facepipe.photo.descent.subject import FittedView, PhotoFit
    from facepipe.photo.fit.photo_file import Photo

SCHEME = "pupils"
_LOOKS = "eyeLook"  # of ARKit's shapes of lids that follow eyes
_STEP, _ROUNDS = 0.02, 3  # of a slider's range, and of Gauss and Newton
_USUAL = 0.5  # standard deviation of a slider
_SHOWN = 4  # names of a list
_MARGIN = 10.0  # the clipping range is this many times wider than the face, each way
_LEAST_NEAR = 1e-4  # of the farthest depth, where the face reaches behind the camera


def look_sliders(sliders: tuple[Slider, ...]) -> tuple[Slider, ...]:
    """Sliders that turn the eyes, and of shapes drive those of lids that follow them alone."""
    return tuple(
        one for one in sliders if one.channels and one.shapes and all(name.startswith(_LOOKS) for name, _ in one.shapes)
    )


def pupil_points(parts: FaceParts) -> IntArray:
    """(2,) points of the pupils, meshes concatenated, the person's left first; none without the scheme `SCHEME`."""
    start, found = 0, []
    for mesh in parts.meshes:
        if SCHEME in mesh.landmarks:
            found += [start + int(index) for index in mesh.landmarks[SCHEME].indices]
        start += len(mesh.points)
    return np.array(found if len(found) == 2 else [], np.int64)


def gaze(face: Face, values: Mapping[str, float], view: FittedView) -> dict[str, float]:
    """Values of the look sliders that turn the pupils of a person to where a photo has them; none: it shows none.

    The likeliest, by Gauss-Newton: the pupils' errors are normal, and so are the sliders about their defaults.

    :param values: of the person's sliders
    """
    sliders, points = look_sliders(face.sliders), pupil_points(face.parts())
    seen = view.pupils
    if seen is None or not sliders or len(points) != 2:
        return {}
    rest = np.array([slider.default for slider in sliders])
    lower, upper = (np.array([getattr(slider, name) for slider in sliders]) for name in ("minimum", "maximum"))
    names = [slider.name for slider in sliders]

    def residuals(at: FloatArray) -> FloatArray:
        looking = dict(values) | dict(zip(names, at.tolist(), strict=True))
        marks = _projected(view, face.evaluate(dict(view.expressions), sliders=looking)[points])
        return np.append((marks - seen[:, :2]) / seen[:, 2:], (at - rest) / _USUAL)

    found = rest
    for _ in range(_ROUNDS):
        steps = [np.where(np.arange(len(found)) == i, _STEP, 0.0) for i in range(len(found))]
        slopes = [(residuals(found + step) - residuals(found - step)) / (2 * _STEP) for step in steps]
        change = np.linalg.lstsq(np.stack(slopes, axis=1), -residuals(found), rcond=None)[0]
        # a step inside the range: beyond its end the central difference would halve the slope
        found = np.clip(found + change, lower + _STEP, upper - _STEP)
    return dict(zip(names, found.tolist(), strict=True))


def _projected(view: FittedView, points: FloatArray) -> FloatArray:
    """(n, 2) pixels of world points."""
    from scipy.spatial.transform import Rotation

    camera = view.camera
    local = Rotation.from_rotvec(camera.rotation).apply(points) + camera.translation
    return np.asarray(camera.focal * local[:, :2] * (1, -1) / -local[:, 2:] + camera.center)


def check_fit(face: Face, fit: PhotoFit, photos: Sequence[Photo]) -> None:
    """Check all of a fit but its slider values, which `SetSliders` checks, and its history.

    :raises InputError: NaN or infinity, another number of photos than views, shapes or materials that the face lacks,
        expressions or tints out of range, or arrays of another shape
    """
    if not photos or len(photos) != len(fit.views):
        raise InputError(face.where, f"{len(photos)} photos of {len(fit.views)} views, expected as many, one or more")
    require_finite(replace(fit, views=(), history=()), face.where)
    for photo, view in zip(photos, fit.views, strict=True):
        where = f"{face.where} -> photo {photo.name}"
        require_finite(view, where)
        for name, found, expected in _shapes(view):
            if found != expected:
                raise InputError(f"{where} -> {name}", f"shape {found}, expected {expected}")
        if not view.camera.focal > 0:
            raise InputError(f"{where} -> camera", f"focal length {view.camera.focal:g}, expected more than 0")
        if view.landmark_error < 0:
            raise InputError(f"{where} -> landmark_error", f"{view.landmark_error:g}, expected 0 or more")
        _check_key(f"{where} -> key", view.key)
        _check_expressions(face, where, view.expressions)
    _check_tint(face, fit)


def _shapes(view: FittedView) -> Iterator[tuple[str, tuple[int, ...], tuple[int, ...]]]:
    yield "camera -> rotation", np.shape(view.camera.rotation), (3,)
    yield "camera -> translation", np.shape(view.camera.translation), (3,)
    yield "camera -> center", np.shape(view.camera.center), (2,)
    yield "light", np.shape(view.light), (9, 3)
    yield "key", np.shape(view.key), (8,)
    yield "landmarks", np.shape(view.landmarks), (68, 2)
    yield "targets", np.shape(view.targets), (68, 2)
    if view.pupils is not None:
        yield "pupils", np.shape(view.pupils), (2, 3)


def _check_key(where: str, key: FloatArray) -> None:
    if not np.any(key[:3]):
        raise InputError(where, "direction 0, expected that to the lamp")
    if np.min(key[3:6]) < 0:
        raise InputError(where, f"colour {tuple(map(float, key[3:6]))}, expected 0 or more")
    if key[6] < 0:
        raise InputError(where, f"shine {key[6]:g}, expected 0 or more")


def _check_expressions(face: Face, where: str, expressions: Mapping[str, float]) -> None:
    for name, weight in expressions.items():
        if name not in face.shapes:
            raise InputError(f"{where} -> {name}", f"no such shape{suggestion(name, face.shapes)}")
        if not 0 <= weight <= 1:
            raise InputError(f"{where} -> {name}", f"weight {weight:g}, expected 0 to 1")


def _check_tint(face: Face, fit: PhotoFit) -> None:
    known = [material.name for material in face.materials]
    for name, tint in fit.tint.items():
        if name and name not in known:  # "" are surfaces without a material
            raise InputError(f"{face.where} -> tint {name}", f"no such material{suggestion(name, known)}")
        if np.shape(tint) != (3,) or not min(tint) >= 0:
            raise InputError(f"{face.where} -> tint {name}", f"{tint}, expected 3 factors of 0 or more")


def mixed_sliders(sliders: Sequence[Slider], views: Sequence[FittedView]) -> tuple[str, ...]:
    """A line where sliders off their defaults drive shapes that are expressions of a photo too."""
    expressions = {name for view in views for name in view.expressions}
    mixed = [
        slider.name
        for slider in sliders
        if slider.value not in (None, slider.default) and any(shape in expressions for shape, _ in slider.shapes)
    ]
    if not mixed:
        return ()
    return (f"the neutral is not free of expression: {_some(mixed)} drive shapes that are fitted as expressions too",)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (f" ... ({len(names)} in all)" if len(names) > _SHOWN else "") or "none"


def clipping_range(where: str, to_world: FloatArray, points: FloatArray) -> tuple[float, float]:
    """Nearest and farthest depth to show of world points (n, 3), with a margin.

    :raises FitError: all points are behind the camera
    """
    depths = (to_world[:3, 3] - points) @ to_world[:3, 2]
    far = float(depths.max(initial=0.0))
    if far <= 0:
        raise FitError(where, "the camera looks away from the face, expected the face before it")
    return max(float(depths.min()) / _MARGIN, far * _LEAST_NEAR), far * _MARGIN


@dataclass(frozen=True, kw_only=True)
class AuthorPhotoFit:
    """A person's slider values, and what each photo adds to them.

    Slider values, and as `SetSliders` makes it the pose that they stand for: the neutral, without any expression. The
    face's skeleton plays it. Beside it, for each photo and called as its file, a pose with the expression of the photo
    and a camera that sees the stage as the photo does, with light and tint of materials. Photos that the face had, and
    their poses, are replaced.

    >>> with facepipe.open("head.usda").deriving("person.usda") as face:
    ...     report = AuthorPhotoFit()(face, fit, [photo])

    :param name: of the neutral's animation
    """

    name: str = "sliders"

    def __call__(
        self, face: Face, fit: PhotoFit, photos: Sequence[Photo], *, recipe: Recipe | None = None
    ) -> PhotoFitReport:
        """Author the fit.

        :param photos: that were fitted, one a view
        :param recipe: authored with the result; None leaves what the face has
        :raises InputError: NaN or infinity, another number of photos than views, sliders, shapes or materials that the
            face has not, values out of range, or what `SetSliders` refuses
        :raises FitError: a camera that looks away from the face
        """
        check_fit(face, fit, photos)
        values = {name: float(fit.sliders[name]) for name in sorted(fit.sliders)}
        changed, posed = SetSliders(values=values, name=self.name).changed(face)
        gone = {photo.animation for photo in changed.photos} - {self.name}
        changed = replace(
            changed,
            animations=tuple(animation for animation in changed.animations if animation.name not in gone),
            photos=(),
        )
        names = _names(face, changed, photos)
        neutral = next(animation for animation in changed.animations if animation.name == self.name)
        points = face.evaluate(sliders=values)
        views = tuple(_view(face, *one, fit, points) for one in zip(names, photos, fit.views, strict=True))
        looks = [_looking(changed, gaze(face, values, view), neutral) for view in fit.views]
        poses = (_pose(*each) for each in zip(looks, names, fit.views, strict=True))
        result = replace(
            changed,
            animations=(*changed.animations, *poses),
            photos=views,
            recipe=recipe or changed.recipe,
        )
        authored = author_changes(face, result)
        play(face, self.name)
        return replace(
            _report(fit, photos, names, posed),
            authored=authored,
            warnings=(*fit.warnings, *posed.warnings, *mixed_sliders(changed.sliders, fit.views), *_ended(fit)),
        )


def _names(face: Face, parts: FaceParts, photos: Sequence[Photo]) -> tuple[str, ...]:
    """A name for pose and camera of each photo."""
    taken = {animation.name for animation in parts.animations}
    removed = {animation.name for animation in face.animations} | {photo.name for photo in face.photos}
    for scope in (tokens.ANIMATIONS_SCOPE, tokens.PHOTOS_SCOPE):
        folder = face.prim.GetChild(scope)
        taken |= {str(one.GetName()) for one in folder.GetChildren()} - removed if folder else set()
    return unique_identifiers([*sorted(taken), *(Path(photo.name).stem for photo in photos)], "photo")[len(taken) :]


def _looking(parts: FaceParts, values: Mapping[str, float], neutral: Animation) -> Animation:
    """The neutral with eyes turned by values of the sliders that do so; lids stay: expressions have them."""
    if not values:
        return neutral
    sliders = [
        replace(slider, value=values[slider.name], shapes=(), shape_curves=()) if slider.name in values else slider
        for slider in parts.sliders
    ]
    return pose(parts, sliders, neutral.name)


def _pose(neutral: Animation, name: str, view: FittedView) -> Animation:
    """The neutral with the expression of a photo on it."""
    weights = {} if neutral.shape_weights is None else dict(zip(neutral.shapes, neutral.shape_weights[0], strict=True))
    for shape, weight in view.expressions.items():
        weights[shape] = weights.get(shape, 0.0) + float(weight)
    shapes = tuple(sorted(weights))
    return replace(
        neutral,
        name=name,
        shapes=shapes,
        shape_weights=np.array([[weights[shape] for shape in shapes]]) if shapes else None,
    )


def _view(face: Face, name: str, photo: Photo, view: FittedView, fit: PhotoFit, points: FloatArray) -> PhotoView:
    # (4, 4) rigid transform from camera to world coordinates
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(np.asarray(view.camera.rotation, dtype=np.float64)).as_matrix()
    to_world = np.eye(4)
    to_world[:3, :3] = rotation.T
    to_world[:3, 3] = -rotation.T @ np.asarray(view.camera.translation, dtype=np.float64)
    height, width = photo.pixels.shape[:2]
    x, y = view.camera.center
    return PhotoView(
        name=name,
        image=photo.name,
        width=width,
        height=height,
        transform=to_world,
        focal=float(view.camera.focal),
        center=(float(x), float(y)),
        clipping=clipping_range(f"{face.where} -> photo {photo.name}", to_world, points),
        light=np.asarray(view.light, dtype=np.float64),
        key=_key(np.asarray(view.key, dtype=np.float64)),
        tint={material: (float(r), float(g), float(b)) for material, (r, g, b) in fit.tint.items()},
        landmark_error=float(view.landmark_error),
        animation=name,
    )


def _key(numbers: FloatArray) -> KeyLamp | None:
    """The lamp of (8,) numbers of a view; None where it is black in float32."""
    with np.errstate(over="ignore", under="ignore"):  # the stage refuses infinity
        black, exponent = not np.float32(numbers[3:6]).any(), float(np.exp(numbers[7]))
    if black:
        return None
    x, y, z, red, green, blue = map(float, numbers[:6])
    return KeyLamp(direction=(x, y, z), color=(red, green, blue), shine=float(numbers[6]), exponent=exponent)


def _ended(fit: PhotoFit) -> tuple[str, ...]:
    """A line where the fit ended before its time."""
    if fit.stopped != "not-finite":
        return ()
    return (f"the loss was not finite after {fit.steps} steps: this is the best until then",)


def _report(fit: PhotoFit, photos: Sequence[Photo], names: Sequence[str], posed: SetSlidersReport) -> PhotoFitReport:
    reports = {}
    for photo, name, view in zip(photos, names, fit.views, strict=True):
        height, width = photo.pixels.shape[:2]
        reports[photo.name if photo.name not in reports else name] = PhotoReport(
            animation=name,
            size=(width, height),
            expressions={shape: float(view.expressions[shape]) for shape in sorted(view.expressions)},
            landmark_error_px=float(view.landmark_error),
            eye_distance_px=eye_distance(view.targets),
        )
    return PhotoFitReport(
        animation=posed.animation,
        sliders=posed.values,
        photos=reports,
        steps=fit.steps,
        stopped=fit.stopped,
        losses=loss_ends(fit.history),
        beyond_limits=posed.beyond_limits,
    )
