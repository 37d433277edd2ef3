"""Neural rigs in files: ``.fpnr``, arrays and JSON in the layout of safetensors."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.errors import InputError
from facepipe.processors.database.array_file import read_arrays, write_arrays
from facepipe.rig.neural_rig import Control, NeuralRig

KIND = "facepipe neural rig 1"
SUFFIX = ".fpnr"
_ARRAYS = ("rest", "shapes", "linear", "hidden", "hidden_bias", "last", "last_bias")


def save_neural_rig(rig: NeuralRig, path: Path, report: Mapping[str, Any]) -> None:
    """Write atomically; float32.

    :param report: JSON of its training
    :raises InputError: another suffix than .fpnr, or a file that can't be written
    """
    if path.suffix != SUFFIX:
        raise InputError(path, f"suffix '{path.suffix}', expected {SUFFIX}")
    content = {
        "controls": [dataclasses.asdict(control) for control in rig.controls],
        "topology": rig.topology,
        "report": dict(report),
    }
    write_arrays(path, KIND, content, {name: getattr(rig, name).astype(np.float32) for name in _ARRAYS})


def load_neural_rig(path: Path) -> NeuralRig:
    """:raises InputError: not readable, damaged, or not such a file"""
    found = read_arrays(path, KIND)
    try:
        controls = tuple(Control(**one) for one in found.content["controls"])
        arrays = {name: np.asarray(found.arrays[name], np.float64) for name in _ARRAYS}
        rig = NeuralRig(controls=controls, topology=str(found.content["topology"]), **arrays)
    except (KeyError, TypeError) as error:
        raise InputError(path, f"lacks {error}, expected a neural rig") from None
    _check_sizes(path, rig)
    return rig


def _check_sizes(path: Path, rig: NeuralRig) -> None:
    count, points, units, controls = len(rig.shapes), len(rig.rest), len(rig.hidden), len(rig.controls)
    for name, shape in {
        "rest": (points, 3),
        "shapes": (count, points, 3),
        "linear": (controls, count),
        "hidden": (units, controls),
        "hidden_bias": (units,),
        "last": (count, units),
        "last_bias": (count,),
    }.items():
        if getattr(rig, name).shape != shape:
            raise InputError(f"{path} -> {name}", f"shape {getattr(rig, name).shape}, expected {shape}")
