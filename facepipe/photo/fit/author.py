"""Authors what a photo fit found on the stage, checked first: sliders, poses, and the cameras of the photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from facepipe.core import tokens
from facepipe.core.arrays import FloatArray, IntArray, require_finite
from facepipe.core.errors import FitError, InputError
from facepipe.core.names import suggestion, unique_identifiers
from facepipe.geometry.landmarks import eye_distance
from facepipe.parts import Animation, FaceParts, KeyLamp, PhotoView, Recipe, Slider
from facepipe.photo.fit.report import Loss, PhotoFitReport, PhotoReport
from facepipe.rig import slide
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes
from facepipe.stage.face import play
from facepipe.verbs.sliders import SetSliders
from facepipe.verbs.sliders.author_sliders import pose

if TYPE_CHECKING:
    from facepipe.photo.descent.subject import FittedView, PhotoFit
    from facepipe.photo.fit.photo_file import Photo

SCHEME = "pupils"
_LOOKS = "eyeLook"  # of ARKit's shapes of lids that follow eyes
_STEP, _ROUNDS = 0.02, 3  # of a slider's range, and of Gauss and Newton
_USUAL = 0.5  # standard deviation of a slider
_MOST_NAMES = 4  # of a warning
_MARGIN = 10.0  # the clipping range is this many times wider than the face, each way
_LEAST_NEAR = 1e-4  # of the farthest depth, where the face reaches behind the camera


def pupil_points(parts: FaceParts) -> IntArray:
    """(2,) points of the pupils, meshes concatenated, the person's left first; none without the scheme `SCHEME`."""
    start, found = 0, []
    for mesh in parts.meshes:
        if SCHEME in mesh.landmarks:
            found += [start + int(index) for index in mesh.landmarks[SCHEME].indices]
        start += len(mesh.points)
    return np.array(found if len(found) == 2 else [], np.int64)


def gaze(face: Face, values: Mapping[str, float], view: FittedView) -> dict[str, float]:
    """Values of the look sliders that turn a person's pupils, at `values` of the others, to where a photo has them.

    The likeliest, by Gauss-Newton: the pupils' errors are normal, and so are the sliders about their defaults. None
    where the photo shows none.
    """
    from scipy.spatial.transform import Rotation

    # sliders that turn the eyes, and of shapes drive those of lids that follow them alone
    sliders = [
        one
        for one in face.sliders
        if one.channels and one.shapes and all(name.startswith(_LOOKS) for name, _ in one.shapes)
    ]
    points, seen, camera = pupil_points(face.parts()), view.pupils, view.camera
    if seen is None or not sliders or len(points) != 2:
        return {}
    rest = np.array([slider.default for slider in sliders])
    lower, upper = (np.array([getattr(slider, name) for slider in sliders]) for name in ("minimum", "maximum"))
    names, eyes = [slider.name for slider in sliders], face.rig().part(points)

    def residuals(at: FloatArray) -> FloatArray:
        looking = dict(values) | dict(zip(names, at.tolist(), strict=True))
        coefficients, driven = slide(face.sliders, face.skeleton.joints, looking, face.slider_network)
        weights = {shape: driven.get(shape, 0.0) + view.expressions.get(shape, 0.0) for shape in face.shapes}
        pupils = eyes.evaluate(weights, coefficients=coefficients)
        local = Rotation.from_rotvec(camera.rotation).apply(pupils) + camera.translation
        marks = np.asarray(camera.focal * local[:, :2] * (1, -1) / -local[:, 2:] + camera.center)
        return np.append((marks - seen[:, :2]) / seen[:, 2:], (at - rest) / _USUAL)

    found = rest
    for _ in range(_ROUNDS):
        steps = [np.where(np.arange(len(found)) == i, _STEP, 0.0) for i in range(len(found))]
        slopes = [(residuals(found + step) - residuals(found - step)) / (2 * _STEP) for step in steps]
        change = np.linalg.lstsq(np.stack(slopes, axis=1), -residuals(found), rcond=None)[0]
        # a step inside the range: beyond its end the central difference would halve the slope
        found = np.clip(found + change, lower + _STEP, upper - _STEP)
    return dict(zip(names, found.tolist(), strict=True))


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
        arrays: dict[str, tuple[Any, tuple[int, ...]]] = {
            "camera -> rotation": (view.camera.rotation, (3,)),
            "camera -> translation": (view.camera.translation, (3,)),
            "camera -> center": (view.camera.center, (2,)),
            "light": (view.light, (9, 3)),
            "key": (view.key, (8,)),
            "landmarks": (view.landmarks, (68, 2)),
            "targets": (view.targets, (68, 2)),
            "pupils": (np.zeros((2, 3)) if view.pupils is None else view.pupils, (2, 3)),
        }
        for name, (array, expected) in arrays.items():
            if np.shape(array) != expected:
                raise InputError(f"{where} -> {name}", f"shape {np.shape(array)}, expected {expected}")
        if not view.camera.focal > 0:
            raise InputError(f"{where} -> camera", f"focal length {view.camera.focal:g}, expected more than 0")
        if view.landmark_error < 0:
            raise InputError(f"{where} -> landmark_error", f"{view.landmark_error:g}, expected 0 or more")
        if not np.any(view.key[:3]):
            raise InputError(f"{where} -> key", "direction 0, expected that to the lamp")
        if np.min(view.key[3:6]) < 0:
            raise InputError(f"{where} -> key", f"colour {tuple(map(float, view.key[3:6]))}, expected 0 or more")
        if view.key[6] < 0:
            raise InputError(f"{where} -> key", f"shine {view.key[6]:g}, expected 0 or more")
        for name, weight in view.expressions.items():
            if name not in face.shapes:
                raise InputError(f"{where} -> {name}", f"no such shape{suggestion(name, face.shapes)}")
            if not 0 <= weight <= 1:
                raise InputError(f"{where} -> {name}", f"weight {weight:g}, expected 0 to 1")
    known = [material.name for material in face.materials]
    for name, tint in fit.tint.items():
        if name and name not in known:  # "" are surfaces without a material
            raise InputError(f"{face.where} -> tint {name}", f"no such material{suggestion(name, known)}")
        if np.shape(tint) != (3,) or not min(tint) >= 0:
            raise InputError(f"{face.where} -> tint {name}", f"{tint}, expected 3 factors of 0 or more")


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

    >>> with facepipe.open("head.usdc").deriving("person.usdc") as face:
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
        kept = tuple(animation for animation in changed.animations if animation.name not in gone)
        changed = replace(changed, animations=kept, photos=())
        # names for poses and cameras of the photos that nothing else on the stage has
        taken = {animation.name for animation in changed.animations}
        removed = {animation.name for animation in face.animations} | {photo.name for photo in face.photos}
        for scope in (tokens.ANIMATIONS_SCOPE, tokens.PHOTOS_SCOPE):
            folder = face.prim.GetChild(scope)
            taken |= {str(one.GetName()) for one in folder.GetChildren()} - removed if folder else set()
        wanted = [*sorted(taken), *(Path(photo.name).stem for photo in photos)]
        names = unique_identifiers(wanted, "photo")[len(taken) :]
        neutral = next(animation for animation in changed.animations if animation.name == self.name)
        person = face.with_identity(values)
        points = person.evaluate(sliders=values)
        views = tuple(_view(face, *one, fit, points) for one in zip(names, photos, fit.views, strict=True))
        poses = [
            _pose(changed, gaze(person, values, view), neutral, name, view)
            for name, view in zip(names, fit.views, strict=True)
        ]
        animations = (*changed.animations, *poses)
        result = replace(changed, animations=animations, photos=views, recipe=recipe or changed.recipe)
        authored = author_changes(face, result)
        play(face, self.name)
        reports: dict[str, PhotoReport] = {}
        for photo, one, view in zip(photos, views, fit.views, strict=True):
            reports[photo.name if photo.name not in reports else one.name] = PhotoReport(
                animation=one.name,
                size=(one.width, one.height),
                expressions={shape: float(view.expressions[shape]) for shape in sorted(view.expressions)},
                landmark_error_px=one.landmark_error,
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
            authored=authored,
            warnings=(*fit.warnings, *posed.warnings, *_warnings(changed.sliders, fit)),
        )


def _warnings(sliders: Sequence[Slider], fit: PhotoFit) -> list[str]:
    """Lines where sliders off their defaults drive shapes that photos have as expressions too, and of an early end."""
    expressions, warnings = {name for view in fit.views for name in view.expressions}, []
    mixed = [
        slider.name
        for slider in sliders
        if slider.value not in (None, slider.default) and any(shape in expressions for shape, _ in slider.shapes)
    ]
    if mixed:
        some = ", ".join(mixed[:_MOST_NAMES]) + (f" ... ({len(mixed)} in all)" if len(mixed) > _MOST_NAMES else "")
        what = f"{some} drive shapes that are fitted as expressions too"
        warnings.append(f"the neutral is not free of expression: {what}")
    if fit.stopped == "not-finite":
        warnings.append(f"the loss was not finite after {fit.steps} steps: this is the best until then")
    return warnings


def _pose(parts: FaceParts, looks: Mapping[str, float], neutral: Animation, name: str, view: FittedView) -> Animation:
    """The neutral with eyes, not lids, turned by sliders `looks`, and with a photo's expression on it."""
    if looks:
        turned = [
            replace(slider, value=looks[slider.name], shapes=(), shape_curves=()) if slider.name in looks else slider
            for slider in parts.sliders
        ]
        neutral = pose(parts, turned, neutral.name)
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
    key, lamp = np.asarray(view.key, dtype=np.float64), None
    with np.errstate(over="ignore", under="ignore"):  # the stage refuses infinity
        black, exponent = not np.float32(key[3:6]).any(), float(np.exp(key[7]))
    if not black:  # in float32, as the stage holds it
        *direction, red, green, blue = map(float, key[:6])
        lamp = KeyLamp(
            direction=(direction[0], direction[1], direction[2]),
            color=(red, green, blue),
            shine=float(key[6]),
            exponent=exponent,
        )
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
        key=lamp,
        tint={material: (float(r), float(g), float(b)) for material, (r, g, b) in fit.tint.items()},
        landmark_error=float(view.landmark_error),
        animation=name,
    )


def loss_ends(history: Sequence[Mapping[str, float]]) -> dict[str, Loss]:
    """First and last value of each term, by name; steps with a loss that is not finite don't count."""
    ends: dict[str, Loss] = {}
    for step in history:
        if np.isfinite([float(one) for one in step.values()]).all():
            for name, value in step.items():
                first = ends[name].first if name in ends else float(value)
                ends[name] = Loss(first=first, last=float(value))
    return {name: ends[name] for name in sorted(ends)}
