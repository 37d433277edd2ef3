"""What the graph of an encoder means: its points, and the controls that it gives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from facepipe.core import __version__
from facepipe.rig.neural_encoder import NeuralEncoder
from facepipe_onnx.kinds import ENCODER
from facepipe_onnx.operators import FURTHER

_CONVENTIONS = {
    "points": "points of all meshes one after another, in their order on the face; only those that `chosen` numbers "
    "count, the others may be anything",
    "lengths": "millimetres",
    "space": "world space at bind time, right-handed, up axis face.up_axis; the head as it is at rest, not turned",
    "controls": "clamped to their ranges",
}


def describe(
    encoder: NeuralEncoder, operators: list[str], meshes: Mapping[str, int], name: str = "face"
) -> dict[str, Any]:
    """The metadata of a graph of `encoder_graph.build`.

    :param operators: the operators of the graph, sorted
    :param meshes: name -> points, in the order of the face
    """
    controls, first, found = encoder.controls, 0, []
    for mesh, count in meshes.items():
        found.append({"name": mesh, "first": first, "count": count})
        first += count
    return {
        "conventions": _CONVENTIONS,
        "face": {"meters_per_unit": 0.001, "name": name, "topology": encoder.topology, "up_axis": "Y"},
        "format": ENCODER.format,
        "further_operators": [one for one in operators if one in FURTHER],
        "generator": f"facepipe {__version__}",
        "inputs": [
            {
                "chosen": encoder.chosen.tolist(),
                "name": "points",
                "required": True,
                "shape": [1, encoder.point_count, 3],
                "type": "float32",
            }
        ],
        "meshes": found,
        "operators": operators,
        "outputs": [
            {
                "default": [one.default for one in controls],
                "name": "controls",
                "names": [one.name for one in controls],
                "range": [[one.minimum, one.maximum] for one in controls],
                "shape": [1, len(controls)],
                "type": "float32",
            }
        ],
    }
