"""Heads in the box whose lids follow gaze as all people's did, before looks and squints were fitted to each person."""

from __future__ import annotations

from dataclasses import replace

from facepipe.heads.assembly import BLINKS, LIDS, blendshapes_of
from facepipe.heads.asset import asset
from facepipe.parts import FaceParts

LOOKS = tuple(name for name in LIDS if name not in BLINKS)


def with_shared_lids(parts: FaceParts) -> FaceParts:
    """The face with looks and squints of the package on its skin."""
    skin, *others = parts.meshes
    made = blendshapes_of(asset().parts["Head"], {name: asset().shapes[name] for name in LOOKS})
    shared = {one.name: one for one in made}
    blendshapes = tuple(shared.get(one.name, one) for one in skin.blendshapes)
    return replace(parts, meshes=(replace(skin, blendshapes=blendshapes), *others))
