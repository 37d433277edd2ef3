"""UsdSkel stages as other tools write them, without our schemas, and what the importer makes of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from faces import replace_mesh, tiny_face
from pxr import Usd

from facepipe import parts as p
from facepipe.importers import load
from facepipe.importers.usd import Options
from facepipe.stage.author import author
from facepipe.stage.recipes import Imported

HEAD, TEETH, SKELETON = "/Rich/Head", "/Rich/Teeth", "/Rich/Skeleton"


def turned(angle: float, translation: tuple[float, float, float], scale: float = 1.0) -> np.ndarray:
    matrix = np.eye(4)
    c, s = np.cos(angle), np.sin(angle)
    matrix[:3, :3] = scale * np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    matrix[:3, 3] = translation
    return matrix


def rich_face() -> p.FaceParts:
    """A face whose skeleton and meshes have transforms of their own, bound where it rests."""
    parts = replace(tiny_face(3), name="Rich")
    head, teeth = parts.meshes
    place = turned(0.4, (1.0, 2.0, -0.5), 1.3)
    skeleton = parts.skeleton
    skeleton = replace(skeleton, transform=place, bind_transforms=place @ skeleton.bind_transforms)
    assert head.skin is not None
    skin = replace(head.skin, geom_bind_transform=turned(-0.2, (0.3, 0.1, 0.0)))
    head = replace_mesh(head, skin=skin, transform=turned(0.1, (0.5, 0, 0)), regions={}, point_subsets={}, landmarks={})
    teeth = replace_mesh(teeth, transform=turned(0.3, (0.1, 0.2, 0.3)))
    return replace(parts, meshes=(replace(head, anchor=None), teeth), skeleton=skeleton)


def foreign_stage(parts: p.FaceParts) -> Usd.Stage:
    """The face as a plain UsdSkel stage, without any of our schemas."""
    stage = author(parts)
    for prim in stage.Traverse():
        for name in prim.GetAppliedSchemas():
            if name.startswith("Facepipe"):
                prim.RemoveAppliedSchema(name)
        for one in prim.GetAuthoredProperties():
            if "facepipe:" in one.GetName():
                prim.RemoveProperty(one.GetName())
    return stage


def written(stage: Usd.Stage, path: Path) -> Path:
    assert stage.GetRootLayer().Export(str(path))
    return path


def read(path: Path, **options: str) -> Imported:
    return load("usd", path, Options(**options))


def warned(imported: Imported, text: str) -> None:
    assert any(text in warning for warning in imported.warnings), imported.warnings
