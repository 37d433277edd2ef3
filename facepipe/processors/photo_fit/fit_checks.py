"""What a fit must be to be authored on a face."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray, require_finite
from facepipe.core.errors import InputError
from facepipe.core.names import suggestion
from facepipe.parts import Slider
from facepipe.stage import Face

if TYPE_CHECKING:
    from facepipe.learn.photo.result import FittedView, PhotoFit
    from facepipe.processors.photo_fit.photo_file import Photo

_SHOWN = 4  # names of a list


def check_fit(face: Face, fit: PhotoFit, photos: Sequence[Photo]) -> None:
    """Check all of a fit but its slider values, which `SetSliders` checks, and its history.

    :raises InputError: NaN or infinity, another number of photos than views, shapes or materials that the face has not,
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
    known = [one.name for one in face.materials]
    for name, tint in fit.tint.items():
        if name and name not in known:  # "" are surfaces without a material
            raise InputError(f"{face.where} -> tint {name}", f"no such material{suggestion(name, known)}")
        if np.shape(tint) != (3,) or not min(tint) >= 0:
            raise InputError(f"{face.where} -> tint {name}", f"{tint}, expected 3 factors of 0 or more")


def mixed_sliders(sliders: Sequence[Slider], views: Sequence[FittedView]) -> tuple[str, ...]:
    """A line where sliders off their defaults drive shapes that are expressions of a photo too."""
    expressions = {name for view in views for name in view.expressions}
    mixed = [
        one.name
        for one in sliders
        if one.value not in (None, one.default) and any(shape in expressions for shape, _ in one.shapes)
    ]
    if not mixed:
        return ()
    return (f"the neutral is not free of expression: {_some(mixed)} drive shapes that are fitted as expressions too",)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (f" ... ({len(names)} in all)" if len(names) > _SHOWN else "") or "none"
