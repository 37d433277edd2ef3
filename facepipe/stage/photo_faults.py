"""What a photo of a face must be, wherever it is authored or read."""

from __future__ import annotations

from itertools import chain

import numpy as np

from facepipe.parts import KeyLamp, PhotoView

MOST_PIXELS = 1 << 20  # a side
LIGHT_ROWS = 9  # spherical harmonics up to the second order


def photo_fault(photo: PhotoView) -> str | None:
    """What is wrong with a photo in float32, which files hold: what was found and expected; None where it is whole."""
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
