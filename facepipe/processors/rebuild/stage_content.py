"""What stages of a rebuild keep between runs, as arrays and JSON, and back."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.core.reports import Report
from facepipe.geometry.similarity import Similarity


def plain(report: Report) -> dict[str, Any]:
    """A report as JSON holds it."""
    found: dict[str, Any] = json.loads(report.to_json())
    return found


def place_json(place: Similarity) -> dict[str, Any]:
    """A similarity as JSON."""
    return {
        "rotation": place.rotation.tolist(),
        "translation": place.translation.tolist(),
        "scale": place.scale,
    }


def place_of(values: Mapping[str, Any]) -> Similarity:
    """A similarity of JSON."""
    return Similarity(
        rotation=np.array(values["rotation"], np.float64),
        translation=np.array(values["translation"], np.float64),
        scale=float(values["scale"]),
    )


def shape_arrays(shapes: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Shapes by arrays' names; float32, as files hold points."""
    return {f"shape/{name}": np.asarray(delta, np.float32) for name, delta in shapes.items()}


def shapes_of(arrays: Mapping[str, npt.NDArray[Any]], names: list[str]) -> dict[str, FloatArray]:
    """The shapes back, in the order of `names`."""
    return {name: np.asarray(arrays[f"shape/{name}"], np.float64) for name in names}


def options_json(options: Any) -> dict[str, Any]:
    """Options as inputs of a stage."""
    return dataclasses.asdict(options)
