"""What shapes are called elsewhere, and which of a face's shapes a name means whatever its case, breaks and sides.

The tables are in ``conventions.json``, each with its source. A convention lists what its names mean, and for each
meaning the name that it writes and others that are read as well. A meaning is the ARKit shape, where there is one.
"""

from __future__ import annotations

import json
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files

_SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_A-Za-z]+")
_NAMESPACES = re.compile(r"[.:|]|__|^!ex-")  # blendShape1.jawOpen, face:jawOpen, MPFB's !ex-jawOpen
_FEWEST = 3  # names by which a convention is told


@dataclass(frozen=True)
class Convention:
    """One table: what its names mean."""

    title: str
    source: str
    names: Mapping[str, tuple[str, ...]]  # meaning -> the name that is written, then others that are read

    @cached_property
    def written(self) -> dict[str, str]:
        """Meaning -> the name that it has here."""
        return {meaning: names[0] for meaning, names in self.names.items()}

    @cached_property
    def keys(self) -> dict[str, str]:
        """Key of each name -> its meaning."""
        return {shape_key(name): meaning for meaning, names in self.names.items() for name in names}


def _tables() -> dict[str, Convention]:
    read = json.loads(files("facepipe.rig").joinpath("conventions.json").read_text(encoding="utf-8"))
    return {kind: Convention(one["title"], one["source"], _tuples(one["names"])) for kind, one in read.items()}


def _tuples(names: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    return {meant: tuple(given) for meant, given in names.items()}


def shape_key(name: str) -> str:
    """`name` without case and breaks, its side as a word at the end: alike for ``eyeBlinkLeft`` and ``L_eye_blink``.

    >>> shape_key("eyeBlink_L"), shape_key("Left Eye Blink"), shape_key("EYEBLINKLEFT")
    ('eyeblinkleft', 'eyeblinkleft', 'eyeblinkleft')
    """
    words = [word.casefold() for word in _WORDS.findall(unicodedata.normalize("NFC", name))]
    sides = [number for number, word in enumerate(words) if word in _SIDES]
    if len(sides) == 1 and len(words) > 1:
        words.append(_SIDES[words.pop(sides[0])])
    joined = "".join(words)
    for side in ("left", "right") if not sides else ():
        if joined.startswith(side) and joined != side:
            return joined.removeprefix(side) + side
    return joined or name


def spelling(name: str) -> str:
    """The key of `name` without the namespace before it (``blendShape1.jawOpen``, ``face:jawOpen``)."""
    last = _NAMESPACES.split(name)[-1]
    return shape_key(name if last.casefold() in ("", *_SIDES) else last)


CONVENTIONS: Mapping[str, Convention] = _tables()
_MEANINGS = {key: one for table in CONVENTIONS.values() for key, one in table.keys.items()}


def meaning(name: str) -> str | None:
    """What a shape's name means in any convention; None where in none.

    >>> meaning("blendShape1.EyeBlink_L"), meaning("CTRL_expressions_jawOpen"), meaning("noseHump")
    ('eyeBlinkLeft', 'jawOpen', None)
    """
    return _MEANINGS.get(shape_key(name), _MEANINGS.get(spelling(name)))


def match_shapes(names: Iterable[str], shapes: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The face's shapes that incoming names mean; names that mean none are left out.

    A shape of that very name comes first, then the one that differs in case, breaks, namespace or the form of its
    side alone, then the one that means the same in another convention. A name without side means both sides where
    the face has the shape by sides alone. No shape is given to two names: the better match has it.

    >>> match_shapes(("JawOpen", "eyeBlink_L", "cheekPuff"), ("jawOpen", "blinkLeft", "cheekPuff_L", "cheekPuff_R"))
    {'JawOpen': ('jawOpen',), 'eyeBlink_L': ('blinkLeft',), 'cheekPuff': ('cheekPuff_L', 'cheekPuff_R')}
    """
    incoming = list(dict.fromkeys(names))
    found: dict[str, tuple[str, ...]] = {name: (name,) for name in incoming if name in shapes}
    taken = set(found)
    both = ("left", "right")
    for form, sides in ((spelling, ("",)), (_meant, ("",)), (spelling, both), (_meant, both)):
        index = _index(form, shapes)
        for name in incoming:
            own = tuple(index[text] for side in sides if (text := form(name) + side) in index)
            if name not in found and len(own) == len(sides) and not taken.intersection(own):
                found[name] = own
                taken.update(own)
    return {name: found[name] for name in incoming if name in found}


def recognised(shapes: Sequence[str]) -> tuple[str, int] | None:
    """The convention that the most of `shapes` are called as, and how many are, whatever their spelling; None for
    fewer than three names."""
    counts = {
        kind: len({table.keys[key] for shape in shapes if (key := _known(table, shape)) is not None})
        for kind, table in CONVENTIONS.items()
    }
    kind = max(counts, key=lambda one: counts[one])  # the first of equals: MPFB's names are ARKit's
    return (kind, counts[kind]) if counts[kind] >= _FEWEST else None


def _known(table: Convention, shape: str) -> str | None:
    return next((key for key in (shape_key(shape), spelling(shape)) if key in table.keys), None)


def _meant(name: str) -> str:
    """The key of what a name means; nothing that any shape means where it means nothing."""
    found = meaning(name)
    return f"?{name}" if found is None else shape_key(found)


def _index(form: Callable[[str], str], shapes: Sequence[str]) -> dict[str, str]:
    """Form -> the one shape that has it."""
    forms = [form(shape) for shape in shapes]
    count = Counter(forms)
    return {text: shape for text, shape in zip(forms, shapes, strict=True) if count[text] == 1}
