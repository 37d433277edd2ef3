"""Names of shapes elsewhere, the shapes of a face that they mean whatever their case, breaks and sides, and renaming.

The tables are in ``conventions.json``, each with its source. A convention lists what its names mean, and for each
meaning the name that it writes and others that are read as well. A meaning is the ARKit shape, where there is one.
"""

from __future__ import annotations

import json
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean

if TYPE_CHECKING:
    from facepipe.parts import FaceParts

_SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_A-Za-z]+")
_NAMESPACES = re.compile(r"[.:|]|__|^!ex-")  # blendShape1.jawOpen, face:jawOpen, MPFB's !ex-jawOpen
_FEWEST_NAMES = 3  # names that make a convention


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
    for table in read.values():
        table["names"] = {meant: tuple(given) for meant, given in table["names"].items()}
    return {kind: Convention(table["title"], table["source"], table["names"]) for kind, table in read.items()}


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
_MEANINGS = {key: meant for table in CONVENTIONS.values() for key, meant in table.keys.items()}


def meaning(name: str) -> str | None:
    """The meaning of a shape's name in any convention; None where it has none.

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
    matched: dict[str, tuple[str, ...]] = {name: (name,) for name in incoming if name in shapes}
    taken = set(matched)
    both = ("left", "right")
    # form by form over all names, not name by name: a loose match never takes the shape that a later name spells
    for form, sides in ((spelling, ("",)), (_meant, ("",)), (spelling, both), (_meant, both)):
        forms = [form(shape) for shape in shapes]
        count = Counter(forms)
        index = {text: shape for text, shape in zip(forms, shapes, strict=True) if count[text] == 1}
        for name in incoming:
            meant = tuple(index[text] for side in sides if (text := form(name) + side) in index)
            if name not in matched and len(meant) == len(sides) and not taken.intersection(meant):
                matched[name] = meant
                taken.update(meant)
    return {name: matched[name] for name in incoming if name in matched}


def recognised(shapes: Sequence[str]) -> tuple[str, int] | None:
    """The convention that most of `shapes` follow, and how many do, whatever their spelling; None for fewer than
    three names."""
    counts = {}
    for kind, table in CONVENTIONS.items():
        known = ([key for key in (shape_key(shape), spelling(shape)) if key in table.keys] for shape in shapes)
        counts[kind] = len({table.keys[keys[0]] for keys in known if keys})
    kind = max(counts, key=lambda convention: counts[convention])  # the first of equals: MPFB's names are ARKit's
    return (kind, counts[kind]) if counts[kind] >= _FEWEST_NAMES else None


def _meant(name: str) -> str:
    """The key of what a name means; nothing that any shape means where it means nothing."""
    found = meaning(name)
    return f"?{name}" if found is None else shape_key(found)


ARKIT_SHAPES = frozenset(CONVENTIONS["arkit"].written)


def convention_names(kind: str, shapes: Sequence[str]) -> dict[str, str]:
    """Shape -> its name in a convention, of those that have another there.

    >>> convention_names("vrm", ("eyeBlink_L", "viseme_aa", "noseHump"))
    {'eyeBlink_L': 'blinkLeft', 'viseme_aa': 'aa'}
    """
    written = CONVENTIONS[kind].written
    found = {shape: written.get(meaning(shape) or "", shape) for shape in shapes}
    return {shape: name for shape, name in found.items() if name != shape}


def unknown_names(parts: FaceParts, names: Mapping[str, str]) -> str | None:
    """A line about the names of a table that neither shapes nor joints of the face have; None where there are none."""
    known = [*parts.shapes, *parts.skeleton.names, *parts.skeleton.joints]
    missing = sorted({*names} - {*known})
    if not missing:
        return None
    example = f"such as '{missing[0][:60]}'{did_you_mean(missing[0], known)}"
    return f"{len(missing)} of {len(names)} names are not on the face, {example}"


def renamed(parts: FaceParts, names: Mapping[str, str], where: object) -> FaceParts:
    """The face whose shapes and joints have the new names of a table, in clips, sliders and their network too.

    Joint paths stay as they are: what changes are the names that files are written with.

    :param names: old name -> new one; of joints the source's name or the path
    :param where: the table, for messages
    :raises InputError: two shapes, or two joints, that would have one name
    """
    _check(where, "shapes", parts.shapes, [names.get(shape, shape) for shape in parts.shapes])
    meshes = []
    for mesh in parts.meshes:
        shapes = (
            replace(shape, name=names[shape.name], label=None) if shape.name in names else shape
            for shape in mesh.blendshapes
        )
        meshes.append(replace(mesh, blendshapes=tuple(shapes)))
    skeleton = parts.skeleton
    joint_names = [
        names.get(joint, names.get(path, joint)) for joint, path in zip(skeleton.names, skeleton.joints, strict=True)
    ]
    _check(where, "joints", skeleton.names, joint_names)
    network = parts.slider_network
    return replace(
        parts,
        meshes=tuple(meshes),
        skeleton=skeleton.called(joint_names),
        animations=tuple(replace(animation, shapes=_all(animation.shapes, names)) for animation in parts.animations),
        sliders=tuple(
            replace(slider, shapes=tuple((names.get(shape, shape), gain) for shape, gain in slider.shapes))
            for slider in parts.sliders
        ),
        slider_network=network and replace(network, shapes=_all(network.shapes, names)),
        vrm=_of_binds(parts.vrm, names),
    )


def _of_binds(vrm: Any, names: Mapping[str, str]) -> Any:
    """What VRM says of an avatar, its expressions bound to shapes of the new names."""
    if isinstance(vrm, Mapping):
        return {
            key: names.get(one, one) if key == "index" and isinstance(one, str) else _of_binds(one, names)
            for key, one in vrm.items()
        }
    return [_of_binds(one, names) for one in vrm] if isinstance(vrm, list) else vrm


def _check(where: object, kind: str, old: Sequence[str], new: Sequence[str]) -> None:
    """:raises InputError: a new name that another one has as well"""
    count = Counter(new)
    for name, other in zip(old, new, strict=True):
        if name != other and count[other] > 1:
            both = [before for before, called in zip(old, new, strict=True) if called == other]
            raise InputError(
                where, f"the {kind} '{both[0]}' and '{both[1]}' would both be called '{other}', expected two names"
            )


def _all(shapes: Sequence[str], names: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(names.get(shape, shape) for shape in shapes)


def convention_of(shapes: Sequence[str]) -> dict[str, Any] | None:
    """The convention that a face's shapes are called as, as JSON values; None where they are called as in none."""
    match = recognised(shapes)
    if match is None:
        return None
    kind, count = match
    written = {*CONVENTIONS[kind].written.values()}
    return {
        "convention": kind,
        "title": CONVENTIONS[kind].title,
        "names": count,
        "of": len(written),
        "exact": len(written.intersection(shapes)) == count,
        "arkit": len(convention_names("arkit", shapes)),
    }


def convention_text(match: Mapping[str, Any] | None) -> str:
    """The convention for people, with what gives its names where the face spells them otherwise."""
    if match is None:
        return "of no known convention"
    text = f"{match['title']}, {match['names']} of {match['of']}"
    if not match["exact"]:
        return f"{text} in another spelling (--rename {match['convention']} gives its own)"
    return f"{text} (--rename arkit gives {match['arkit']} of them ARKit's names)" if match["arkit"] else text
