"""Photos of a face, and the cameras that see it as they do, as parts."""

from __future__ import annotations

from typing import Any

from pxr import Usd, UsdGeom

from facepipe.core import tokens
from facepipe.core.errors import SchemaError
from facepipe.parts import KeyLamp, PhotoView
from facepipe.stage.api_schemas import is_applied
from facepipe.stage.film import Film, from_film
from facepipe.stage.guard import reads_prim
from facepipe.stage.photo_faults import photo_fault
from facepipe.stage.values import floats, matrix


def is_photo(prim: Usd.Prim) -> bool:
    """Whether a prim is the camera of a photo."""
    return bool(prim.IsA(UsdGeom.Camera)) and is_applied(prim, tokens.PHOTO_API)


@reads_prim
def read_photo(prim: Usd.Prim) -> PhotoView:
    """A Camera prim with FacepipePhotoAPI.

    :raises SchemaError: sizes, apertures, light or tints that are none
    """
    where, camera = str(prim.GetPath()), UsdGeom.Camera(prim)

    def value(name: str) -> Any:
        return prim.GetAttribute(name).Get()

    width, height = (int(one) for one in value(tokens.PHOTO_SIZE) or (0, 0))
    film = Film(
        *(
            float(attribute.Get())
            for attribute in (
                camera.GetFocalLengthAttr(),
                camera.GetHorizontalApertureAttr(),
                camera.GetVerticalApertureAttr(),
                camera.GetHorizontalApertureOffsetAttr(),
                camera.GetVerticalApertureOffsetAttr(),
            )
        )
    )
    if not min(width, height, film.horizontal_aperture, film.vertical_aperture) > 0:
        raise SchemaError(where, f"{width} x {height} pixels, or no aperture, expected both above 0")
    materials, tints = list(value(tokens.PHOTO_TINTED_MATERIALS) or []), floats(value(tokens.PHOTO_TINTS), 3).tolist()
    if len(materials) != len(tints):
        raise SchemaError(f"{where}.{tokens.PHOTO_TINTS}", f"{len(tints)} tints of {len(materials)} materials")
    focal, center = from_film(film, width, height)
    near, far = camera.GetClippingRangeAttr().Get()
    photo = PhotoView(
        name=str(prim.GetName()),
        image=str(value(tokens.PHOTO_IMAGE) or ""),
        width=width,
        height=height,
        transform=matrix(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())),
        focal=focal,
        center=center,
        clipping=(float(near), float(far)),
        light=floats(value(tokens.PHOTO_LIGHT), 3),
        key=read_key_lamp(prim),
        tint={str(name): (tint[0], tint[1], tint[2]) for name, tint in zip(materials, tints, strict=True)},
        landmark_error=float(value(tokens.PHOTO_LANDMARK_ERROR) or 0.0),
        animation=str(value(tokens.PHOTO_ANIMATION) or "") or None,
    )
    fault = photo_fault(photo)
    if fault:
        raise SchemaError(where, fault)
    return photo


def read_key_lamp(prim: Usd.Prim) -> KeyLamp | None:
    """The lamp of a photo, whatever its numbers are; None: it has none, or a black one."""

    def numbers(name: str, *otherwise: float) -> list[float]:
        found = prim.GetAttribute(name).Get()
        return [float(one) for one in floats(otherwise if found is None else found)]

    color = numbers(tokens.PHOTO_KEY_COLOR, 0, 0, 0)
    if not any(color):
        return None
    (red, green, blue), (x, y, z) = color, numbers(tokens.PHOTO_KEY_DIRECTION, 0, 0, 1)
    (shine,), (exponent,) = numbers(tokens.PHOTO_KEY_SHINE, 0), numbers(tokens.PHOTO_KEY_EXPONENT, 20)
    return KeyLamp(direction=(x, y, z), color=(red, green, blue), shine=shine, exponent=exponent)
