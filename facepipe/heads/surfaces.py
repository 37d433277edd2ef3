"""A person's colours: materials with textures, and brows, lashes and hair: cards with pictures of hairs on the skin.

`samples/head/cards.py` makes the cards of the average head. Here they follow a person, and what moves that person's
skin.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from importlib.resources import files

import numpy as np
from scipy.spatial import cKDTree

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.threads import mapped
from facepipe.geometry.polygons import point_normals, point_triangles
from facepipe.heads import skin
from facepipe.heads.asset import STEP, arrays_of
from facepipe.heads.people import BEARDS, BROWS, IRIS, STYLES, Look
from facepipe.heads.skin import jpeg
from facepipe.parts import (
    Blendshape,
    Color,
    FaceParts,
    Inbetween,
    Material,
    Mesh,
    Texture,
    TextureInput,
    UvSet,
    WrinkleRegion,
    Wrinkles,
)

SMALLEST = 16  # texels a side
SKIN = ("M_Face", "M_BackHead")  # of the skin's tiles
# linear sheen of vellus hair, 2 % of the light at an outline and none from the front; with 0.2 skin looks chalky
FUZZ, FUZZ_ROUGHNESS = (0.08, 0.065, 0.055), 0.4
TEARS = 0.5  # clear coat, whose 4 % of light (ior 1.5) become the 2.1 % of tears (ior 1.337)
_YOUNG = 0.75  # how strong the youngest wrinkle
_STEP = 4  # texels from one point of the head to the next
HAIR_GREY = 0.35  # linear, the mean of the pictures of hairs
_LASHES = np.array([0.012, 0.009, 0.008])
_LIFTS = 12  # rounds at most; 3 left a lash 0.1 mm in the skin of a corner
_STILL = 2e-3  # cm: smaller moves are none
CUT = 0.35  # opacity: at half, thin locks would be gone in the coarse levels of their picture that engines show
_FAR = 0.3  # cm: cards that turn further beside what holds them may dip into other skin
_HANGING = 4.0  # cm off what holds it, where hair hangs
_AS_LAID = 1e-3  # cm: cards that lie farther off were moved
_STAYS = np.zeros((1, 3))  # the motion of cards that do not move beside what holds them
_CLEAR = 0.04  # cm that each row of a card stays farther off the skin than the one before


def dressed(face: FaceParts, look: Look, size: int | None) -> FaceParts:
    """A bare head with colours, brows, lashes and hair.

    :param size: texels a side of the skin's textures; None: colours at points and no textures, so no cards of hairs
    :raises InputError: a size too small
    """
    if size is not None and size < SMALLEST:
        raise InputError("textures", f"{size} texels a side, expected 0 for none, or {SMALLEST} and more")
    head, *others = face.meshes
    if size is None:
        plain = Material(
            name="", diffuse_color=(1.0, 1.0, 1.0), roughness=0.5, sheen_color=FUZZ, sheen_roughness=FUZZ_ROUGHNESS
        )
        skins = [replace(plain, name=name) for name in SKIN]
        uv, (uv_set, *_) = np.zeros((len(head.points), 2)), head.uv_sets
        uv[head.face_vertex_indices] = np.asarray(uv_set.values)[uv_set.indices]
        tiles = np.stack([skin.coarse(look, tile, _STEP) for tile in range(len(SKIN))])
        tile, side = np.floor(uv[:, 0]).astype(int), tiles.shape[1]
        row, column = ((1 - uv[:, 1]) * side).astype(int), ((uv[:, 0] - tile) * side).astype(int)
        head = replace(head, colors=np.asarray(tiles[tile, row, column]))
        return replace(face, meshes=(head, *others), materials=(*skins, *_loose(look, textured=False)))
    skins = mapped(partial(_skin, look, size), range(len(SKIN)))
    hairs: dict[str, tuple[str, str | None]] = {
        "Brows": ("brows", "eyebrows"),
        "Lashes": ("lashes", "eyes"),
        "Hair": (look.style, "forehead"),
        "Beard": (look.whiskers, None),
    }
    hair, picture = look.hair_color, STYLES[look.style][1]
    pictures = BROWS[look.brow_shape]
    brows = pictures[int(np.clip(len(pictures) * look.brows, 0, len(pictures) - 1))]
    found = [_hair("Brows", brows, brow_color(hair, look.skin, look.worn)), _hair("Lashes", "lashes.png", _LASHES)]
    if picture:
        found.append(replace(_hair("Hair", picture, hair), opacity_threshold=CUT))
    if BEARDS[look.whiskers]:
        found.append(replace(_hair("Beard", "hair.png", hair), opacity_threshold=CUT))
    materials = (*skins, *_loose(look, textured=True), *found)
    drawn = {material.name for material in materials}
    grown = [card_mesh(name, cards(kind), head, at) for name, (kind, at) in hairs.items() if name in drawn]
    return replace(face, meshes=(*face.meshes, *grown), materials=materials)


def _skin(look: Look, size: int, tile: int) -> Material:
    stem = f"skin_{skin.TILES[tile]}"
    color = jpeg(stem, skin.albedo(look, tile, size))
    packed = jpeg(f"{stem}_orm", skin.roughness(look, tile, size // 2))
    relief = jpeg(f"{stem}_normal", skin.relief(look, tile, size))
    return Material(
        name=SKIN[tile],
        diffuse_color=TextureInput(texture=color),
        roughness=TextureInput(texture=packed, channels="g"),
        occlusion=TextureInput(texture=packed, channels="r"),
        normal=TextureInput(texture=relief, scale=(2.0, 2.0, 2.0, 1.0), bias=(-1.0, -1.0, -1.0, 0.0)),
        ior=1.4,
        sheen_color=FUZZ,
        sheen_roughness=FUZZ_ROUGHNESS,
        wrinkles=_wrinkles(look) if skin.TILES[tile] == "face" else None,
    )


def _wrinkles(look: Look) -> Wrinkles:
    """What shapes draw on the face's tile: less on young skin, and none of what is there at rest."""
    table, at_rest = skin.wrinkle_table(), skin.at_rest(look)
    masks = {row["mask"][0]: picture_of(f"wrinkles_mask{row['mask'][0]}.png") for row in table.values()}
    normal = TextureInput(
        texture=picture_of("wrinkles_normal.jpg"), scale=(2.0, 2.0, 2.0, 1.0), bias=(-1.0, -1.0, -1.0, 0.0)
    )
    firm = _YOUNG + (1 - _YOUNG) * float(np.clip(look.age, 0, 1))
    return Wrinkles(
        normal=normal,
        tint=TextureInput(texture=picture_of("wrinkles_tint.jpg")),
        regions=tuple(
            WrinkleRegion(
                name=name,
                mask=TextureInput(texture=masks[row["mask"][0]], channels=row["mask"][1]),
                shapes=tuple((shape, round(gain * (firm - at_rest[name]), 3)) for shape, gain in row["shapes"].items()),
            )
            for name, row in sorted(table.items())
        ),
    )


def _loose(look: Look, *, textured: bool) -> list[Material]:
    """Mouth and eyes, whose pictures come with the package."""
    # Light that skin sends back lights eyes too: as bright beside dark skin as beside light skin, they glow. The white
    # of dark people's eyes has some pigment, which takes blue first; with 0.8 of the blue for the red they look ill.
    red, green, blue = (1 - share * look.darkness for share in (0.45, 0.47, 0.5))
    shade, dim, plain = 1 - 0.4 * look.darkness, (red, green, blue), (1.0, 1.0, 1.0)
    white: Color = (0.5 * red, 0.46 * green, 0.42 * blue)
    (r, g, b), iris = IRIS[look.eyes], f"iris_{look.eyes}.jpg"
    rows: list[tuple[str, str, Color, float, Color]] = [  # material, picture, colour without it, roughness, dimmed to
        ("M_GumsTongue", "gums.jpg", (0.52, 0.20, 0.18), 0.3, plain),
        ("M_Teeth", "teeth.jpg", (0.74, 0.68, 0.56), 0.22, plain),
        *((f"M_Sclera{side}", "sclera.png", white, 0.18, dim) for side in ("Left", "Right")),
        *(
            (f"M_Iris{side}", iris, (shade * r, shade * g, shade * b), 0.4, (shade, shade, shade))
            for side in ("Left", "Right")
        ),
        ("Pupil", iris, (0.002, 0.002, 0.002), 0.4, plain),
        ("Cornea", "sclera.png", (0.0, 0.0, 0.0), 0.03, dim),
    ]
    materials = []
    for name, picture, color, roughness, factor in rows:
        diffuse = TextureInput(texture=picture_of(picture), scale=(*factor, 1.0)) if textured else color
        coat = TEARS if picture == "sclera.png" and name != "Cornea" else 0.0
        materials.append(Material(name=name, diffuse_color=diffuse, roughness=roughness, clearcoat=coat))
    clear = TextureInput(texture=picture_of("sclera.png"), channels="a") if textured else 0.05
    materials[-1] = replace(materials[-1], opacity=clear, ior=1.376)
    return materials


def brow_color(hair: FloatArray, skin: FloatArray, worn: float = 0.0) -> FloatArray:
    """(3,) linear colour of brows that go with hair: darker than the skin.

    :param worn: 0..1, with which light hair's brows are as light as it is
    """
    dark = min(1.0, (0.12 + 0.1 * worn) / float(hair.max()), (0.6 + 0.2 * worn) * float(skin.mean() / hair.mean()))
    return np.asarray(0.8 * dark * hair + 0.05 * skin)


def _hair(name: str, picture: str, color: FloatArray) -> Material:
    image, (red, green, blue) = picture_of(picture), np.minimum(color / HAIR_GREY, 1.0).tolist()
    return Material(
        name=name,
        diffuse_color=TextureInput(texture=image, scale=(red, green, blue, 1.0)),
        opacity=TextureInput(texture=image, channels="a"),
        roughness=0.9 if picture == "coils.png" else 0.6,
        ior=1.35,  # the sides of cards would mirror more than hairs do
    )


def picture_of(name: str) -> Texture:
    """A picture of the package by its name."""
    return Texture(name=name, data=(files("facepipe.heads") / "data" / name).read_bytes())


@dataclass(frozen=True, kw_only=True)
class Cards:
    """A set of cards: n points."""

    grids: tuple[tuple[int, int, int], ...]  # cards, rows, columns of points, of one layer after another
    corners: IntArray  # (n, 3) points of Head
    shares: FloatArray  # (n, 3) barycentric
    offsets: FloatArray  # (n, 3) from there, cm
    uv: FloatArray  # (n, 2)
    motion: Mapping[str, FloatArray]  # shape -> (n, 3) how it moves cards beside what holds them

    @cached_property
    def holding(self) -> BoolArray:
        """(m,) points of the head that hold cards; those beyond do not."""
        return np.bincount(self.corners.ravel()) > 0

    def carry(self, values: FloatArray) -> FloatArray:
        """(n, ...) values of the head (points, ...) where the cards hold on."""
        return np.asarray(np.einsum("nk,nk...->n...", self.shares, values[self.corners]))


def _file(name: str) -> str:
    return "hair" if name in STYLES or name in BEARDS else "cards"


@cache
def _points(name: str) -> int:
    """How many a set of cards has."""
    return int(np.prod(arrays_of(_file(name), f"{name}_grids")[""], axis=1).sum())


@cache
def cards(name: str) -> Cards:
    """A set by name: brows, lashes, or a style of hair."""
    data = arrays_of(_file(name), f"{name}_")
    first_two = data.pop("shares") / 255
    return Cards(
        grids=tuple((int(count), int(rows), int(columns)) for count, rows, columns in data.pop("grids")),
        corners=data.pop("corners").astype(np.int64),
        shares=np.column_stack([first_two, 1 - first_two.sum(axis=1)]),
        offsets=data.pop("offsets") * STEP,
        uv=data.pop("uv") / 65535,
        motion={shape: offsets * STEP for shape, offsets in data.items()},
    )


def card_mesh(name: str, held: Cards, head: Mesh, region: str | None) -> Mesh:
    """Cards on a head, moved by its shapes and joints, with the material of their name.

    :param region: that all of them are in; None: those of the skin that holds them
    """
    counts, indices = _faces(held.grids)
    triangles = point_triangles(head.face_vertex_counts, head.face_vertex_indices)
    shapes = (_shape(held, shape, head.points, triangles) for shape in head.blendshapes)
    zeros = np.zeros(len(held.uv))
    influences = head.skin
    if influences is not None:
        # the strongest four of the influences of what holds each point
        joints = influences.joint_indices[held.corners].reshape(len(held.shares), -1)
        weights = (influences.joint_weights[held.corners] * held.shares[..., None]).reshape(joints.shape)
        dense = np.zeros((len(joints), int(influences.joint_indices.max()) + 1))
        np.add.at(dense, (np.arange(len(joints))[:, None], joints), weights)
        strongest = np.argsort(-dense, axis=1, kind="stable")[:, :4]
        weights = np.take_along_axis(dense, strongest, axis=1)
        weights /= weights.sum(axis=1, keepdims=True)
        strongest = np.where(weights > 0, strongest, 0).astype(np.int32)
        influences = replace(influences, joint_indices=strongest, joint_weights=weights)
    # normals are those of the skin where cards lie on it, level and outwards where they hang
    outwards = (held.carry(head.points) + held.offsets - head.points.mean(axis=0)) * [1, 0, 1]
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    lying = np.exp(-((np.linalg.norm(held.offsets, axis=1, keepdims=True) / _HANGING) ** 2))
    normals = outwards + lying * (held.carry(point_normals(head.points, triangles)) - outwards)
    return Mesh(
        name=name,
        points=held.carry(head.points) + held.offsets,
        face_vertex_counts=counts,
        face_vertex_indices=indices,
        normals=np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True)),
        uv_sets=(UvSet(values=held.uv),),
        skin=influences,
        blendshapes=tuple(shape for shape in shapes if shape is not None),
        regions={
            one: zeros + (one == region) if region else held.carry(np.asarray(mask))
            for one, mask in head.regions.items()
        },
        material=name,
        double_sided=True,
    )


def kind_of(mesh: Mesh, head: Mesh, within: float = _AS_LAID) -> str | None:
    """The set of cards that a mesh is as it lies on a head, within so many cm; None: none, or one that was moved."""
    styles = [style for style, (_, picture) in STYLES.items() if picture]
    for kind in ("brows", "lashes", *styles, *(beard for beard, painted in BEARDS.items() if painted)):
        if len(mesh.points) != _points(kind):
            continue
        held = cards(kind)
        if held.corners.max() < len(head.points):
            off = np.abs(held.carry(head.points) + held.offsets - mesh.points)
            if off.max() < within:
                return kind
    return None


def laid_again(mesh: Mesh, before: Mesh, head: Mesh) -> Mesh | None:
    """A mesh of cards on another head; None where it is none, or does not lie on the head as it was `before`."""
    kind = kind_of(mesh, before)
    return None if kind is None else other_cards(mesh, kind, head)


def other_cards(mesh: Mesh, kind: str, head: Mesh) -> Mesh:
    """Cards of a kind on a head in place of a mesh of cards."""
    regions = [name for name, mask in mesh.regions.items() if np.any(mask)]
    region = regions[0] if len(regions) == 1 else None
    return replace(card_mesh(mesh.name, cards(kind), head, region), material=mesh.material)


def card_triangles(held: Cards) -> IntArray:
    """(t, 3) of a set of cards."""
    return point_triangles(*_faces(held.grids))


def _faces(grids: Sequence[tuple[int, int, int]]) -> tuple[IntArray, IntArray]:
    """Quads of cards one after another."""
    found, first = [], 0
    for grid in grids:
        points = first + np.arange(np.prod(grid)).reshape(grid)
        corners = [points[:, :-1, :-1], points[:, :-1, 1:], points[:, 1:, 1:], points[:, 1:, :-1]]
        found.append(np.stack(corners, axis=-1).ravel())
        first += points.size
    indices = np.concatenate(found)
    return np.full(len(indices) // 4, 4, np.int32), indices.astype(np.int32)


def _shape(held: Cards, shape: Blendshape, skin: FloatArray, triangles: IntArray) -> Blendshape | None:
    """How cards on skin (n, 3) move with a shape."""
    motion = held.motion.get(shape.name, _STAYS)
    if motion is _STAYS and not held.holding[shape.point_indices[shape.point_indices < len(held.holding)]].any():
        return None

    def offsets(values: FloatArray, weight: float) -> FloatArray:
        whole = np.zeros_like(skin)
        whole[shape.point_indices] = values
        moved = held.carry(whole) + weight * motion
        if np.abs(motion).max() < _FAR:
            return moved
        moving = _farthest(moved)[:, None] > _STILL
        for _ in range(_LIFTS):  # what is lifted may lie over other skin than before
            lift = _lift(held, held.carry(skin) + held.offsets + moved, skin + whole, triangles)
            if np.abs(lift[moving[:, 0]]).max(initial=0.0) < _STILL:
                break
            moved = moved + np.where(moving, lift, 0.0)
        return moved

    moves = {inbetween.weight: offsets(inbetween.offsets, inbetween.weight) for inbetween in shape.inbetweens}
    full = offsets(shape.offsets, 1.0)
    moved = np.flatnonzero(np.max([_farthest(move) for move in (full, *moves.values())], axis=0) > _STILL)
    if not len(moved):
        return None
    inbetweens = (
        Inbetween(name=inbetween.name, weight=inbetween.weight, offsets=moves[inbetween.weight][moved])
        for inbetween in shape.inbetweens
    )
    indices, between = moved.astype(np.int32), tuple(inbetweens)
    return replace(shape, point_indices=indices, offsets=full[moved], normal_offsets=None, inbetweens=between)


def _farthest(moves: FloatArray) -> FloatArray:
    """(n,) the largest of the three of each of moves (n, 3); along so short an axis numpy takes 5 times as long."""
    x, y, z = np.abs(moves).T
    return np.asarray(np.maximum(np.maximum(x, y), z))


def _lift(held: Cards, points: FloatArray, skin: FloatArray, triangles: IntArray) -> FloatArray:
    """(n, 3) what takes cards that dip into the skin out of it."""
    low, high = points.min(axis=0), points.max(axis=0)
    near = np.flatnonzero(((skin > low) & (skin < high)).all(axis=1))
    closest = near[cKDTree(skin[near]).query(points)[1]]
    around = np.zeros(len(skin), bool)
    around[closest] = True
    a, b, c = triangles.T
    normals = point_normals(skin, triangles[around[a] | around[b] | around[c]])[closest]
    height = np.einsum("nc,nc->n", points - skin[closest], normals)
    rows = np.concatenate([np.broadcast_to(np.arange(grid[1])[:, None], grid).ravel() for grid in held.grids])
    return np.asarray(np.where(rows > 0, np.maximum(_CLEAR * rows - height, 0.0), 0.0)[:, None] * normals)
