"""The domes of `scan_domes` with two soft shapes, and scans of a person whose own shapes differ from the template's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import scan_domes
from faces import with_head
from scan_domes import POSE

from facepipe.importers.scan_landmarks import write_scan_landmarks
from facepipe.importers.scan_ply import write_ply
from facepipe.parts import Blendshape, FaceParts
from facepipe.scans import Scan, ScanLandmarks

PERSON = 9
SIDE = 31
OWN = {"jawOpen": 1.3, "browUp": 0.75}  # how much more or less than the template the person moves
_WAYS = {"jawOpen": (0.0, -6.0, -2.0), "browUp": (0.0, 4.0, 1.5)}  # mm


def motion(name: str, places: np.ndarray) -> np.ndarray:
    """(n, 3) millimetres that the template's shape moves (n, 2) places by."""
    y = places[:, 1]
    share = 1.0 / (1.0 + np.exp((y + 12.0) / 4.0)) if name == "jawOpen" else np.exp(-(((y - 26.0) / 9.0) ** 2))
    return np.asarray(np.where(share > 0.01, share, 0.0)[:, None] * np.array(_WAYS[name]))


def template_motion(name: str) -> np.ndarray:
    """(n, 3) millimetres over the points of the face's dome."""
    return motion(name, scan_domes.grid(SIDE)[0])


def face(seed: int = 0) -> FaceParts:
    """A dome of a person with the template's shapes, without clip and slider."""
    parts = scan_domes.face(seed)
    shapes = []
    for name in OWN:
        delta = 0.1 * template_motion(name)
        moved = np.flatnonzero(np.linalg.norm(delta, axis=1) > 0)
        shapes.append(Blendshape(name=name, point_indices=moved.astype(np.int32), offsets=delta[moved]))
    return replace(with_head(parts, blendshapes=tuple(shapes)), animations=(), sliders=())


def scan(weights: dict[str, float], side: int = 61) -> tuple[Scan, ScanLandmarks]:
    """The person with these weights of the own shapes, on another grid, in centimetres and some pose."""

    def moved(places: np.ndarray) -> np.ndarray:
        delta = sum((weight * OWN[name] * motion(name, places) for name, weight in weights.items()), np.zeros(3))
        return POSE.apply(scan_domes.dome(places, PERSON) + delta)

    places, triangles = scan_domes.grid(side)
    marks = scan_domes.face(0).meshes[0].landmarks["multipie68"].indices
    return (
        Scan(name="scan", points=moved(places), triangles=triangles.astype(np.int32)),
        ScanLandmarks(points=moved(scan_domes.grid(SIDE)[0][marks])),
    )


def put(path: Path, weights: dict[str, float], side: int = 61) -> None:
    """A scan with its landmarks beside it."""
    seen, landmarks = scan(weights, side)
    write_ply(seen, path)
    write_scan_landmarks(landmarks, path.with_suffix(".landmarks.json"))
