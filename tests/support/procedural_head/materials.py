"""Materials of the sample, in the identity's colours."""

from __future__ import annotations

from facepipe.core.arrays import FloatArray
from facepipe.parts import Material
from procedural_head import eyeballs, strands, teeth, texture
from procedural_head.identity import Color, Identity


def build(who: Identity, skin: FloatArray) -> tuple[Material, ...]:
    """Skin (from the head's (n, 3) colours), eyes, teeth, tongue and hair."""
    eye = eyeballs.texture(who)
    brow_colors = strands.brow_colors(who).mean(axis=0)
    return (
        Material(name="Skin", diffuse_color=texture.skin(skin), roughness=0.55),
        Material(name="Sclera", diffuse_color=eye, roughness=0.15),
        Material(name="Iris", diffuse_color=eye, roughness=0.1),
        Material(name="Pupil", diffuse_color=(0.004, 0.004, 0.004), roughness=0.05),
        Material(name="Teeth", diffuse_color=teeth.IVORY, roughness=0.25),
        Material(name="Gums", diffuse_color=teeth.GUM, roughness=0.35),
        Material(name="Tongue", diffuse_color=teeth.TONGUE, roughness=0.35),
        Material(name="Brows", diffuse_color=_color(brow_colors), roughness=0.8),
        Material(name="Hair", diffuse_color=who.hair, roughness=0.7),
    )


def _color(values: FloatArray) -> Color:
    return (float(values[0]), float(values[1]), float(values[2]))
