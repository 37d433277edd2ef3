"""Photos authored as cameras below a face, and changes of those that a face has."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pxr import Gf, Usd, UsdGeom

from facepipe.core import tokens
from facepipe.core.errors import InputError
from facepipe.parts import PhotoView
from facepipe.stage.api_schemas import apply_schema, put, put_value
from facepipe.stage.differences import same
from facepipe.stage.film import to_film
from facepipe.stage.opinions import editable, free_path
from facepipe.stage.photo_faults import photo_fault
from facepipe.stage.values import matrix, to_matrix, to_vec3f


def check_photos(where: object, photos: Sequence[PhotoView]) -> None:
    """:raises InputError: a photo that a stage can't hold, or two of one name"""
    names = [photo.name for photo in photos]
    for photo in photos:
        fault = "two of one name" if names.count(photo.name) > 1 else photo_fault(photo)
        if fault:
            raise InputError(f"{where} -> photo {photo.name}", fault)


def author_photo_changes(
    face: Usd.Prim, prims: Sequence[Usd.Prim], old: Sequence[PhotoView], new: Sequence[PhotoView]
) -> tuple[str, ...]:
    """Author on a face what of its photos differs, matched by name; one line each.

    Cameras of photos that are gone are deactivated.

    :param prims: what `old` was read from
    """
    there = {photo.name: (prim, photo) for prim, photo in zip(prims, old, strict=True)}
    lines = []
    for photo in new:
        prim, before = there.pop(photo.name, (None, None))
        if same(before, photo):
            continue
        if prim is None:
            path = free_path(face, tokens.PHOTOS_SCOPE, photo.name)
            prim = UsdGeom.Camera.Define(face.GetStage(), path).GetPrim()
        _write(UsdGeom.Camera(editable(prim)), photo)
        lines.append(f"{photo.name}: camera {'added' if before is None else 'changed'}")
    for name, (prim, _) in there.items():
        editable(prim).SetActive(False)
        lines.append(f"{name}: camera removed")
    return tuple(lines)


def _write(camera: UsdGeom.Camera, photo: PhotoView) -> None:
    stage = camera.GetPrim().GetStage()
    above = matrix(UsdGeom.XformCache().GetParentToWorldTransform(camera.GetPrim()))
    if not abs(np.linalg.det(above)) > 0:
        raise InputError(camera.GetPath(), "stands below a transform that can't be inverted")
    place = camera.MakeMatrixXform().GetAttr()
    put(place, to_matrix(np.linalg.inv(above) @ np.asarray(photo.transform, dtype=np.float64)))
    film = to_film(photo.width, photo.height, photo.focal, photo.center, UsdGeom.GetStageMetersPerUnit(stage))
    for attribute, value in (
        (camera.CreateProjectionAttr(), UsdGeom.Tokens.perspective),
        (camera.CreateFocalLengthAttr(), film.focal_length),
        (camera.CreateHorizontalApertureAttr(), film.horizontal_aperture),
        (camera.CreateVerticalApertureAttr(), film.vertical_aperture),
        (camera.CreateHorizontalApertureOffsetAttr(), film.horizontal_offset),
        (camera.CreateVerticalApertureOffsetAttr(), film.vertical_offset),
        (camera.CreateClippingRangeAttr(), Gf.Vec2f(*photo.clipping)),
    ):
        put(attribute, value)
    _write_photo(camera.GetPrim(), photo)


def _write_photo(prim: Usd.Prim, photo: PhotoView) -> None:
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
        (tokens.PHOTO_TINTS, to_vec3f(np.array([photo.tint[one] for one in names])) if names else None),
    ):
        put_value(prim, name, value)
