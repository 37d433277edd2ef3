"""Visemes, the mouths of sounds: Oculus's 15 as mixes of ARKit shapes, Azure's 22 ids as mixes of Oculus's.

The tables are in ``visemes.json``, with their source. A shape that ARKit has by sides stands there without: both have
its weight.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files

from facepipe.rig.conventions import ARKIT_SHAPES

_TABLES = json.loads(files("facepipe.rig").joinpath("visemes.json").read_text(encoding="utf-8"))
OCULUS_VISEMES: Mapping[str, Mapping[str, float]] = {  # viseme -> ARKit shape -> weight
    viseme: {
        shape: weight
        for name, weight in mix.items()
        for shape in ([name] if name in ARKIT_SHAPES else [f"{name}Left", f"{name}Right"])
    }
    for viseme, mix in _TABLES["oculus"].items()
}
AZURE_VISEMES: tuple[Mapping[str, float], ...] = tuple(_TABLES["azure"])  # id -> viseme -> weight
AZURE_BLENDSHAPES: tuple[str, ...] = tuple(_TABLES["azure_blendshapes"])  # the order of the numbers of its frames
