"""A folder with a person made of two soft shapes: template, neutral, scans, and the stages of a rebuild over them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import expression_domes
import numpy as np
from expression_domes import PERSON

import facepipe
from facepipe.parts import Recipe
from facepipe.scanning.database import Quality
from facepipe.stage import save_parts
from facepipe.verbs.whole_faces import whole_face

SEEN = {"open": {"jawOpen": 0.8}, "both": {"jawOpen": 0.4, "browUp": 1.0}}
QUALITY = Quality(surface_mean_mm=0.1, surface_p95_mm=0.4, coverage=0.9, flipped_triangles=3)
DOME = expression_domes.SIDE**2  # points of the first mesh


@dataclass(frozen=True)
class Files:
    """A folder with the stages of a rebuild."""

    folder: Path

    def __getitem__(self, name: str) -> Path:
        return self.folder / name

    def personal(self, *more: object) -> tuple[object, ...]:
        return ("personal-template", self["anna.usda"], "--template", self["head.usda"], "-o", self["p.usda"], *more)

    def register(self, name: str, *more: object) -> tuple[object, ...]:
        shown = [f"{shape}={weight}" for shape, weight in SEEN.get(name, {"jawOpen": 0.5}).items()]
        files = ("--personal", self["personal.usda"], "-o", self[f"{name}.usda"])
        return ("register-scan", self[f"{name}.ply"], *files, "--weights", *shown, *more)

    def split(self, *more: object) -> tuple[object, ...]:
        files = [self[f"{name}.usda"] for name in SEEN]
        return ("split-shapes", *files, "--personal", self["personal.usda"], "-o", self["actor.usda"], *more)

    def delta(self, name: str, shape: str) -> np.ndarray:
        """(n, 3) of the dome."""
        return whole_face(facepipe.open(self[name]).parts(), name).deltas[shape][:DOME]


def put_scans(folder: Path) -> Files:
    files = Files(folder)
    save_parts(expression_domes.face(), files["head.usda"])
    recipe = Recipe(verb="fit-neutral", options={"found": {"quality": QUALITY.__dict__}})
    save_parts(replace(expression_domes.face(PERSON), recipe=recipe), files["anna.usda"])
    for name, weights in {"anna": {}, **SEEN}.items():
        expression_domes.put(files[f"{name}.ply"], weights)
    return files
