"""Lower levels of detail of a face: the same face in fewer triangles, that still does all that the face does.

OUT is an override layer over FACE with the variant set `lod`: `lod0` is FACE itself, `lod1` its first lower level. A
level has the meshes, UVs, seams, materials, skin, shapes with inbetweens, regions, landmarks and anchor of the face;
skeleton, sliders and animations are shared. Triangles go where form and motion need them; the skin gets --skin-share of
them, so that teeth don't eat its budget. The report has the error of every level in millimetres: at rest, of each
shape, and of each joint. Needs `pip install 'facepipe[lod]'`.

examples:
  facepipe lod head.usdc -o lods.usdc
  facepipe lod head.usdc --triangles 20000,8000,2500 -o lods.usdc
  facepipe lod --edit lods.usdc --triangles 10000,4000 --force
  facepipe export lods.usdc --lods -o lods.glb
  facepipe export lods.usdc --lod 2 -o far.glb
"""

from __future__ import annotations

import types
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.declare import option, source
from facepipe.kinds import Job, StageAction, action

if TYPE_CHECKING:
    from facepipe.stage import Face
    from facepipe.verbs.lod.levels import LodReport


def read_counts(words: Sequence[str]) -> tuple[int, ...]:
    """Numbers of triangles from words like ``20000,8000``.

    :raises InputError: another word
    """
    try:
        return tuple(int(number) for word in words for number in word.split(","))
    except ValueError:
        raise InputError(" ".join(words), "expected whole numbers, as in 20000,8000,2500") from None


@action("lod", "lower levels of detail of a face", remote=True)
@dataclass(frozen=True, kw_only=True)
class Lod(StageAction["LodReport"]):
    """The action."""

    exported = types.MappingProxyType({"lods": True})

    face: Path = source("face stage")
    triangles: tuple[int, ...] = option(
        (),
        "triangles of each level, in all (default 40, 15 and 5 % of the face's)",
        parse=read_counts,
        metavar="N,N,...",
    )
    skin_share: float = option(0.6, "least share of them that the skin gets", 0.0, 1.0)

    def author(self, face: Face, job: Job) -> LodReport:
        from facepipe.stage.skeleton import author_recipe
        from facepipe.verbs.lod.levels import make_levels

        recipe = job.recipe()
        report = make_levels(face, self.triangles, self.skin_share, job.watch)
        author_recipe(face.prim, recipe)
        return report
