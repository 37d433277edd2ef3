"""Checks of the cameras of photos."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pxr import Usd, UsdGeom

from facepipe.checks.views import FaceView, Problem, array, at, length, numbers, value, words
from facepipe.core import tokens
from facepipe.stage.guard import UNREADABLE
from facepipe.stage.photos import LIGHT_ROWS, MOST_PIXELS, is_photo, key_fault, read_key_lamp
from facepipe.stage.prims import exact_name

_STRETCHED = 1e-4  # of a pixel's width


def photo_cameras(face: FaceView) -> Iterator[Problem]:
    """The camera of a photo is a perspective one with a clipping range, its apertures those of square pixels."""
    for prim in _photos(face):
        camera = UsdGeom.Camera(prim)
        authored = value(prim.GetAttribute(tokens.PHOTO_SIZE))
        size = array(authored)
        if size is None or len(size) != 2 or not ((size >= 1) & (size <= MOST_PIXELS)).all():
            yield at(f"{prim.GetPath()}.{tokens.PHOTO_SIZE}", f"{authored}, expected 1 to {MOST_PIXELS} pixels each")
            continue
        across, up = _number(camera.GetHorizontalApertureAttr()), _number(camera.GetVerticalApertureAttr())
        near, far = _pair(camera.GetClippingRangeAttr())
        if value(camera.GetProjectionAttr()) != UsdGeom.Tokens.perspective:
            yield at(prim, f"projection {value(camera.GetProjectionAttr())}, expected perspective")
        elif not (across > 0 and up > 0 and _number(camera.GetFocalLengthAttr()) > 0):
            yield at(prim, "no focal length or aperture, expected all above 0")
        elif not 0 < near < far:
            yield at(prim, f"clippingRange {near:g} to {far:g}, expected 0 < near < far")
        elif not abs(up / size[1] * size[0] / across - 1) < _STRETCHED:
            yield at(prim, f"apertures {across:g} x {up:g} of {size[0]:g} x {size[1]:g} pixels, expected square pixels")


def photo_light(face: FaceView) -> Iterator[Problem]:
    """A photo has the light of nine spherical harmonics, and a tint of 0 or more for each material that it names."""
    for prim in _photos(face):
        light = numbers(prim.GetAttribute(tokens.PHOTO_LIGHT), 3)
        if length(light) != LIGHT_ROWS:
            yield at(f"{prim.GetPath()}.{tokens.PHOTO_LIGHT}", f"{length(light)} rows, expected {LIGHT_ROWS}")
        tints = numbers(prim.GetAttribute(tokens.PHOTO_TINTS), 3)
        materials = words(prim.GetAttribute(tokens.PHOTO_TINTED_MATERIALS))
        if length(tints) != len(materials):
            yield at(f"{prim.GetPath()}.{tokens.PHOTO_TINTS}", f"{length(tints)} tints, expected {len(materials)}")
        elif tints is not None and (tints < 0).any():
            yield at(f"{prim.GetPath()}.{tokens.PHOTO_TINTS}", "below 0, expected factors of 0 or more")


def photo_key(face: FaceView) -> Iterator[Problem]:
    """The key light of a photo has a direction, light of 0 or more, and a shine whose exponent is above 0."""
    for prim in _photos(face):
        try:
            key = read_key_lamp(prim)
        except (*UNREADABLE, RuntimeError):
            yield at(prim, "key light that can't be read, expected vectors and numbers as FacepipePhotoAPI says")
            continue
        if key is None or not np.isfinite([*key.direction, *key.color, key.shine, key.exponent]).all():
            continue  # the check of finite numbers reports it
        fault = key_fault(key)
        if fault:
            yield at(prim, fault)


def photo_poses(face: FaceView) -> Iterator[Problem]:
    """The pose that a photo names is an animation of the face."""
    known = {exact_name(animation.GetPrim()) for animation in face.animations}
    for prim in _photos(face):
        name = str(value(prim.GetAttribute(tokens.PHOTO_ANIMATION)) or "")
        if name and name not in known:
            yield at(f"{prim.GetPath()}.{tokens.PHOTO_ANIMATION}", f"'{name}' is no animation of the face")


def _photos(face: FaceView) -> Iterator[Usd.Prim]:
    return (prim for prim in face.of_type(UsdGeom.Camera) if is_photo(prim))


def _pair(attribute: Usd.Attribute) -> tuple[float, float]:
    found = array(value(attribute))
    return (float(found[0]), float(found[1])) if found is not None and len(found) == 2 else (0.0, 0.0)


def _number(attribute: Usd.Attribute) -> float:
    found = array([value(attribute)])
    return float(found[0]) if found is not None and len(found) else 0.0
