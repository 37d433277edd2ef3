"""A square of skin with wrinkles on either half, and what they are known to do."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from facepipe.parts import (
    Blendshape,
    FaceParts,
    Material,
    Mesh,
    Skeleton,
    Skin,
    Texture,
    TextureInput,
    UvSet,
    WrinkleRegion,
    Wrinkles,
)

TEXELS = 64
BASE = 0.4  # linear, of the skin
GAINS = {"left": (("smile", 1.0), ("squint", 0.5)), "right": (("frown", 0.75),)}


def picture(name: str, values: np.ndarray) -> Texture:
    """A PNG of (h, w, 3) values 0..1."""
    stream = io.BytesIO()
    Image.fromarray(np.rint(values * 255).astype(np.uint8)).save(stream, "PNG")
    return Texture(name=name, data=stream.getvalue())


def normal_map(texture: Texture) -> TextureInput:
    """Normals by their usual scale and bias."""
    return TextureInput(texture=texture, scale=(2.0, 2.0, 2.0, 1.0), bias=(-1.0, -1.0, -1.0, 0.0))


def maps() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals, tints and masks (TEXELS, TEXELS, 3) of 0..1, top row first, smooth from texel to texel."""
    v, u = 1 - (np.mgrid[:TEXELS, :TEXELS] + 0.5) / TEXELS
    u = 1 - u
    x, y = 0.4 * np.sin(2 * np.pi * u), 0.3 * np.cos(2 * np.pi * v)
    normals = np.stack([0.5 + x / 2, 0.5 + y / 2, np.full_like(u, 0.95)], axis=-1)
    tints = np.stack([0.6 + 0.3 * u, 0.9 - 0.4 * v, np.full_like(u, 0.7)], axis=-1)
    left = np.clip(2 * (0.75 - u), 0, 1)  # whole on a quarter, none on the last
    return normals, tints, np.stack([left, 1 - left, np.zeros_like(u)], axis=-1)


def wrinkled_square() -> FaceParts:
    """A square from -1 to 1 in centimetres that faces +Z; its shapes move it by nothing that one could see."""
    normals, tints, masks = maps()
    own = picture("own.png", np.broadcast_to([0.5 + 0.1, 0.5, 0.99], (TEXELS, TEXELS, 3)))
    mask = picture("masks.png", masks)
    material = Material(
        name="Skin",
        diffuse_color=(BASE, BASE, BASE),
        roughness=1.0,
        ior=1.0,
        normal=normal_map(own),
        wrinkles=Wrinkles(
            normal=normal_map(picture("folds.png", normals)),
            tint=TextureInput(texture=picture("tints.png", tints)),
            regions=(
                WrinkleRegion(name="left", mask=TextureInput(texture=mask, channels="r"), shapes=GAINS["left"]),
                WrinkleRegion(name="right", mask=TextureInput(texture=mask, channels="g"), shapes=GAINS["right"]),
            ),
        ),
    )
    points = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], float)
    still = np.full((1, 3), 1e-6)
    mesh = Mesh(
        name="Square",
        points=points,
        face_vertex_counts=np.array([4], np.int32),
        face_vertex_indices=np.arange(4, dtype=np.int32),
        uv_sets=(UvSet(values=(points[:, :2] + 1) / 2),),
        blendshapes=tuple(
            Blendshape(name=name, point_indices=np.zeros(1, np.int32), offsets=still)
            for name in ("smile", "squint", "frown")
        ),
        skin=Skin(joint_indices=np.zeros((4, 1), np.int32), joint_weights=np.ones((4, 1))),
        material="Skin",
    )
    skeleton = Skeleton(joints=("root",), bind_transforms=np.eye(4)[None], rest_transforms=np.eye(4)[None])
    return FaceParts(meshes=(mesh,), materials=(material,), skeleton=skeleton)


def shares(uv: np.ndarray, weights: dict[str, float]) -> np.ndarray:
    """(m, 1) how strong the wrinkles of the square are at UVs (m, 2)."""
    left = np.clip(2 * (0.75 - uv[:, :1]), 0, 1)
    strength = {
        name: min(max(sum(gain * weights.get(shape, 0.0) for shape, gain in own), 0.0), 1.0)
        for name, own in GAINS.items()
    }
    return np.minimum(strength["left"] * left + strength["right"] * (1 - left), 1)


def known(uv: np.ndarray, weights: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """(m, 3) linear base colours and (m, 3) unit normals of the square at UVs (m, 2), by the rule itself."""
    u, v, share = uv[:, 0], uv[:, 1], shares(uv, weights)
    tints = np.stack([0.6 + 0.3 * u, 0.9 - 0.4 * v, np.full_like(u, 0.7)], axis=-1)
    normals = np.stack([np.full_like(u, 0.2), np.zeros_like(u), np.full_like(u, 0.98)], axis=-1)
    normals[:, 0] += share[:, 0] * 0.4 * np.sin(2 * np.pi * u)
    normals[:, 1] += share[:, 0] * 0.3 * np.cos(2 * np.pi * v)
    return BASE * (1 + share * (tints - 1)), normals / np.linalg.norm(normals, axis=1, keepdims=True)
