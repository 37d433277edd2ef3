"""Cards that lie on the brows, which a picture's own brows take the place of."""

from __future__ import annotations

from scipy.spatial import cKDTree

from facepipe.geometry.vectors import transformed
from facepipe.parts import Material, TextureInput
from facepipe.stage import Face
from facepipe.stage.materials import author_opacity
from facepipe.textures.skin_surface import SkinSurface

_BROWS = slice(17, 27)  # landmarks
_REACH = 0.25  # of the eyes' distance: cards of brows lie so near to them


def hide_brow_cards(face: Face, skin: SkinSurface) -> tuple[str, ...]:
    """Make cards that lie on the brows transparent, within `Face.deriving`; their materials."""
    cards = brow_cards(face, skin)
    for prim in cards:
        author_opacity(face.stage.GetPrimAtPath(prim), 0.0)
    return tuple(material.name for material in cards.values())


def brow_cards(face: Face, skin: SkinSurface) -> dict[str, Material]:
    """The materials of cards that lie on the brows, by their prims."""
    rest = transformed(skin.mesh.points, skin.mesh.transform)
    brows, reach = rest[skin.landmarks[_BROWS]], _REACH * skin.eye_distance(rest)
    near = {
        mesh.material
        for mesh in face.meshes
        if cKDTree(brows).query(transformed(mesh.points, mesh.transform))[0].max() < reach
    }
    cut = {one.name: one for one in face.materials if one.name in near and isinstance(one.opacity, TextureInput)}
    return {prim: cut[name] for prim, name in face.material_names.items() if name in cut}
