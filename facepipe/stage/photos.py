"""Photos of a face, and the cameras that see it as they do: read, checked and authored."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np
from pxr import Gf, Usd, UsdGeom

from facepipe.core import tokens
from facepipe.core.errors import InputError, SchemaError
from facepipe.parts import KeyLamp, PhotoView
from facepipe.stage.prims import apply_schema, editable, free_path, is_applied, put, put_value
from facepipe.stage.values import floats, matrix, reads_prim, same, to_matrix, to_vec3f

MOST_PIXELS = 1 << 20  # a side
LIGHT_ROWS = 9  # spherical harmonics up to the second order
_FILM_METRES = 0.036  # metres of the longer side: that of a 35 mm camera
_TENTHS_A_UNIT = 10.0  # UsdGeom.Camera has focal length and apertures in tenths of a stage unit
_FILM = (
    *("focalLength", "horizontalAperture", "verticalAperture"),
    *("horizontalApertureOffset", "verticalApertureOffset"),
)


def check_photos(where: object, photos: Sequence[PhotoView]) -> None:
    """:raises InputError: a photo that a stage can't hold, or two of one name"""
    names = [photo.name for photo in photos]
    for photo in photos:
        fault = "two of one name" if names.count(photo.name) > 1 else _photo_fault(photo)
        if fault:
            raise InputError(f"{where} -> photo {photo.name}", fault)


def author_photo_changes(
    face: Usd.Prim, prims: Sequence[Usd.Prim], old: Sequence[PhotoView], new: Sequence[PhotoView]
) -> tuple[str, ...]:
    """Author on a face what of its photos differs, matched by name; one line each.

    Cameras of photos that are gone are deactivated.

    :param prims: what `old` was read from
    """
    present = {photo.name: (prim, photo) for prim, photo in zip(prims, old, strict=True)}
    lines = []
    for photo in new:
        prim, before = present.pop(photo.name, (None, None))
        if same(before, photo):
            continue
        if prim is None:
            path = free_path(face, tokens.PHOTOS_SCOPE, photo.name)
            prim = UsdGeom.Camera.Define(face.GetStage(), path).GetPrim()
        _write(UsdGeom.Camera(editable(prim)), photo)
        lines.append(f"{photo.name}: camera {'added' if before is None else 'changed'}")
    for name, (prim, _) in present.items():
        # inactive, as the camera may be in a weaker layer, which this one cannot take it from
        editable(prim).SetActive(False)
        lines.append(f"{name}: camera removed")
    return tuple(lines)


def _write(camera: UsdGeom.Camera, photo: PhotoView) -> None:
    prim = camera.GetPrim()
    above = matrix(UsdGeom.XformCache().GetParentToWorldTransform(prim))
    if not abs(np.linalg.det(above)) > 0:
        raise InputError(camera.GetPath(), "stands below a transform that can't be inverted")
    place = camera.MakeMatrixXform().GetAttr()
    put(place, to_matrix(np.linalg.inv(above) @ np.asarray(photo.transform, dtype=np.float64)))
    # a pixel is a power of two of tenths of a unit, so that float32 holds its multiples as exactly as it holds pixels;
    # the longer side comes to 25 to 51 mm
    film = _FILM_METRES / UsdGeom.GetStageMetersPerUnit(prim.GetStage()) * _TENTHS_A_UNIT
    pixel = 2.0 ** round(math.log2(film / max(photo.width, photo.height)))
    put(camera.CreateProjectionAttr(), UsdGeom.Tokens.perspective)
    offsets = (photo.width / 2 - photo.center[0], photo.center[1] - photo.height / 2)
    for name, pixels in zip(_FILM, (photo.focal, photo.width, photo.height, *offsets), strict=True):
        put(prim.GetAttribute(name), pixels * pixel)
    put(camera.CreateClippingRangeAttr(), Gf.Vec2f(*photo.clipping))
    apply_schema(prim, tokens.PHOTO_API)
    names, key = sorted(photo.tint), photo.key
    for name, value in (
        (tokens.PHOTO_IMAGE, photo.image),
        (tokens.PHOTO_SIZE, Gf.Vec2i(photo.width, photo.height)),
        (tokens.PHOTO_ANIMATION, photo.animation or ""),
        (tokens.PHOTO_LANDMARK_ERROR, photo.landmark_error),
        (tokens.PHOTO_LIGHT, to_vec3f(photo.light)),
        (tokens.PHOTO_KEY_DIRECTION, key and Gf.Vec3f(*map(float, key.direction))),
        (tokens.PHOTO_KEY_COLOR, key and Gf.Vec3f(*map(float, key.color))),
        (tokens.PHOTO_KEY_SHINE, key and float(key.shine)),
        (tokens.PHOTO_KEY_EXPONENT, key and float(key.exponent)),
        (tokens.PHOTO_TINTED_MATERIALS, names or None),
        (tokens.PHOTO_TINTS, to_vec3f(np.array([photo.tint[material] for material in names])) if names else None),
    ):
        put_value(prim, name, value)


def _photo_fault(photo: PhotoView) -> str | None:
    """What is wrong with a photo whose numbers are float32, as in files: found and expected; None where nothing is."""
    if not all(1 <= side <= MOST_PIXELS for side in (photo.width, photo.height)):
        return f"{photo.width} x {photo.height} pixels, expected 1 to {MOST_PIXELS} each"
    for name, values, shape in (("transform", photo.transform, (4, 4)), ("light", photo.light, (LIGHT_ROWS, 3))):
        if np.shape(values) != shape:
            return f"{name} {np.shape(values)}, expected {shape}"
    numbers = chain((photo.focal, *photo.center, *photo.clipping, photo.landmark_error), *photo.tint.values())
    with np.errstate(over="ignore"):  # beyond float32 is infinity
        single = np.array([*numbers, *np.ravel(photo.light)], dtype=np.float32)
    if not (np.isfinite(single).all() and np.isfinite(photo.transform).all()):
        return "NaN, infinity or beyond float32, expected finite numbers"
    if not abs(np.linalg.det(np.asarray(photo.transform, dtype=np.float64)[:3, :3])) > 0:
        return "a flat camera, expected a transform that can be inverted"
    if not np.float32(photo.focal) > 0:
        return f"focal length {photo.focal:g}, expected more than 0"
    near, far = photo.clipping
    if not 0 < np.float32(near) < np.float32(far):
        return f"clipping range {near:g} to {far:g}, expected 0 < near < far"
    if photo.landmark_error < 0:
        return f"landmark error {photo.landmark_error:g}, expected 0 or more"
    dark = [name for name, tint in photo.tint.items() if min(tint) < 0]
    if dark:
        return f"a negative tint of '{dark[0]}', expected 0 or more"
    return None if photo.key is None else key_fault(photo.key)


def key_fault(key: KeyLamp) -> str | None:
    """What is wrong with the lamp of a photo, in float32."""
    if len(key.direction) != 3 or len(key.color) != 3:
        return f"key light of {len(key.direction)} and {len(key.color)} numbers, expected 3 of direction and of colour"
    with np.errstate(over="ignore"):
        single = np.array([*key.direction, *key.color, key.shine, key.exponent], dtype=np.float32)
    if not np.isfinite(single).all():
        return "key light with NaN, infinity or beyond float32, expected finite numbers"
    direction, color, (shine, exponent) = np.split(single, (3, 6))
    if not direction.any():
        return "key light without direction, expected that to the lamp"
    if color.min() < 0 or not color.any():
        return f"key light of colour {tuple(map(float, key.color))}, expected 0 or more, and some light"
    if shine < 0:
        return f"key light with shine {key.shine:g}, expected 0 or more"
    return None if exponent > 0 else f"key light with exponent {key.exponent:g}, expected more than 0"


def is_photo(prim: Usd.Prim) -> bool:
    """Whether a prim is the camera of a photo."""
    return bool(prim.IsA(UsdGeom.Camera)) and is_applied(prim, tokens.PHOTO_API)


@reads_prim
def read_photo(prim: Usd.Prim) -> PhotoView:
    """A Camera prim with FacepipePhotoAPI.

    :raises SchemaError: invalid sizes, apertures, light or tints
    """
    where = str(prim.GetPath())

    def value(name: str) -> Any:
        return prim.GetAttribute(name).Get()

    width, height = (int(side) for side in value(tokens.PHOTO_SIZE) or (0, 0))
    focal, wide, high, aside, above = (float(value(name)) for name in _FILM)
    if not min(width, height, wide, high) > 0:
        raise SchemaError(where, f"{width} x {height} pixels, or no aperture, expected both above 0")
    materials, tints = list(value(tokens.PHOTO_TINTED_MATERIALS) or []), floats(value(tokens.PHOTO_TINTS), 3).tolist()
    if len(materials) != len(tints):
        raise SchemaError(f"{where}.{tokens.PHOTO_TINTS}", f"{len(tints)} tints of {len(materials)} materials")
    # focal length and principal point in pixels, y down, of a film that `width` by `height` pixels cover. Pixels are as
    # wide as high, as the width says.
    across, up = wide / width, high / height
    center = (width / 2 - aside / across, height / 2 + above / up)
    near, far = UsdGeom.Camera(prim).GetClippingRangeAttr().Get()
    photo = PhotoView(
        name=str(prim.GetName()),
        image=str(value(tokens.PHOTO_IMAGE) or ""),
        width=width,
        height=height,
        transform=matrix(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())),
        focal=focal / across,
        center=center,
        clipping=(float(near), float(far)),
        light=floats(value(tokens.PHOTO_LIGHT), 3),
        key=read_key_lamp(prim),
        tint={str(name): (tint[0], tint[1], tint[2]) for name, tint in zip(materials, tints, strict=True)},
        landmark_error=float(value(tokens.PHOTO_LANDMARK_ERROR) or 0.0),
        animation=str(value(tokens.PHOTO_ANIMATION) or "") or None,
    )
    fault = _photo_fault(photo)
    if fault:
        raise SchemaError(where, fault)
    return photo


def read_key_lamp(prim: Usd.Prim) -> KeyLamp | None:
    """The lamp of a photo, whatever its numbers are; None: it has none, or a black one."""

    def numbers(name: str, *otherwise: float) -> list[float]:
        found = prim.GetAttribute(name).Get()
        return [float(number) for number in floats(otherwise if found is None else found)]

    color = numbers(tokens.PHOTO_KEY_COLOR, 0, 0, 0)
    if not any(color):
        return None
    (red, green, blue), (x, y, z) = color, numbers(tokens.PHOTO_KEY_DIRECTION, 0, 0, 1)
    (shine,), (exponent,) = numbers(tokens.PHOTO_KEY_SHINE, 0), numbers(tokens.PHOTO_KEY_EXPONENT, 20)
    return KeyLamp(direction=(x, y, z), color=(red, green, blue), shine=shine, exponent=exponent)
