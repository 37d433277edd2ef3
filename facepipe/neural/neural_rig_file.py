"""Neural rigs in files: ``.fpnr``, arrays and JSON in the layout of safetensors."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from facepipe.core.errors import InputError
from facepipe.declare import from_json
from facepipe.rig.neural_rig import Control, EncoderLayer, NeuralEncoder, NeuralRig
from facepipe.rig.rig import Rig, SkinWeights
from facepipe.verbs.array_file import Content, read_arrays, write_arrays

KIND = "facepipe neural rig 1"
SUFFIX = ".fpnr"
_ARRAYS = ("rest", "shapes", "linear", "hidden", "hidden_bias", "last", "last_bias")
_BONE_ARRAYS = ("mesh_offsets", "parents", "rest", "inverse_bind", "parent_world")
_BONE_TEXTS = ("name", "mesh_names", "joints")
_SPARSE = ("data", "indices", "indptr")
_ENCODER = "encoder"
_ENCODER_ARRAYS: tuple[str, ...] = ("rest", "point", "point_bias", "feature", "feature_bias", "token", "places")
_ENCODER_ARRAYS += ("reduce", "reduce_bias", "last", "straight", "offset")
_LAYER_ARRAYS = tuple(field.name for field in dataclasses.fields(EncoderLayer))


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
        encoder.check(rig.topology, f"{path} -> encoder")
        if encoder.controls != rig.controls:
            raise InputError(f"{path} -> encoder", "other controls than the rig's, expected the same in the same order")
        content[_ENCODER] = {
            "controls": [dataclasses.asdict(control) for control in encoder.controls],
            "heads": encoder.heads,
            "layers": len(encoder.layers),
            "point_count": encoder.point_count,
            "scale": encoder.scale,
            "topology": encoder.topology,
        }
        more = {name: getattr(encoder, name).astype(np.float32) for name in _ENCODER_ARRAYS}
        for number, layer in enumerate(encoder.layers):
            more |= {f"{number}.{name}": getattr(layer, name).astype(np.float32) for name in _LAYER_ARRAYS}
        arrays |= {f"{_ENCODER}.{name}": array for name, array in more.items()}
        arrays[f"{_ENCODER}.chosen"] = encoder.chosen.astype(np.int32)
    write_arrays(path, KIND, content, arrays)


def load_neural_rig(path: Path) -> NeuralRig:
    """:raises InputError: not readable, damaged, or not such a file"""
    file = read_arrays(path, KIND)
    try:
        controls = _controls_from(file.content["controls"], f"{path} -> controls")
        arrays: dict[str, Any] = {name: np.asarray(file.arrays[name], np.float64) for name in _ARRAYS}
        rig = NeuralRig(controls=controls, topology=str(file.content["topology"]), **arrays)
        if "bones" in file.content:
            bones = _bones(path, rig, file)
            rig = dataclasses.replace(rig, bones=bones, channels=np.asarray(file.arrays["channels"], np.int64))
    except (KeyError, TypeError) as error:
        raise InputError(path, f"lacks {error}, expected a neural rig") from None
    count, points, units = len(rig.shapes), len(rig.rest), len(rig.hidden)
    outputs = count + len(rig.channels)
    for name, shape in {
        "rest": (points, 3),
        "shapes": (count, points, 3),
        "linear": (len(controls), outputs),
        "hidden": (units, len(controls)),
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
    return rig


def has_encoder(path: Path) -> bool:
    """Whether the file of a neural rig holds an encoder too.

    :raises InputError: not readable, damaged, or not such a file
    """
    return _ENCODER in read_arrays(path, KIND).content


def load_encoder(path: Path) -> NeuralEncoder:
    """The encoder in the file of a neural rig.

    :raises InputError: not readable, damaged, not such a file, or one without an encoder
    """
    file = read_arrays(path, KIND)
    content = file.content.get(_ENCODER)
    if content is None:
        raise InputError(path, "has no encoder, expected a neural rig that was trained with one")
    try:
        layers = tuple(
            EncoderLayer(**_encoder_values(file, f"{i}.", _LAYER_ARRAYS)) for i in range(int(content["layers"]))
        )
        encoder = NeuralEncoder(
            controls=_controls_from(content["controls"], f"{path} -> {_ENCODER} -> controls"),
            topology=str(content["topology"]),
            point_count=int(content["point_count"]),
            chosen=np.asarray(file.arrays[f"{_ENCODER}.chosen"], np.int64),
            scale=float(content["scale"]),
            heads=int(content["heads"]),
            layers=layers,
            **_encoder_values(file, "", _ENCODER_ARRAYS),
        )
        for name, shape in encoder_shapes(encoder).items():
            holder: Any = encoder
            if "." in name:
                number, name_of = name.split(".")
                holder, name = encoder.layers[int(number)], name_of
            if getattr(holder, name).shape != shape:
                raise InputError(
                    f"{path} -> {_ENCODER}.{name}", f"shape {getattr(holder, name).shape}, expected {shape}"
                )
        low, high = encoder.chosen.min(initial=0), encoder.chosen.max(initial=0)
        if low < 0 or high >= encoder.point_count:
            problem = f"points {low} to {high}, expected some of {encoder.point_count}"
            raise InputError(f"{path} -> {_ENCODER}.chosen", problem)
        if encoder.heads < 1 or encoder.token.shape[1] % encoder.heads or not 0.0 < encoder.scale < np.inf:
            problem = f"{encoder.heads} heads for tokens of {encoder.token.shape[1]}, scale {encoder.scale:g}"
            raise InputError(
                f"{path} -> {_ENCODER}", f"{problem}, expected heads that share a token evenly and a scale above 0"
            )
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise InputError(path, f"its encoder is damaged ({error}), expected a whole one") from None
    return encoder


def _bones(path: Path, rig: NeuralRig, file: Content) -> Rig:
    texts = {name: file.content["bones"][name] for name in _BONE_TEXTS}
    arrays = {name: np.asarray(file.arrays[f"bones.{name}"]) for name in _BONE_ARRAYS}
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
    weights = [np.asarray(file.arrays[f"bones.weights.{name}"]) for name in _SPARSE]
    try:
        influences = sparse.csr_array(tuple(weights), shape=(len(rig.rest), len(joints) + 1))
        # In full: an index beyond its array would be read all the same.
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
        skinning=SkinWeights.from_sparse(influences),
        **arrays,
    )


def _encoder_values(file: Content, prefix: str, names: tuple[str, ...]) -> Mapping[str, Any]:
    return {name: np.asarray(file.arrays[f"{_ENCODER}.{prefix}{name}"], np.float64) for name in names}


def encoder_shapes(encoder: NeuralEncoder) -> dict[str, tuple[int, ...]]:
    """Array -> the shape that it has if it fits the others; those of layer i are called ``i.attend`` ..."""
    points, controls = len(encoder.chosen), len(encoder.controls)
    tokens, units, features = max(len(encoder.places), 1), encoder.point.shape[-1], len(encoder.feature_bias)
    width, reduced = encoder.token.shape[-1], len(encoder.reduce_bias)
    # Sizes are those of arrays that decide them alone; all others have to agree.
    expected: dict[str, tuple[int, ...]] = {
        "chosen": (points // tokens * tokens,),
        "rest": (points, 3),
        "point": (3, units),
        "point_bias": (points, units),
        "feature": (units, features),
        "feature_bias": (features,),
        "token": (points // tokens * features, width),
        "places": (tokens, width),
        "reduce": (tokens * width, reduced),
        "reduce_bias": (reduced,),
        "last": (reduced, controls),
        "straight": (3 * points, controls),
        "offset": (controls,),
    }
    for number, layer in enumerate(encoder.layers):
        wide = len(layer.widen_bias)
        sizes: tuple[tuple[int, ...], ...] = ((width, 3 * width), (3 * width,), (width, width), (width,))
        sizes += ((width, wide), (wide,), (wide, width), (width,))
        expected |= {f"{number}.{name}": shape for name, shape in zip(_LAYER_ARRAYS, sizes, strict=True)}
    return expected


def _controls_from(content: object, where: str) -> tuple[Control, ...]:
    """The controls of a list of objects.

    :raises InputError: no such list, a name twice, or a range that is empty or does not hold its default
    """
    if not isinstance(content, list):
        raise InputError(where, f"{str(content)[:40]}, expected a list of controls")
    read = [from_json(Control, one, f"{where} -> {number}") for number, one in enumerate(content)]
    controls = tuple(  # numpy makes objects of whole numbers beyond 64 bits
        replace(one, minimum=float(one.minimum), maximum=float(one.maximum), default=float(one.default)) for one in read
    )
    for control in controls:
        if not control.minimum <= control.default <= control.maximum or control.minimum == control.maximum:
            expected = f"expected a range with its default, {control.default:g}, in it"
            what = f"from {control.minimum:g} to {control.maximum:g}, {expected}"
            raise InputError(f"{where} -> {control.name[:80]}", what)
    if len({one.name for one in controls}) != len(controls):
        raise InputError(where, "a name twice, expected each once")
    return controls
