"""Every operator of the ONNX module: values as onnxruntime's, gradients as finite differences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from feature_graphs import make_model, reference
from onnx import TensorProto, helper
from with_torch import torch

from facepipe.photo.features.onnx_module import OnnxModule
from facepipe.photo.features.operators import OPERATORS

pytestmark = pytest.mark.needs_torch

Case = tuple[str, Sequence[np.ndarray | None], dict[str, Any], dict[str, Any]]

RNG = np.random.default_rng(7)


def data(*shape: int, least: float | None = None) -> np.ndarray:
    """Random float32; at least `least` where that is given, never within 0.02 of 0."""
    values = RNG.normal(size=shape)
    values = np.where(np.abs(values) < 0.02, 0.3, values)
    return (values if least is None else np.abs(values) + least).astype(np.float32)


def ints(*values: int) -> np.ndarray:
    return np.array(values, np.int64)


def floats(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def case(op_type: str, *inputs: np.ndarray | None, opset: int = 15, outputs: int = 1, **attributes: Any) -> Any:
    """An operator on inputs: the first is data, further ones of integers or marked constants are initialisers."""
    more = {"opset": opset, "outputs": outputs}
    shown = ",".join(f"{key}={value}" for key, value in attributes.items())
    return pytest.param(op_type, inputs, attributes, more, id=f"{op_type}-{opset}-{shown}"[:70])


X4 = data(2, 3, 6, 7)
ROW = data(4, 5)

UNARY = [
    *(case(name, ROW) for name in ("Relu", "Sigmoid", "Tanh", "Identity")),
    case("Sqrt", data(3, 4, least=0.1)),
    case("LeakyRelu", ROW),
    case("LeakyRelu", ROW, alpha=0.3),
    case("HardSigmoid", ROW, alpha=0.3, beta=0.4),
    case("HardSwish", 3 * ROW),
    case("Dropout", ROW, opset=9),
    case("Dropout", ROW, floats(0.4)[0]),
    *(case("Softmax", X4, opset=opset, axis=axis) for opset in (9, 13) for axis in (1, 2)),
    case("Softmax", X4, opset=9),
    case("Softmax", X4),
    case("Clip", ROW, opset=9, min=-0.5, max=0.7),
    case("Clip", ROW, floats(-0.5)[0], floats(0.7)[0]),
    case("Clip", ROW, None, floats(0.7)[0]),
    case("Clip", ROW),
    *(case("PRelu", X4, data(*shape)) for shape in ((3, 1, 1), (1,), (7,), (1, 3, 1, 1), (6, 1), (3, 6, 7))),
    case("PRelu", X4, data(3, 1, 1), opset=9),
    case("PRelu", data(4, 5), data(5)),
    case("PRelu", data(3, 3, 3, 3), data(3)),
]

BINARY = [
    *(case(name, X4, data(3, 1, 7, least=0.2)) for name in ("Add", "Sub", "Mul", "Div")),
    case("Pow", data(3, 4, least=0.2), data(4)),
    case("Pow", ROW, floats(2)[0]),
    case("MatMul", data(2, 3, 4), data(4, 5)),
    case("MatMul", data(3, 4), data(2, 4, 5)),
    *(
        case("Gemm", data(*a), data(3, 5), data(5), transA=t, alpha=0.5, beta=2.0)
        for a, t in (((4, 3), 0), ((3, 4), 1))
    ),
    case("Gemm", data(4, 3), data(5, 3), data(4, 1), transB=1),
    case("Gemm", data(4, 3), data(3, 5)),
]

REDUCTIONS = [
    *(
        case(f"Reduce{name}", data(2, 3, 4, least=0.1), axes=axes, keepdims=keep, opset=11)
        for name in ("Mean", "Sum", "L2")
        for axes, keep in (([1, -1], 1), ([0], 0))
    ),
    *(
        case(f"Reduce{name}", data(2, 3, 4, least=0.1), ints(1, 2), opset=18, keepdims=0)
        for name in ("Mean", "Sum", "L2")
    ),
    case("ReduceMean", X4),
    case("ReduceSum", X4, None, noop_with_empty_axes=1),
    case("GlobalAveragePool", X4),
]

SHAPES = [
    case("Reshape", X4, ints(0, -1, 7)),
    case("Reshape", X4, ints(-1)),
    *(case("Flatten", X4, axis=axis) for axis in (0, 1, 2, 4, -1)),
    case("Flatten", X4),
    case("Transpose", X4, perm=[0, 2, 3, 1]),
    case("Transpose", ROW),
    case("Squeeze", data(2, 1, 3, 1), opset=11, axes=[1, -1]),
    case("Squeeze", data(2, 1, 3, 1), ints(3)),
    case("Squeeze", data(2, 1, 3, 1)),
    case("Unsqueeze", ROW, opset=11, axes=[0, 3]),
    case("Unsqueeze", ROW, ints(-1, 1)),
    case("Concat", ROW, data(4, 2), data(4, 1), axis=-1),
    case("Split", X4, outputs=3, axis=1),
    case("Split", X4, outputs=2, opset=11, axis=3, split=[3, 4]),
    case("Split", X4, ints(5, 1), outputs=2, axis=2),
    case("Split", X4, outputs=4, opset=18, axis=3, num_outputs=4),
    case("Expand", data(3, 1), ints(2, 1, 4)),
    case("Gather", X4, ints(2, 0, -1), axis=1),
    case("Gather", X4, np.int64(1), axis=2),
    case("Gather", X4, np.array([[0, 1], [1, 1]]), axis=0),
    case("Slice", X4, opset=9, starts=[1, -3], ends=[3, 100], axes=[1, 3]),
    case("Slice", X4, ints(1, -1), ints(3, -100), ints(1, 3), ints(1, -2)),
    case("Slice", X4, ints(0, 1), ints(2, -1)),
    case("Pad", X4, ints(0, 0, 1, 2, 0, 0, 3, 1), mode="constant"),
    case("Pad", X4, ints(0, 1, 1, -2, 0, 0, -1, 1), floats(0.7)[0]),
    case("Pad", X4, opset=9, pads=[0, 0, 1, 2, 0, 0, 3, 1], value=0.5),
]

WINDOWS = [
    case("Conv", X4, data(4, 3, 3, 3), data(4), pads=[1, 1, 1, 1]),
    case("Conv", X4, data(4, 3, 3, 2), strides=[2, 1], pads=[1, 0, 2, 1]),
    case("Conv", X4, data(6, 1, 3, 3), group=3, dilations=[2, 1], pads=[2, 1, 2, 1]),
    *(case("Conv", X4, data(4, 3, 3, 4), auto_pad=pad, strides=[2, 2]) for pad in ("SAME_UPPER", "VALID")),
    *(
        case(name, X4, kernel_shape=[3, 2], strides=[2, 2], pads=[1, 0, 1, 0], ceil_mode=ceil)
        for name in ("MaxPool", "AveragePool")
        for ceil in (0, 1)
    ),
    *(
        case(name, X4, kernel_shape=[3, 2], strides=[2, 2], pads=pads)
        for name in ("MaxPool", "AveragePool")
        for pads in ([1, 0, 0, 1], [0, 0, 1, 0])
    ),
    case("MaxPool", X4, kernel_shape=[2, 2], dilations=[2, 3]),
    case("MaxPool", X4, kernel_shape=[3, 3], strides=[3, 3], ceil_mode=1),
    case("AveragePool", X4, kernel_shape=[3, 3], pads=[1, 1, 1, 1], count_include_pad=1, strides=[2, 2]),
    case("AveragePool", X4, kernel_shape=[2, 3], strides=[2, 2], ceil_mode=1, count_include_pad=1, opset=19),
    case("AveragePool", X4, kernel_shape=[3, 3], pads=[1, 1, 0, 0], count_include_pad=1),
    *(
        case(name, X4, kernel_shape=[3, 3], strides=[2, 2], auto_pad="SAME_UPPER")
        for name in ("MaxPool", "AveragePool")
    ),
    case("BatchNormalization", X4, data(3), data(3), data(3), data(3, least=0.1), epsilon=1e-3),
    case("BatchNormalization", X4, data(3), data(3), data(3), data(3, least=0.1), opset=9),
    case("BatchNormalization", data(4, 5), data(5), data(5), data(5), data(5, least=0.1)),
    case("InstanceNormalization", X4, data(3), data(3), epsilon=1e-2),
]

COORDINATES = ("half_pixel", "pytorch_half_pixel", "align_corners", "asymmetric")
SIZES, SHRUNK = ints(2, 3, 9, 15), ints(2, 3, 4, 3)
RESIZE = [
    *(
        case("Resize", X4, None, None, sizes, mode=mode, coordinate_transformation_mode=how)
        for mode in ("linear", "nearest")
        for how in COORDINATES
        for sizes in (SIZES, SHRUNK)
    ),
    *(
        case("Resize", X4, None, floats(1, 1, 2, 1.5), nearest_mode=rounding)
        for rounding in ("round_prefer_floor", "floor")
    ),
    case("Resize", X4, None, floats(1, 1, 1.7, 0.6), mode="linear"),
    case("Resize", X4, None, floats(1, 1, 1.7, 0.6), mode="linear", nearest_mode="ceil"),
    case("Resize", X4, floats(), floats(1, 1, 2, 2), opset=11, mode="linear"),
    case("Resize", X4, floats(1, 1, 2, 2), opset=10, mode="nearest"),
    case("Resize", X4, floats(1, 1, 2, 3), opset=10, mode="linear"),
    *(case("Upsample", X4, floats(1, 1, 2, 3), opset=9, mode=mode) for mode in ("nearest", "linear")),
    case("Upsample", X4, opset=7, mode="nearest", scales=[1.0, 1.0, 2.0, 2.0]),
]

DIFFERENTIABLE = [*UNARY, *BINARY, *REDUCTIONS, *SHAPES, *WINDOWS, *RESIZE]

INT, BOOL = TensorProto.INT64, TensorProto.BOOL
OTHERS = [
    (case("Shape", X4), INT),
    (case("Shape", X4, start=1, end=-1), INT),
    (case("Cast", 3 * ROW, to=INT), INT),
    (case("Cast", 3 * ROW, to=BOOL), BOOL),
]


def one_node(
    op_type: str, inputs: Sequence[np.ndarray | None], attributes: dict[str, Any], more: dict[str, Any], kind: int
) -> Any:
    """A graph of one node: float inputs of at least one axis are the graph's inputs, but for scales and statistics."""
    names = ["" if one is None else f"in{at}" for at, one in enumerate(inputs)]
    moving = [at for at, one in enumerate(inputs) if at == 0 or (one is not None and _moves(op_type, one))]
    fixed = {names[at]: one for at, one in enumerate(inputs) if one is not None and at not in moving}
    outputs = [f"out{at}" for at in range(more["outputs"])]
    node = helper.make_node(op_type, names, outputs, **attributes)
    shapes = {names[at]: inputs[at].shape for at in moving}
    model = make_model([node], shapes, dict.fromkeys(outputs, kind), fixed, more["opset"])
    return model, {names[at]: inputs[at] for at in moving}


def _moves(op_type: str, value: np.ndarray) -> bool:
    return value.dtype == np.float32 and value.ndim > 0 and op_type not in ("BatchNormalization", "Resize", "Upsample")


@pytest.mark.parametrize(("op_type", "inputs", "attributes", "more"), DIFFERENTIABLE)
def test_operator_as_onnxruntime_and_finite_differences(op_type: str, inputs: Any, attributes: Any, more: Any) -> None:
    model, feeds = one_node(op_type, inputs, attributes, more, TensorProto.FLOAT)
    module = OnnxModule(model)
    tensors = [torch.from_numpy(feed) for feed in feeds.values()]
    for found, expected in zip(module(*tensors), reference(model, feeds), strict=True):
        assert tuple(found.shape) == expected.shape
        np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5, atol=1e-5)
    exact = module.double()
    free = [tensor.double().requires_grad_() for tensor in tensors]
    assert torch.autograd.gradcheck(lambda *values: exact(*values), free, fast_mode=True, eps=1e-5, atol=1e-5)


@pytest.mark.parametrize(("parameters", "kind"), OTHERS)
def test_operator_without_gradient_as_onnxruntime(parameters: Any, kind: int) -> None:
    model, feeds = one_node(*parameters.values, kind)
    (found,) = OnnxModule(model)(*(torch.from_numpy(feed) for feed in feeds.values()))
    np.testing.assert_array_equal(found.numpy(), reference(model, feeds)[0])


def test_arithmetic_of_shapes_as_onnxruntime() -> None:
    """Whole numbers as exporters work with them: divided, chosen, made to shapes."""
    node = helper.make_node
    nodes = [
        node("Shape", ["x"], ["shape"]),
        node("Gather", ["shape", "two"], ["height"]),
        node("Constant", [], ["three"], value_int=3),
        node("Constant", [], ["part"], value_floats=[0.5, 0.25]),
        node("Constant", [], ["minus"], value_ints=[-7]),
        node("Div", ["minus", "three"], ["quotient"]),
        node("ConstantOfShape", ["shape"], ["ones"], value=helper.make_tensor("one", TensorProto.FLOAT, [1], [1.5])),
        node("ConstantOfShape", ["shape"], ["zeros"]),
        node("Cast", ["height"], ["number"], to=TensorProto.FLOAT),
    ]
    outputs = dict.fromkeys(("quotient", "three", "height"), INT)
    outputs |= dict.fromkeys(("ones", "zeros", "number", "part"), TensorProto.FLOAT)
    model = make_model(nodes, {"x": X4.shape}, outputs, {"two": np.int64(2)})
    for found, expected in zip(OnnxModule(model)(torch.from_numpy(X4)), reference(model, {"x": X4}), strict=True):
        assert str(found.dtype).removeprefix("torch.") == str(expected.dtype)
        np.testing.assert_array_equal(found.numpy(), expected)


def test_every_operator_is_compared() -> None:
    compared = {one.values[0] for one in DIFFERENTIABLE} | {one.values[0] for one, _ in OTHERS}
    assert set(OPERATORS) - compared == {"ConstantOfShape"}
