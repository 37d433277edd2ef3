"""Names of shapes that mean the same: in any case, with sides in any usual form."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

_SIDES = {"l": "left", "r": "right"}
_APART = re.compile(r"^(.+?)[ _.\-]+([lrLR])$")  # eyeBlink_L, eyeBlink.R
_TOGETHER = re.compile(r"^(.*[a-z])([LR])$")  # eyeBlinkL

# what a performance says of turns: key -> name
ANGLES: Mapping[str, str] = {
    f"{part}{angle}".lower(): f"{part}{angle}"
    for part in ("Head", "LeftEye", "RightEye")
    for angle in ("Yaw", "Pitch", "Roll")
}


def shape_key(name: str) -> str:
    """What names of one meaning share.

    >>> shape_key("EyeBlinkLeft"), shape_key("eyeBlink_L"), shape_key("eye blink L")
    ('eyeblinkleft', 'eyeblinkleft', 'eyeblinkleft')
    """
    name = name.rpartition(":")[2].strip()
    match = _APART.match(name) or _TOGETHER.match(name)
    if match:
        name = match.group(1) + _SIDES[match.group(2).lower()]
    return re.sub(r"[\s_.\-]+", "", name).casefold()


def matched(names: Sequence[str], shapes: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The shapes that each name means: the same, one of its meaning, or its left and right one; none for others."""
    by_key: dict[str, str] = {}
    for shape in shapes:
        by_key.setdefault(shape_key(shape), shape)
    return {name: _meant(name, shapes, by_key) for name in names}


def _meant(name: str, shapes: Sequence[str], by_key: Mapping[str, str]) -> tuple[str, ...]:
    if name in shapes:
        return (name,)
    key = shape_key(name)
    if key in by_key:
        return (by_key[key],)
    sides = tuple(by_key[key + side] for side in _SIDES.values() if key + side in by_key)
    return sides if len(sides) == len(_SIDES) else ()
