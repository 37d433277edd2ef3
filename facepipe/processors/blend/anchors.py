"""The one point of a face that stays where it is."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.borders import back_of_border
from facepipe.parts import FaceParts
from facepipe.processors.blend.sources import Sources


def anchor_named(sources: Sources, text: str | None) -> int | None:
    """The point ``MESH:POINT``, counted over all meshes; None for None.

    :raises InputError: not of that form, or no such point
    """
    if text is None:
        return None
    name, _, point = text.rpartition(":")
    for mesh, start in zip(sources.base.meshes, sources.mesh_offsets[:-1], strict=True):
        if mesh.name == name and point.isascii() and point.isdecimal() and int(point) < len(mesh.points):
            return int(start) + int(point)
    names = ", ".join(f"{mesh.name}:0..{len(mesh.points) - 1}" for mesh in sources.base.meshes[:3])
    raise InputError(f"option anchor -> {text}", f"no such point, expected MESH:POINT like {names}")


def find_anchor(sources: Sources, given: int | None, component: IntArray) -> tuple[int, tuple[str, ...]]:
    """The point that is held, and a note where it had to be guessed.

    All that is joined to it is the main component, which loose parts follow. So an anchor that is given must lie on
    the same component as the face's own.

    :param given: a point counted over all meshes; None: the authored one, or the back of the face mesh's open border
    :param component: (n,) number of the connected component
    :raises InputError: one of a loose part, or none given or authored and no open border to take one from
    """
    own, notes = _authored(sources), list[str]()
    if own is None:
        own = _guessed(sources)
        notes += [] if own is None else [f"no anchor authored, taken from the open border: {_name(sources, own)}"]
    if given is not None:
        if own is not None and component[given] != component[own]:
            what = f"lies on a loose part, expected one joined to the face's own, {_name(sources, own)}"
            raise InputError(f"option anchor -> {_name(sources, given)}", what)
        return given, ()
    if own is None:
        where = f"{sources.names[0]} -> {sources.base.meshes[_face_mesh(sources.base)].name}"
        raise InputError(where, "no anchor and no open border to take one from, expected an anchor point (--anchor)")
    return own, tuple(notes)


def _authored(sources: Sources) -> int | None:
    for mesh, start in zip(sources.base.meshes, sources.mesh_offsets[:-1], strict=True):
        if mesh.anchor is not None:
            return int(start + mesh.anchor)
    return None


def _guessed(sources: Sources) -> int | None:
    number = _face_mesh(sources.base)
    mesh, start = sources.base.meshes[number], int(sources.mesh_offsets[number])
    placed = sources.points[0, start : start + len(mesh.points)] @ sources.base.skeleton.transform[:3, :3].T
    upright = placed if sources.base.up_axis == "Y" else placed[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
    place = back_of_border(upright, mesh.face_vertex_counts, mesh.face_vertex_indices)
    return None if place is None else start + place


def _face_mesh(base: FaceParts) -> int:
    """The mesh that is the face itself: one with landmarks, else with regions, else the one with most points."""
    ranks = [(bool(mesh.landmarks), bool(mesh.regions), len(mesh.points)) for mesh in base.meshes]
    return max(range(len(ranks)), key=ranks.__getitem__)


def _name(sources: Sources, point: int) -> str:
    number = int(np.searchsorted(sources.mesh_offsets, point, side="right")) - 1
    return f"{sources.base.meshes[number].name}:{point - int(sources.mesh_offsets[number])}"
