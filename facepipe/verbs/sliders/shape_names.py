"""What names of blendshapes say: which two are the ends of one slider, what it is called, and which is its mirror.

Words are set off by ``_``, ``-``, ``.`` or blanks. Two shapes whose names differ in the last word alone, by the words
of a pair (``nose_hump_decr``, ``nose_hump_incr``), are the ends of a slider from -1 to 1, ``noseHump``; any other shape
is one from 0 to 1. A word ``l``, ``r``, ``left`` or ``right`` is the side, and goes to the end of the name:
``l_eye_bag_in`` and ``_out`` make ``eyeBagLeft``. Where a name without its pair's word is that of another slider too
(``nose_trans_up``, ``nose_trans_out``), the second word of the pair joins it: ``noseTransUp``, ``noseTransOut``. The
group is the first word.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from facepipe.core.errors import InputError
from facepipe.core.names import mirrored_name, unique_identifiers

PAIRS = "decr:incr,down:up,in:out,backward:forward,concave:convex,compress:uncompress"

_SIDES = {"l": "Left", "left": "Left", "r": "Right", "right": "Right"}
_BREAKS = re.compile(r"[_\-.\s]+")
_FIRST = re.compile(r"[A-Z]+(?![a-z])|[A-Za-z][a-z]*")


@dataclass(frozen=True, kw_only=True)
class ShapeSlider:
    """A slider to make of one shape or two."""

    name: str
    group: str
    ends: tuple[tuple[float, str], ...]  # slider value -> shape: 1, or -1 and 1
    mirror: str | None = None

    @property
    def minimum(self) -> float:
        """-1 with two ends, 0 with one."""
        return min(0.0, self.ends[0][0])


class _Words(NamedTuple):
    """A shape's name in words."""

    side: str  # Left, Right, or nothing
    stem: tuple[str, ...]  # what is neither side nor a pair's word
    end: str  # the pair's word, in small letters


def parse_pairs(text: str) -> tuple[tuple[str, str], ...]:
    """``decr:incr,down:up`` as pairs of words in small letters, that of the lower end first; "" is none.

    :raises InputError: a pair that is not so, or a word twice
    """
    pairs = []
    for item in filter(None, (part.strip() for part in text.split(","))):
        low, colon, high = (part.strip().lower() for part in item.partition(":"))
        if not (low and colon and high) or _BREAKS.search(low + high) or ":" in high:
            raise InputError("option pairs", f"'{item[:40]}', expected two words like decr:incr")
        pairs.append((low, high))
    words = Counter(word for pair in pairs for word in pair)
    twice = [word for word, count in words.items() if count > 1]
    if twice:
        raise InputError("option pairs", f"'{twice[0][:40]}' is there {words[twice[0]]} times, expected each word once")
    return tuple(pairs)


def shape_sliders(shapes: Sequence[str], pairs: Sequence[tuple[str, str]]) -> tuple[ShapeSlider, ...]:
    """The sliders that shapes make, in the order of their first shapes.

    >>> [one.name for one in shape_sliders(("nose_hump_decr", "nose_hump_incr", "l_lid_up"), parse_pairs(PAIRS))]
    ['noseHump', 'lidUpLeft']
    """
    ends = _ends(shapes, pairs)
    words = [_words(own[-1][1], pairs if len(own) == 2 else ()) for own in ends]
    stems = Counter(_joined(word.stem, word.side).lower() for word in words)
    names = [
        _joined((*word.stem, word.end) if stems[_joined(word.stem, word.side).lower()] > 1 else word.stem, word.side)
        for word in words
    ]
    made = [
        ShapeSlider(name=name, group=_group(one), ends=own)
        for name, one, own in zip(unique_identifiers(names), words, ends, strict=True)
    ]
    return _with_mirrors(made)


def _ends(shapes: Sequence[str], pairs: Sequence[tuple[str, str]]) -> list[tuple[tuple[float, str], ...]]:
    """The ends of each slider."""
    words = {shape: _words(shape, pairs) for shape in shapes}
    named = {(one.side, one.stem, one.end): shape for shape, one in reversed(words.items()) if one.end}
    lows = {high: low for low, high in pairs}
    upper: dict[str, str] = {}  # shape of the lower end -> that of the upper one
    for (side, stem, end), shape in named.items():
        low = named.get((side, stem, lows.get(end, "")))
        if low is not None:
            upper[low] = shape
    highs, ends = {high: low for low, high in upper.items()}, {}
    for shape in shapes:
        low = highs.get(shape, shape)
        ends[low] = ((-1.0, low), (1.0, upper[low])) if low in upper else ((1.0, low),)
    return list(ends.values())


def _words(shape: str, pairs: Sequence[tuple[str, str]]) -> _Words:
    words = [word for word in _BREAKS.split(shape) if word]
    sides = [number for number, word in enumerate(words) if word.lower() in _SIDES]
    side = ""
    if len(sides) == 1 and len(words) > 1:
        side = _SIDES[words.pop(sides[0]).lower()]
    known = {word for pair in pairs for word in pair}
    end = words.pop().lower() if len(words) > 1 and words[-1].lower() in known else ""
    return _Words(side, tuple(words), end)


def _joined(words: Sequence[str], side: str) -> str:
    """Words in lowerCamelCase, the side last."""
    text = "".join(word[0].upper() + word[1:] for word in words if word)
    keep = len(words[0]) > 1 and words[0][:2].isupper() if words else False  # AU12
    return (text if keep else text[:1].lower() + text[1:]) + side


def _group(words: _Words) -> str:
    found = _FIRST.match(words.stem[0]) if words.stem else None
    return found[0].lower() if found else ""


def _with_mirrors(sliders: Sequence[ShapeSlider]) -> tuple[ShapeSlider, ...]:
    """Mirrors are the sliders whose shapes are called as those of the other side, end by end."""
    shapes = {shape for slider in sliders for _, shape in slider.ends}
    places = {slider.ends: slider.name for slider in sliders}
    others = {
        slider.name: places.get(tuple((value, _other(shape, shapes)) for value, shape in slider.ends))
        for slider in sliders
    }
    return tuple(replace(slider, mirror=_mutual(slider.name, others)) for slider in sliders)


def _mutual(name: str, others: Mapping[str, str | None]) -> str | None:
    other = others[name]
    return other if other is not None and other != name and others[other] == name else None


def _other(shape: str, shapes: set[str]) -> str:
    """The shape of the other side; itself where there is none."""
    other = mirrored_name(shape)
    return other if other in shapes else shape
