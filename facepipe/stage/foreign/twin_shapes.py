"""Shapes of several meshes that are one: Blender calls the second mesh's ``jawOpen2``, and its prim ``jawOpen``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from pxr import Usd, UsdSkel

from facepipe.parts import Animation, Mesh

_TWIN_NUMBER = re.compile(r"[._]?[0-9]+")
_SAME_WEIGHT = 1e-6  # weights nearer than this are one


def twin_shapes(meshes: Sequence[Usd.Prim]) -> dict[str, str]:
    """Names of shapes that are the shape of another mesh, to its name.

    Such a one is called as its prim is, with a number behind; another mesh has a shape of the prim's name, and no mesh
    has both.
    """
    every = [_tokens(mesh) for mesh in meshes]
    plain = {prim: token for own in every for token, prim in own.items() if _identifier(token) == prim}
    bases: dict[str, str] = {}
    for own in every:
        twins = {token: plain[prim] for token, prim in own.items() if prim in plain and _numbered(token, prim)}
        bases |= {token: base for token, base in twins.items() if base not in own}
    return {token: base for token, base in bases.items() if token not in plain.values()}


def _tokens(mesh: Usd.Prim) -> dict[str, str]:
    """Names of a mesh's shapes, with those of their prims."""
    api = UsdSkel.BindingAPI(mesh)
    names = [str(name) for name in api.GetBlendShapesAttr().Get() or []]
    targets = api.GetBlendShapeTargetsRel().GetTargets()
    return {name: str(target.name) for name, target in zip(names, targets, strict=False)}


def _numbered(token: str, prim: str) -> bool:
    own = _identifier(token)
    return own.startswith(prim) and _TWIN_NUMBER.fullmatch(own.removeprefix(prim)) is not None


def _identifier(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_]", "_", name)


def alike_in(twins: Mapping[str, str], animations: Iterable[Animation]) -> dict[str, str]:
    """The twins that no animation moves otherwise than the shape that they are."""
    apart: set[str] = set()
    for animation in animations:
        weights = animation.shape_weights
        if weights is None:
            continue
        column = {name: weights[:, i] for i, name in enumerate(animation.shapes)}
        zeros = np.zeros(len(weights))
        for name, base in twins.items():
            if np.abs(column.get(name, zeros) - column.get(base, zeros)).max(initial=0.0) > _SAME_WEIGHT:
                apart.add(name)
    return {name: base for name, base in twins.items() if name not in apart}


def joined_meshes(meshes: Iterable[Mesh], twins: Mapping[str, str]) -> tuple[Mesh, ...]:
    """The meshes with twins called as the shapes that they are."""
    return tuple(
        replace(
            mesh,
            blendshapes=tuple(
                replace(blendshape, name=twins.get(blendshape.name, blendshape.name)) for blendshape in mesh.blendshapes
            ),
        )
        for mesh in meshes
    )


def joined_animation(animation: Animation, twins: Mapping[str, str]) -> Animation:
    """The animation without the columns of twins, whose shapes it moves alike."""
    kept = [i for i, name in enumerate(animation.shapes) if name not in twins]
    if len(kept) == len(animation.shapes) or animation.shape_weights is None:
        return animation
    return replace(
        animation,
        shapes=tuple(animation.shapes[i] for i in kept),
        shape_weights=animation.shape_weights[:, kept],
    )
