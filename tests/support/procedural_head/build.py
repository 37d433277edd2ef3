"""Puts the sample's parts together."""

from __future__ import annotations

from dataclasses import replace

from facepipe.parts import Blendshape, FaceParts, Mesh, Recipe, Skin
from procedural_head import (
    clips,
    colors,
    controls,
    fields,
    identity,
    landmarks,
    materials,
    meshes,
    regions,
    rig,
    shapes,
    weights,
)
from procedural_head.meshes import Neutral
from procedural_head.rig import HEAD, JAW, Rig


def make(seed: int = 0) -> FaceParts:
    """A procedural head: Y up, looking along +Z, +X to the subject's left, in centimetres.

    The topology (and so every index) is the same for all seeds; seed 0 is the average head. Same seed, same arrays.
    """
    who = identity.from_seed(seed)
    neutral = meshes.build(who)
    masks = fields.build(neutral.head.points, who)
    bones = rig.build(neutral.head.points, who)
    blendshapes = shapes.build(neutral, masks)
    return FaceParts(
        name="Face",
        meters_per_unit=0.01,
        meshes=_finished(neutral, _skins(neutral, masks, bones), blendshapes),
        skeleton=bones.skeleton,
        animations=clips.build(bones),
        played=clips.TALK,
        sliders=controls.sliders(),
        bone_limits=controls.bone_limits(bones.skeleton),
        materials=materials.build(who, colors.head(neutral.head.points, who)),
        recipe=Recipe(verb="sample", options={"seed": seed}),
    )


def _skins(neutral: Neutral, masks: fields.Fields, bones: Rig) -> dict[str, Skin]:
    head = weights.head(masks, bones)
    strips = neutral.lash_strips
    skins = {
        "Head": weights.strongest(head),
        "TeethUpper": weights.rigid(len(neutral.teeth[0].points), bones.index(HEAD)),
        "TeethLower": weights.rigid(len(neutral.teeth[1].points), bones.index(JAW)),
        "Tongue": weights.tongue(neutral.tongue.points, bones),
        "Brows": weights.strongest(neutral.brow_strips.attachment.carry(head)),
        "Lashes": weights.strongest(head[strips.rim]),
        "Hair": weights.rigid(len(neutral.hair.points), bones.index(HEAD)),
    }
    for eye in neutral.eyeballs:
        skins[eye.name] = weights.rigid(len(eye.points), bones.index("e" + eye.name[1:]))
    return skins


def _finished(neutral: Neutral, skins: dict[str, Skin], blendshapes: dict[str, list[Blendshape]]) -> tuple[Mesh, ...]:
    """The meshes with skin, shapes, regions and landmarks."""
    head = replace(
        neutral.head,
        regions=regions.soft(),
        point_subsets=regions.subsets(),
        landmarks={"multipie68": landmarks.multipie68()},
        anchor=landmarks.anchor(),
    )
    loose = [(eye, "eyes") for eye in neutral.eyeballs]
    loose += [(neutral.teeth[0], "mouth"), (neutral.teeth[1], "mouth"), (neutral.tongue, "mouth")]
    loose += [(neutral.brows, "eyebrows"), (neutral.lashes, "eyes"), (neutral.hair, "forehead")]
    masked = [replace(mesh, regions=regions.whole(len(mesh.points), name)) for mesh, name in loose]
    return tuple(
        replace(mesh, skin=skins[mesh.name], blendshapes=tuple(blendshapes.get(mesh.name, ())))
        for mesh in (head, *masked)
    )
