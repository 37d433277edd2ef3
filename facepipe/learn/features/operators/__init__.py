"""What each ONNX operator does to tensors of torch, one small function an operator.

Source: the ONNX operator specification (onnx.ai/onnx/operators); tests compare each with onnxruntime.
"""

from __future__ import annotations

from facepipe.learn.features.node import Operator
from facepipe.learn.features.operators import (
    elementwise,
    indexing,
    normalizations,
    pools,
    products,
    reductions,
    resize,
    shapes,
)

_PARTS = (elementwise, indexing, normalizations, pools, products, reductions, resize, shapes)

OPERATORS: dict[str, Operator] = {name: operator for part in _PARTS for name, operator in part.TABLE.items()}
