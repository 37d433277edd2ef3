"""Reads ONNX files of others, whole and of known operators, and what they say of themselves in metadata or beside."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from facepipe.core.arrays import AnyArray, FloatArray
from facepipe.core.errors import InputError
from facepipe.core.reading import file_beside, read_bytes, read_json_object
from facepipe.declare import from_json, option
from facepipe.onnx_graph import MAX_BYTES

# In the order of the photo fit's source; left and right are the person's.
CLASSES = (
    *("background", "face", "hair", "leftBrow", "rightBrow", "leftEye", "rightEye"),
    *("nose", "upperLip", "teeth", "lowerLip"),
)

# The channels of BiSeNet networks for face parsing, trained on CelebAMask-HQ.
CELEBAMASK = (
    *("background", "skin", "l_brow", "r_brow", "l_eye", "r_eye", "eye_g", "l_ear", "r_ear", "ear_r"),
    *("nose", "mouth", "u_lip", "l_lip", "neck", "neck_l", "cloth", "hair", "hat"),
)

# Glasses, ears and earrings are on the face; the neck and what is worn are behind it.
_OF_OTHERS = {
    "skin": "face",
    "eye_g": "face",
    "l_ear": "face",
    "r_ear": "face",
    "ear_r": "face",
    "neck": "background",
    "neck_l": "background",
    "cloth": "background",
    "hat": "background",
    "l_brow": "leftBrow",
    "r_brow": "rightBrow",
    "l_eye": "leftEye",
    "r_eye": "rightEye",
    "u_lip": "upperLip",
    "mouth": "teeth",
    "l_lip": "lowerLip",
}
Kind = Literal["content", "identity", "attributes", "landmarks"]
Crop = Literal["face", "arcface"]
Order = Literal["RGB", "BGR"]
Triple = tuple[float, float, float]
KINDS: tuple[Kind, ...] = get_args(Kind)
PROPERTY = "facepipe.features"  # key of the metadata in an ONNX file
_MAX_BYTES = 1 << 20
_IMAGENET: tuple[Triple, Triple] = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
_HALF: tuple[Triple, Triple] = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
DEFAULT_SIZES: Mapping[Kind, int] = {"content": 512, "identity": 112, "attributes": 224, "landmarks": 224}
OLDEST_OPSET, NEWEST_OPSET = 7, 25

_DOMAINS = ("", "ai.onnx")


def class_matrix(labels: Sequence[str]) -> FloatArray:
    """(11, n) 1 where a channel named by `labels` (n,) is one of `CLASSES`, 0 elsewhere; several may be one class.

    :raises InputError: a label that is neither of `CLASSES` nor of `CELEBAMASK`
    """
    matrix = np.zeros((len(CLASSES), len(labels)))
    for channel, label in enumerate(labels):
        name = _OF_OTHERS.get(label, label)
        if name not in CLASSES:
            expected = ", ".join(dict.fromkeys([*CLASSES, *CELEBAMASK]))
            raise InputError("labels", f"{label!r}, expected one of {expected}")
        matrix[CLASSES.index(name), channel] = 1
    return matrix


@dataclass(frozen=True, kw_only=True)
class Description:
    """How a network wants its pictures, and what its outputs are."""

    kinds: Mapping[Kind, tuple[str | int, ...]]  # outputs of each kind by name or position; none named: all there are
    size: int | None = option(None, low=8, high=2048)  # pixels a side; None: what the network's input or the kind says
    mean: Triple  # of red, green and blue in 0..1, taken away
    std: Triple  # of red, green and blue, divided by
    order: Order = "RGB"
    crop: Crop = "face"
    names: tuple[str, ...] = ()  # of attributes
    labels: tuple[str, ...] = ()  # of the channels of the last content output; none: the eleven, or CelebAMask's
    logits: bool | None = None  # probabilities are yet to be made; None: for content, judged by a run
    trained_on: str = ""


DEFAULTS: Mapping[Kind, Description] = {
    "content": Description(kinds={"content": ()}, mean=_IMAGENET[0], std=_IMAGENET[1]),
    "identity": Description(kinds={"identity": ()}, mean=_HALF[0], std=_HALF[1], crop="arcface"),
    "attributes": Description(kinds={"attributes": ()}, mean=_IMAGENET[0], std=_IMAGENET[1]),
    "landmarks": Description(kinds={"landmarks": ()}, mean=_IMAGENET[0], std=_IMAGENET[1]),
}


def describe(path: Path, metadata: str | None, kind: Kind | None) -> Description:
    """The description of a network: ``<path>.json``, or else `metadata`, or else what is usual for `kind`.

    :param metadata: JSON text in the file itself
    :param kind: that it is wanted for; None: what the file itself says
    :raises InputError: no description where `kind` is None, another kind, or values that can't be
    """
    if kind is not None and kind not in KINDS:
        raise InputError("kind", f"{kind!r}, expected one of {', '.join(KINDS)}")
    beside = file_beside(path, f"{path.name}.json")
    if beside is not None:
        return _described(beside, read_json_object(beside, _MAX_BYTES), kind)
    if metadata is not None:
        where = f"{path} -> {PROPERTY}"
        try:
            values = json.loads(metadata)
        except (ValueError, RecursionError) as error:
            raise InputError(where, f"is not JSON ({error})") from None
        if not isinstance(values, dict):
            raise InputError(where, "expected a JSON object")
        return _described(where, values, kind)
    if kind is None:
        raise InputError(path, f"does not say what it gives, expected {path.name}.json or metadata {PROPERTY}")
    return DEFAULTS[kind]


def _described(where: object, values: Mapping[str, Any], wanted: Kind | None) -> Description:
    kinds = values.get("kinds")
    if kinds is None:
        single = values.get("kind", wanted)
        kinds = {} if single is None else {single: []}
    if not isinstance(kinds, Mapping) or not kinds:
        raise InputError(where, 'neither "kind" nor "kinds" with the outputs of each, expected one')
    for kind in kinds:
        if kind not in KINDS:
            raise InputError(where, f"kind {kind!r}, expected one of {', '.join(KINDS)}")
    if len(kinds) > 1 and not all(kinds.values()):
        raise InputError(f"{where} -> kinds", "a kind without outputs beside others, expected the names of its outputs")
    if wanted is not None and wanted not in kinds:
        raise InputError(where, f"gives {', '.join(kinds)}, expected {wanted}")
    usual = DEFAULTS[next(iter(kinds))]  # whichever is wanted: one forward serves them all
    known = {field.name for field in fields(Description)}
    usual_values = {"mean": list(usual.mean), "std": list(usual.std), "crop": usual.crop}
    given = {key: value for key, value in values.items() if key in known}
    description = from_json(Description, {**usual_values, **given, "kinds": kinds}, str(where))
    if min(description.std) <= 0:
        raise InputError(f"{where} -> std", f"{str(list(description.std))[:40]}, expected numbers above 0")
    return description


def read_model(path: Path) -> Any:
    """The `onnx.ModelProto` in a file. Only its outside is checked: its nodes are checked by whoever runs them.

    :raises InputError: not readable, truncated, no ONNX, data in other files, or another operator set
    """
    import onnx

    model = onnx.ModelProto()
    try:
        model.ParseFromString(read_bytes(path, MAX_BYTES))
    except InputError:
        raise
    except Exception as error:  # protobuf's errors share no other base
        raise InputError(path, "is damaged or no ONNX file") from error
    if not model.HasField("graph") or not len(model.graph.node):
        raise InputError(path, "is no ONNX file, or one without a graph")
    for what in _faults(model):
        raise InputError(path, what)
    return model


def onnx_session(data: bytes) -> Any:
    """The network of a file's bytes in onnxruntime, on one thread, which says nothing."""
    import onnxruntime as ort

    settings = ort.SessionOptions()
    settings.intra_op_num_threads = 1
    settings.log_severity_level = 4
    settings.enable_cpu_mem_arena = False
    return ort.InferenceSession(data, settings, providers=["CPUExecutionProvider"])


def opset(model: Any) -> int:
    """Version of the default operator set."""
    return next(int(one.version) for one in model.opset_import if one.domain in _DOMAINS)


def properties(model: Any) -> dict[str, str]:
    """Its metadata by key."""
    return {prop.key: prop.value for prop in model.metadata_props}


def array(tensor: Any) -> AnyArray:
    """The values of an `onnx.TensorProto`.

    :raises InputError: data elsewhere, not as many as its shape says, or NaN
    """
    from onnx import numpy_helper

    where = f"tensor {tensor.name!r}"
    if tensor.data_location or len(tensor.external_data):
        raise InputError(where, "data in another file, expected it inside (onnx.save_model with one file)")
    try:
        values = np.array(numpy_helper.to_array(tensor))
    except Exception as error:  # of onnx: ValueError, TypeError and errors of its own
        raise InputError(where, f"can't be read ({error})") from error
    if values.dtype.kind not in "fiub" or values.dtype.name == "bfloat16":
        raise InputError(where, f"of type {values.dtype}, expected floats, integers or booleans")
    if values.dtype.kind == "f" and np.isnan(values).any():
        raise InputError(where, "holds NaN, expected numbers")
    return values


def _faults(model: Any) -> Iterator[str]:
    graph = model.graph
    names = [*graph.initializer, *graph.input, *graph.output, *graph.node]
    texts = [name.name for name in names] + [text for node in graph.node for text in (*node.input, *node.output)]
    if not all(isinstance(text, str) for text in texts):
        yield "names that are not UTF-8, expected text"
    versions = [one.version for one in model.opset_import if one.domain in _DOMAINS]
    if len(versions) != 1 or not OLDEST_OPSET <= versions[0] <= NEWEST_OPSET:
        yield f"operator set {versions[:3]}, expected one from {OLDEST_OPSET} to {NEWEST_OPSET}"
    if len(graph.sparse_initializer):
        yield "sparse tensors, expected dense ones"
    for tensor in (one for each in (graph, *model.functions) for one in _tensors(each)):
        if tensor.data_location or len(tensor.external_data):
            yield f"tensor {tensor.name!r} has its data in another file, expected one file (onnx.save_model)"


def _tensors(graph: Any) -> Iterator[Any]:
    """All of a graph or function, of its nodes and of graphs within them."""
    yield from getattr(graph, "initializer", ())
    for attribute in (one for node in graph.node for one in node.attribute):
        yield from (attribute.t, *attribute.tensors)
        for inner in (attribute.g, *attribute.graphs):
            yield from _tensors(inner)
