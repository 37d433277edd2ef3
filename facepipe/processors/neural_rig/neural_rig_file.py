"""Neural rigs in files: ``.fpnr``, arrays and JSON in the layout of safetensors."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from facepipe.core.errors import InputError
from facepipe.processors.database.array_file import Content, read_arrays, write_arrays
from facepipe.processors.neural_rig import encoder_arrays
from facepipe.processors.neural_rig.control_json import controls_from
from facepipe.rig import Rig
from facepipe.rig.neural_encoder import NeuralEncoder
from facepipe.rig.neural_rig import NeuralRig

KIND = "facepipe neural rig 1"
SUFFIX = ".fpnr"
_ARRAYS = ("rest", "shapes", "linear", "hidden", "hidden_bias", "last", "last_bias")
_BONE_ARRAYS = ("mesh_offsets", "parents", "rest", "inverse_bind", "parent_world")
_BONE_TEXTS = ("name", "mesh_names", "joints")
_SPARSE = ("data", "indices", "indptr")


def save_neural_rig(
    rig: NeuralRig, path: Path, report: Mapping[str, Any], encoder: NeuralEncoder | None = None
) -> None:
    """Write atomically; float32.

    :param report: JSON of its training
    :param encoder: from points back to the controls, if there is one
    :raises InputError: another suffix than .fpnr, an encoder of other controls, or a file that can't be written
    :raises TopologyError: an encoder of another topology
    """
    if path.suffix.lower() != SUFFIX:
        raise InputError(path, f"suffix '{path.suffix}', expected {SUFFIX}")
    content: dict[str, Any] = {
        "controls": [dataclasses.asdict(control) for control in rig.controls],
        "topology": rig.topology,
        "report": dict(report),
    }
    arrays: dict[str, Any] = {name: getattr(rig, name).astype(np.float32) for name in _ARRAYS}
    if rig.bones is not None:
        content["bones"] = {name: getattr(rig.bones, name) for name in _BONE_TEXTS}
        arrays |= {f"bones.{name}": np.asarray(getattr(rig.bones, name)) for name in _BONE_ARRAYS}
        arrays |= {f"bones.weights.{name}": np.asarray(getattr(rig.bones.influences, name)) for name in _SPARSE}
        arrays["channels"] = rig.channels
    if encoder is not None:
        _check_encoder(path, rig, encoder)
        content[encoder_arrays.KEY], more = encoder_arrays.to_arrays(encoder)
        arrays |= more
    write_arrays(path, KIND, content, arrays)


def load_neural_rig(path: Path) -> NeuralRig:
    """:raises InputError: not readable, damaged, or not such a file"""
    found = read_arrays(path, KIND)
    try:
        controls = controls_from(found.content["controls"], f"{path} -> controls")
        arrays: dict[str, Any] = {name: np.asarray(found.arrays[name], np.float64) for name in _ARRAYS}
        rig = NeuralRig(controls=controls, topology=str(found.content["topology"]), **arrays)
        if "bones" in found.content:
            bones = _bones(path, rig, found)
            rig = dataclasses.replace(rig, bones=bones, channels=np.asarray(found.arrays["channels"], np.int64))
    except (KeyError, TypeError) as error:
        raise InputError(path, f"lacks {error}, expected a neural rig") from None
    _check_sizes(path, rig)
    return rig


def has_encoder(path: Path) -> bool:
    """Whether the file of a neural rig holds an encoder too.

    :raises InputError: not readable, damaged, or not such a file
    """
    return encoder_arrays.KEY in read_arrays(path, KIND).content


def load_encoder(path: Path) -> NeuralEncoder:
    """The encoder in the file of a neural rig.

    :raises InputError: not readable, damaged, not such a file, or one without an encoder
    """
    return encoder_arrays.from_arrays(path, read_arrays(path, KIND))


def _check_encoder(path: Path, rig: NeuralRig, encoder: NeuralEncoder) -> None:
    encoder.check(rig.topology, f"{path} -> encoder")
    if encoder.controls != rig.controls:
        raise InputError(f"{path} -> encoder", "other controls than the rig's, expected the same in the same order")


def _bones(path: Path, rig: NeuralRig, found: Content) -> Rig:
    texts = {name: found.content["bones"][name] for name in _BONE_TEXTS}
    arrays = {name: np.asarray(found.arrays[f"bones.{name}"]) for name in _BONE_ARRAYS}
    joints = tuple(map(str, texts["joints"]))
    parents = arrays["parents"]
    for name, shape in {
        "rest": (len(joints), 4, 4),
        "inverse_bind": (len(joints), 4, 4),
        "parent_world": (4, 4),
        "parents": (len(joints),),
        "mesh_offsets": (len(texts["mesh_names"]) + 1,),
    }.items():
        if arrays[name].shape != shape:
            raise InputError(f"{path} -> bones.{name}", f"shape {arrays[name].shape}, expected {shape}")
    if not ((parents >= -1) & (parents < np.arange(len(joints)))).all():
        raise InputError(f"{path} -> bones.parents", "a joint before its parent, expected parents first")
    weights = [np.asarray(found.arrays[f"bones.weights.{name}"]) for name in _SPARSE]
    try:
        influences = sparse.csr_array(tuple(weights), shape=(len(rig.rest), len(joints) + 1))
        influences.check_format(full_check=True)
    except ValueError as error:
        raise InputError(f"{path} -> bones.weights", f"{error}, expected sparse weights") from None
    return Rig(
        name=str(texts["name"]),
        mesh_names=tuple(map(str, texts["mesh_names"])),
        joints=joints,
        points=rig.rest,
        shapes=(),
        targets=(),
        influences=influences,
        **arrays,
    )


def _check_sizes(path: Path, rig: NeuralRig) -> None:
    count, points, units, controls = len(rig.shapes), len(rig.rest), len(rig.hidden), len(rig.controls)
    outputs = count + len(rig.channels)
    for name, shape in {
        "rest": (points, 3),
        "shapes": (count, points, 3),
        "linear": (controls, outputs),
        "hidden": (units, controls),
        "hidden_bias": (units,),
        "last": (outputs, units),
        "last_bias": (outputs,),
        "channels": (len(rig.channels), 2),
    }.items():
        if getattr(rig, name).shape != shape:
            raise InputError(f"{path} -> {name}", f"shape {getattr(rig, name).shape}, expected {shape}")
    joints = 0 if rig.bones is None else len(rig.bones.joints)
    if len(rig.channels) and not ((rig.channels >= 0) & (rig.channels < (joints, 9))).all():
        raise InputError(f"{path} -> channels", f"a channel of no joint, expected 9 of each of {joints}")
