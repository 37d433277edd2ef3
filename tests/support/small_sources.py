"""Small faces to blend, and the weights of a blend; a folder with such faces is in conftest.py."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from faces import replace_mesh, tiny_face, with_meshes

import facepipe
from facepipe.parts import FaceParts
from facepipe.stage import save_parts

WORDS = ("--set", "mouth=0.75,0.25", "--default", "0.5,0.5")


def made(seed: int) -> FaceParts:
    """A small face with points of its own."""
    parts, rng = tiny_face(seed), np.random.default_rng(seed)
    meshes = [replace_mesh(mesh, points=mesh.points + rng.normal(0, 0.05, mesh.points.shape)) for mesh in parts.meshes]
    return dataclasses.replace(parts, meshes=tuple(meshes))


def points(path: str) -> Any:
    return facepipe.open(path).evaluate()


def saved(parts: FaceParts, name: str, **mesh_changes: Any) -> None:
    """Save the face with every mesh changed."""
    save_parts(with_meshes(parts, **mesh_changes), Path(name))
