"""Small made-up faces for tests."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
from PIL import Image

from facepipe import parts as p
from facepipe.parts import Blendshape, FaceParts, Inbetween, Landmarks, Mesh, Skeleton, Skin, UvSet


def grid_mesh(name: str = "Head", size: int = 6, offset: float = 0.0) -> Mesh:
    """A size x size grid of points, quads, in the plane z = offset, with one UV per point."""
    rows, columns = np.divmod(np.arange(size * size), size)
    points = np.stack([columns - (size - 1) / 2, rows + 0.0, np.full(size * size, offset)], axis=1)
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    quads = np.stack([corner, corner + 1, corner + size + 1, corner + size], axis=1)
    uv = np.stack([columns, rows], axis=1) / (size - 1)
    return Mesh(
        name=name,
        points=points,
        face_vertex_counts=np.full(len(quads), 4, np.int32),
        face_vertex_indices=quads.astype(np.int32).ravel(),
        uv_sets=(UvSet(values=uv),),
    )


def skeleton() -> Skeleton:
    """Three joints: root, root/jaw, root/jaw/lip, with rotated and translated rests."""
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rest = np.stack([np.eye(4)] * 3)
    rest[0, :3, 3] = (0.0, 1.0, 0.0)
    rest[1, :3, :3] = quarter
    rest[1, :3, 3] = (0.5, 1.0, 0.2)
    rest[2, :3, 3] = (0.0, 0.5, 0.3)
    world = rest.copy()
    world[1] = world[0] @ rest[1]
    world[2] = world[1] @ rest[2]
    return Skeleton(joints=("root", "root/jaw", "root/jaw/lip"), bind_transforms=world, rest_transforms=rest)


def tiny_face(seed: int = 0) -> FaceParts:
    """A skinned grid with two shapes (one with an inbetween), and a loose mesh that shares a shape."""
    rng = np.random.default_rng(seed)
    head, teeth = grid_mesh(), grid_mesh("Teeth", 3, -0.5)
    count = len(head.points)
    weights = rng.random((count, 3)).astype(np.float32)
    weights /= weights.sum(axis=1, keepdims=True)
    skin = Skin(joint_indices=np.tile(np.arange(3, dtype=np.int32), (count, 1)), joint_weights=weights)
    moved = np.array([1, 4, 9, 20], np.int32)
    open_shape = Blendshape(
        name="jawOpen",
        point_indices=moved,
        offsets=rng.normal(size=(4, 3)).astype(np.float32),
        normal_offsets=rng.normal(size=(4, 3)).astype(np.float32),
        inbetweens=(Inbetween(name="half", weight=0.5, offsets=rng.normal(size=(4, 3)).astype(np.float32)),),
    )
    smile = Blendshape(
        name="mouthSmileLeft",
        point_indices=np.arange(count, dtype=np.int32),
        offsets=rng.normal(size=(count, 3)).astype(np.float32),
    )
    drop = Blendshape(
        name="jawOpen", point_indices=np.arange(9, dtype=np.int32), offsets=np.full((9, 3), (0, -1, 0), np.float32)
    )
    half = rng.random(count).astype(np.float32)
    return FaceParts(
        name="Tiny",
        skeleton=skeleton(),
        meshes=(
            replace_mesh(
                head,
                skin=skin,
                blendshapes=(open_shape, smile),
                regions={"mouth": half, "neck": 1 - half},
                point_subsets={"lips": np.array([3, 5], np.int32)},
                landmarks={"corners": Landmarks(indices=np.array([0, 5], np.int32), names=("left", "right"))},
                anchor=2,
            ),
            replace_mesh(teeth, blendshapes=(drop,)),
        ),
    )


def replace_mesh(mesh: Mesh, **changes: object) -> Mesh:
    """`dataclasses.replace`, typed for meshes."""
    return replace(mesh, **changes)  # type: ignore[arg-type]


def with_meshes(parts: FaceParts, **changes: object) -> FaceParts:
    """The face with fields of all its meshes changed."""
    return replace(parts, meshes=tuple(replace_mesh(mesh, **changes) for mesh in parts.meshes))


def with_head(parts: FaceParts, **changes: object) -> FaceParts:
    """The face with fields of its first mesh changed."""
    return replace(parts, meshes=(replace_mesh(parts.meshes[0], **changes), *parts.meshes[1:]))


def spoiled(array: object, value: float = np.nan) -> np.ndarray:
    """A copy whose last number is `value`."""
    copy = np.array(array)
    copy.flat[-1] = value
    return copy


def painted_face(picture: Image.Image, kind: str = "PNG") -> p.FaceParts:
    """`tiny_face` with one material, whose colour is a picture, in a file of a kind that Pillow writes."""
    stream, parts = io.BytesIO(), tiny_face()
    picture.save(stream, kind)
    colour = p.TextureInput(texture=p.Texture(name="skin.png", data=stream.getvalue()), channels="rgb")
    mesh = replace(parts.meshes[0], material="skin")
    return replace(parts, meshes=(mesh,), materials=(p.Material(name="skin", diffuse_color=colour),))


def clipped_face() -> p.FaceParts:
    """The tiny face with a clip, sliders and a network that all move jawOpen."""
    weights = (np.ones((1, 1)), np.zeros(1))
    clip = p.Animation(name="talk", times=np.arange(2.0), shapes=("jawOpen",), shape_weights=np.array([[0.0], [0.8]]))
    slider = p.Slider(name="open", shapes=(("jawOpen", 0.5), ("mouthSmileLeft", 0.25)))
    network = p.SliderNetwork(sliders=("open",), shapes=("jawOpen",), weights=weights[:1], biases=weights[1:])
    return replace(tiny_face(), animations=(clip,), sliders=(slider,), slider_network=network)
