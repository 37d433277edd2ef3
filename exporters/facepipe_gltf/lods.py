"""Levels of detail in one file: MSFT_lod, by which a node names nodes that may be shown in its place.

Source: https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Vendor/MSFT_lod
"""

from __future__ import annotations

from collections.abc import Sequence

from facepipe.core.errors import InputError
from facepipe.parts import FaceParts, HasLevels, HasParts
from facepipe.records import Json
from facepipe_gltf.baking import Baked

_LODS = "MSFT_lod"


def lower_levels(face: HasParts) -> tuple[FaceParts, ...]:
    """The face at each lower level, finest first.

    :raises InputError: it has none
    """
    levels = face.lower_levels() if isinstance(face, HasLevels) else ()
    if not levels:
        raise InputError("--lods", "the face has no levels of detail, expected some that `facepipe lod` made")
    return levels


def link_level(
    nodes: list[Json], meshes: list[Json], finest: Sequence[Baked], lower: Sequence[Baked], number: int
) -> None:
    """Name the last nodes of a document and their meshes as a level, and list their numbers in the first nodes.

    :param finest: what the first nodes show; `lower`: what the last ones do
    """
    above = {baked.mesh.name: node for baked, node in zip(finest, nodes, strict=False)}
    first = len(nodes) - len(lower)
    for index, baked in enumerate(lower, first):
        node = above[baked.mesh.name]
        node.setdefault("extensions", {_LODS: {"ids": []}})[_LODS]["ids"].append(index)
        nodes[index]["name"] = f"{node['name']}_lod{number}"
        mesh = meshes[nodes[index]["mesh"]]
        mesh["name"] = f"{mesh['name']}_lod{number}"
