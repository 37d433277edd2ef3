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
from collections.abc import Sequence
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
    split = {shape: _words(shape, pairs) for shape in shapes}
    named = {(one.side, one.stem, one.end): shape for shape, one in reversed(split.items()) if one.end}
    lows = {high: low for low, high in pairs}
    upper: dict[str, str] = {}  # shape of the lower end -> that of the upper one
    for (side, stem, end), shape in named.items():
        lower = named.get((side, stem, lows.get(end, "")))
        if lower is not None:
            upper[lower] = shape
    highs, by_first = {high: low for low, high in upper.items()}, {}
    for shape in shapes:
        low = highs.get(shape, shape)
        by_first[low] = ((-1.0, low), (1.0, upper[low])) if low in upper else ((1.0, low),)
    ends = list(by_first.values())
    words = [_words(own[-1][1], pairs if len(own) == 2 else ()) for own in ends]
    stems = Counter(_joined(word.stem, word.side).lower() for word in words)
    names = [
        _joined((*word.stem, word.end) if stems[_joined(word.stem, word.side).lower()] > 1 else word.stem, word.side)
        for word in words
    ]
    made = []
    for name, one, own in zip(unique_identifiers(names), words, ends, strict=True):
        first = _FIRST.match(one.stem[0]) if one.stem else None
        made.append(ShapeSlider(name=name, group=first[0].lower() if first else "", ends=own))
    # mirrors are the sliders whose shapes are called as those of the other side, end by end, each the other's
    known, places = {shape for own in ends for _, shape in own}, {one.ends: one.name for one in made}
    others = {
        one.name: places.get(
            tuple((value, other if (other := mirrored_name(shape)) in known else shape) for value, shape in one.ends)
        )
        for one in made
    }
    mutual = {name: other for name, other in others.items() if other not in (None, name) and others[other] == name}
    return tuple(replace(one, mirror=mutual.get(one.name)) for one in made)


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
