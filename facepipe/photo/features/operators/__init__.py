"""What each ONNX operator does to tensors of torch, one small function an operator.

They are those that exports of face recognition (ArcFace, MobileFaceNet), face parsing (BiSeNet) and heads of
attributes or landmarks use. Source: the ONNX operator specification (onnx.ai/onnx/operators); tests compare each with
onnxruntime.
"""

from __future__ import annotations

from facepipe.photo.features.node import Operator
from facepipe.photo.features.operators import layers, shapes

_PARTS = (layers, shapes)

OPERATORS: dict[str, Operator] = {name: operator for part in _PARTS for name, operator in part.TABLE.items()}
