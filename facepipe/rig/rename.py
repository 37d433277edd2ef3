"""Shapes and joints under other names, wherever a face speaks of them; and what conventions a face has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean
from facepipe.rig.conventions import CONVENTIONS, meaning, recognised

if TYPE_CHECKING:
    from facepipe.parts import Animation, FaceParts, Mesh, Slider


def shapes_of(parts: FaceParts) -> tuple[str, ...]:
    """Names of the shapes of a face, each once."""
    return tuple(dict.fromkeys(shape.name for mesh in parts.meshes for shape in mesh.blendshapes))


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
    known = [*shapes_of(parts), *parts.skeleton.names, *parts.skeleton.joints]
    missing = sorted({*names} - {*known})
    if not missing:
        return None
    like = f"like '{missing[0][:60]}'{did_you_mean(missing[0], known)}"
    return f"{len(missing)} of {len(names)} names are not on the face, {like}"


def renamed(parts: FaceParts, names: Mapping[str, str], where: object) -> FaceParts:
    """The face whose shapes and joints have the new names of a table, in clips, sliders and their network too.

    Joint paths stay as they are: what changes are the names that files are written with.

    :param names: old name -> new one; of joints the source's name or the path
    :param where: the table, for messages
    :raises InputError: two shapes, or two joints, that would have one name
    """
    shapes = shapes_of(parts)
    _check(where, "shapes", shapes, [names.get(shape, shape) for shape in shapes])
    skeleton = parts.skeleton
    called = [
        names.get(joint, names.get(path, joint)) for joint, path in zip(skeleton.names, skeleton.joints, strict=True)
    ]
    _check(where, "joints", skeleton.names, called)
    network = parts.slider_network
    return replace(
        parts,
        meshes=tuple(_mesh(mesh, names) for mesh in parts.meshes),
        skeleton=skeleton.called(called),
        animations=tuple(_animation(one, names) for one in parts.animations),
        sliders=tuple(_slider(one, names) for one in parts.sliders),
        slider_network=network and replace(network, shapes=_all(network.shapes, names)),
    )


def _check(where: object, what: str, old: Sequence[str], new: Sequence[str]) -> None:
    """:raises InputError: a new name that another one has as well"""
    count = Counter(new)
    for name, other in zip(old, new, strict=True):
        if name != other and count[other] > 1:
            both = [one for one, called in zip(old, new, strict=True) if called == other]
            raise InputError(
                where, f"the {what} '{both[0]}' and '{both[1]}' would both be called '{other}', expected two names"
            )


def _mesh(mesh: Mesh, names: Mapping[str, str]) -> Mesh:
    shapes = tuple(
        replace(shape, name=names[shape.name], label=None) if shape.name in names else shape
        for shape in mesh.blendshapes
    )
    return replace(mesh, blendshapes=shapes)


def _animation(animation: Animation, names: Mapping[str, str]) -> Animation:
    return replace(animation, shapes=_all(animation.shapes, names))


def _slider(slider: Slider, names: Mapping[str, str]) -> Slider:
    return replace(slider, shapes=tuple((names.get(shape, shape), gain) for shape, gain in slider.shapes))


def _all(shapes: Sequence[str], names: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(names.get(shape, shape) for shape in shapes)


def convention_of(shapes: Sequence[str]) -> dict[str, Any] | None:
    """The convention that a face's shapes are called as, as JSON values; None where they are called as in none."""
    found = recognised(shapes)
    if found is None:
        return None
    kind, count = found
    written = {*CONVENTIONS[kind].written.values()}
    return {
        "convention": kind,
        "title": CONVENTIONS[kind].title,
        "names": count,
        "of": len(written),
        "exact": len(written.intersection(shapes)) == count,
        "arkit": len(convention_names("arkit", shapes)),
    }


def convention_text(found: Mapping[str, Any] | None) -> str:
    """The convention for people, with what gives its names where the face spells them otherwise."""
    if found is None:
        return "of no known convention"
    text = f"{found['title']}, {found['names']} of {found['of']}"
    if not found["exact"]:
        return f"{text} in another spelling (--rename {found['convention']} gives its own)"
    return f"{text} (--rename arkit gives {found['arkit']} of them ARKit's names)" if found["arkit"] else text
