"""ONNX: the rig of a face, or its sliders, as one graph that game engines evaluate, and the reference runtime.

`export` writes a graph and its sidecar, `export_encoder` those of a neural rig's encoder, `export_persons` those of a
basis of persons; `Deformer` runs a graph with onnxruntime; `validate` checks a file.
"""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe_onnx.options import Options
    from facepipe_onnx.person_graph import export_persons
    from facepipe_onnx.read import validate
    from facepipe_onnx.runtime import Deformer
    from facepipe_onnx.writer import export, export_encoder, export_parts, outputs
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["Deformer", "Options", "export", "export_encoder", "export_parts", "export_persons", "outputs", "validate"]
