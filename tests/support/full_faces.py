"""Faces whose every field is filled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from faces import replace_mesh, tiny_face

from facepipe import parts as p

PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de0000000c4944415408d763f8cfc0000003010100"
    "18dd8db00000000049454e44ae426082"
)


def full_photo() -> p.PhotoView:
    """Every field of a photo filled; floats are those of float32."""
    turn = np.array([[0.0, 0.0, 1.0, 2.0], [0.0, 1.0, 0.0, -3.0], [-1.0, 0.0, 0.0, 40.0], [0.0, 0.0, 0.0, 1.0]])
    return p.PhotoView(
        name="portrait",
        image="my portrait.png",
        width=640,
        height=960,
        transform=turn,
        focal=1234.0625,
        center=(300.25, 500.5),
        clipping=(1.5, 400.0),
        light=np.random.default_rng(3).normal(size=(9, 3)).astype(np.float32),
        key=p.KeyLamp(direction=(0.5, -0.25, 2.0), color=(0.75, 0.0, 0.5), shine=1.25, exponent=30.5),
        tint={"Skin": (1.25, 0.875, 0.75)},
        landmark_error=2.5,
        animation="pose",
    )


def full_face() -> p.FaceParts:
    """Every field of the parts filled."""
    parts = tiny_face()
    head, teeth = parts.meshes
    texture = p.TextureInput(texture=p.Texture(name="skin.png", data=PNG), scale=(0.5, 0.5, 0.5, 1.0), wrap_s="clamp")
    seam = p.UvSet(name="st", values=np.random.default_rng(0).random((7, 2)).astype(np.float32))
    seam = replace(seam, indices=(np.arange(len(head.face_vertex_indices)) % 7).astype(np.int32))
    head = replace_mesh(
        head,
        uv_sets=(seam,),
        normals=np.tile(np.float32([0, 0, 1]), (36, 1)),
        colors=np.full((36, 3), 0.25, np.float32),
        material="Skin",
        material_faces=(p.MaterialFaces(material="Lips", faces=np.array([3, 4], np.int32)),),
        double_sided=True,
    )
    times = np.array([0.0, 0.25, 1.0])
    clip = p.Animation(
        name="clip",
        times=times,
        joints=("root/jaw",),
        translations=np.random.default_rng(1).random((3, 1, 3)).astype(np.float32),
        rotations=np.tile(np.float32([0, 0, 0.6, 0.8]), (3, 1, 1)),
        scales=np.full((3, 1, 3), 1.5, np.float32),
        coefficients=np.random.default_rng(2).random((3, 1, 9)).astype(np.float32),
        shapes=("jawOpen",),
        shape_weights=np.float32([[0], [0.5], [1]]),
    )
    pose = replace(clip, name="pose", times=None, coefficients=None, shapes=(), shape_weights=None)
    pose = replace(pose, translations=pose.translations[:1], rotations=pose.rotations[:1], scales=pose.scales[:1])
    limits = np.tile(np.float32([1, 1, 1, 0.5, 0.5, 0.5, 2, 2, 2]), (3, 1))
    return replace(
        parts,
        up_axis="Z",
        meters_per_unit=0.1,
        meshes=(head, teeth),
        animations=(clip, pose),
        sliders=(p.Slider(name="open", group="mouth", value=0.5, channels=(("root/jaw", "rx", 0.5),)),),
        bone_limits=p.BoneLimits(lower=-limits, upper=limits),
        materials=(
            p.Material(name="Skin", diffuse_color=texture, roughness=0.75, normal=replace(texture, scale=(2, 2, 2, 1))),
            p.Material(name="Lips", diffuse_color=(0.5, 0.25, 0.125), opacity=0.5, opacity_threshold=0.25, ior=1.25),
        ),
        attach_joint="root/spine/head",
        attribution="(c) somebody, CC0",
        photos=(full_photo(),),
        recipe=p.Recipe(verb="import x", sources=("a",), digests=("sha256:0",), options={"b": [1, 2]}, version="0"),
    )


def good_face() -> p.FaceParts:
    """Every field of the parts filled, each as the convention asks."""
    parts = full_face()
    skin, lips = parts.materials
    assert isinstance(skin.normal, p.TextureInput)
    normal = replace(skin.normal, scale=(2.0, 2.0, 2.0, 1.0), bias=(-1.0, -1.0, -1.0, 0.0))
    return replace(parts, materials=(replace(skin, normal=normal), lips))
