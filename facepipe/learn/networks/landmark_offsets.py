"""How far a landmark network's places are off those of the head in the box as a rule, and landmarks without that.

A network learns places on the heads of its training, and too flat a face: the nose's tip stays behind when a head
turns. Both are about constant as offsets in space, so they are taken off as the head is turned.
`training/landmark_offsets.py` measures them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.reading import read_json
from facepipe.geometry.landmarks import turned_view

_CONTOUR = slice(0, 17)  # landmarks that slide: they show no pose


@dataclass(frozen=True, kw_only=True)
class LandmarkOffsets:
    """Right, up and front of the face; distances of the outer eye corners."""

    places: FloatArray  # (68, 3) of the average head
    offsets: FloatArray  # (68, 3) from the head's landmarks to what the network takes for them

    def corrected(self, landmarks: FloatArray) -> FloatArray:
        """(68, 2) places of the head's landmarks in a picture, from those that the network found, y down."""
        view = turned_view(self.places[_CONTOUR.stop :], landmarks[_CONTOUR.stop :])
        return np.asarray(landmarks - self.offsets @ view.T)


@cache
def own_offsets() -> LandmarkOffsets:
    """Those of the landmark network that comes with facepipe."""
    content: Any = read_json(Path(str(files("facepipe.learn.networks") / "landmark_offsets.json")), 1 << 20)
    return LandmarkOffsets(places=np.array(content["places"]), offsets=np.array(content["offsets"]))
