"""Makes the samples of this folder: `python samples/generate.py`. Small faces: some shapes of the sample head."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from facepipe.heads import make
from facepipe.parts import Blendshape, FaceParts
from facepipe.stage import save_parts

SEEDS = (0, 5)
SHAPES = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight", "mouthSmileLeft", "mouthSmileRight", "mouthPucker", "browInnerUp")


def small(parts: FaceParts) -> FaceParts:
    """The face with `SHAPES` only, without normal offsets."""

    def keep(shape: Blendshape) -> Blendshape:
        inbetweens = tuple(replace(one, normal_offsets=None) for one in shape.inbetweens)
        return replace(shape, normal_offsets=None, inbetweens=inbetweens)

    meshes = tuple(
        replace(mesh, blendshapes=tuple(keep(shape) for shape in mesh.blendshapes if shape.name in SHAPES))
        for mesh in parts.meshes
    )
    sliders = tuple(one for one in parts.sliders if {shape for shape, _ in one.shapes} <= set(SHAPES))
    return replace(parts, meshes=meshes, animations=(), sliders=sliders)


if __name__ == "__main__":
    for seed in SEEDS:
        save_parts(small(make(seed)), Path(__file__).parent / f"head{seed}.usdz")
