"""Materials of the sample, in the identity's colours."""

from __future__ import annotations

from facepipe.parts import FloatArray, Material
from facepipe.sample import texture
from facepipe.sample.identity import Color, Identity


def build(who: Identity, skin: FloatArray) -> tuple[Material, ...]:
    """Skin (from the head's (n, 3) colours), eyes, teeth, tongue and hair."""
    return (
        Material(name="Skin", diffuse_color=texture.skin(skin), roughness=0.55),
        Material(name="Sclera", diffuse_color=(0.72, 0.70, 0.68), roughness=0.15),
        Material(name="Iris", diffuse_color=who.iris, roughness=0.1),
        Material(name="Pupil", diffuse_color=(0.004, 0.004, 0.004), roughness=0.05),
        Material(name="Teeth", diffuse_color=(0.82, 0.76, 0.64), roughness=0.25),
        Material(name="Tongue", diffuse_color=(0.45, 0.13, 0.12), roughness=0.35),
        Material(name="Hair", diffuse_color=_darker(who.hair), roughness=0.7),
    )


def _darker(color: Color) -> Color:
    return (color[0] * 0.8, color[1] * 0.8, color[2] * 0.8)
