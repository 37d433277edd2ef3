"""The operators that a facepipe graph may use (DESIGN section 6)."""

from __future__ import annotations

PER_FRAME = frozenset(
    {"Clip", "Gemm", "MatMul", "Add", "Sub", "Mul", "Relu", "Tanh", "Sigmoid", "Sin", "Cos"}
    | {"Concat", "Slice", "Reshape", "Transpose", "Gather"}
)
# Of compressed weights, normals and encoders; declared in the sidecar where a graph uses them.
FURTHER = frozenset({"Cast", "Div", "Softmax", "Sqrt"})
