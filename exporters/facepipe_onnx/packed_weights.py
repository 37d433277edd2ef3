"""What sliders do as ramps, and their matrices in fewer bytes: float16 or int8 in the file, float32 in the graph.

Of int8 the numbers are ``row scale * whole number * column scale``: columns are of different units, and rows are
straight sliders or units of a network. Runtimes that fold constants do this once, when they load the graph.

What rounding a row does is made up for by the rows after it, for samples of the slider values (Frantar et al., GPTQ,
2022), and what the layers before do by all rows first. At the defaults nothing changes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import ExportError
from facepipe.onnx_graph import Nodes
from facepipe.parts import Slider
from facepipe.rig import CHANNELS, Rig, rest_coefficients
from facepipe.rig.sliders import channel_entries, response, shape_entries

_BUSY = (0.05, 0.2, 0.5, 1.0)  # shares of the sliders that are off their defaults
_FLOAT = 1  # TensorProto.FLOAT
_LEVELS = 127
_ROUNDS = 4
_DAMPING = 1e-5  # of the samples' mean square
_VECTORS = 256


class Ramps(NamedTuple):
    """``base + ramps @ gains``: bone coefficients and shape weights of the sliders."""

    sliders: IntArray  # (k,) the slider of each ramp
    starts: FloatArray  # (k,) slider value where it leaves 0
    ends: FloatArray  # (k,) slider value where it reaches 1
    base: FloatArray  # (9 j,) bone coefficients with all ramps at 0
    gains: FloatArray  # (k, 9 j)
    shape_base: FloatArray  # (shapes,)
    shape_gains: FloatArray  # (k, shapes)


def ramps_of(rig: Rig, sliders: Sequence[Slider], whole: Collection[str] = ()) -> Ramps:
    """The ramps of sliders on a rig, which `facepipe.rig.slide` takes.

    :param whole: sliders that have a ramp over their range in any case, unless that is a single value
    :raises ExportError: an empty range, an unknown shape, or sliders that move nothing
    """
    joint_columns = 9 * len(rig.joints)
    base = np.append(rest_coefficients(len(rig.joints)).ravel(), np.zeros(len(rig.shapes)))
    rows: dict[tuple[int, float, float], FloatArray] = {}
    for number, slider in enumerate(sliders):
        if slider.minimum > slider.maximum:
            raise ExportError(
                f"{rig.name} -> slider {slider.name}", f"range {slider.minimum:g} to {slider.maximum:g} is empty"
            )
        if slider.name in whole and slider.minimum < slider.maximum:
            rows[number, slider.minimum, slider.maximum] = np.zeros(len(base))
        # column, gain and curve of everything that it adds to
        entries = [
            (9 * rig.joints.index(joint) + CHANNELS.index(channel), gain, curve)
            for (joint, channel, gain), curve in channel_entries(slider)
        ]
        for (shape, gain), curve in shape_entries(slider):
            if shape not in rig.shapes:
                raise ExportError(f"{rig.name} -> slider {slider.name}", f"no shape '{shape}'")
            entries.append((joint_columns + rig.shapes.index(shape), gain, curve))
        for column, gain, curve in entries:
            inner = {value for value, _ in curve or () if slider.minimum < value < slider.maximum}
            values = sorted({slider.minimum, slider.maximum, *inner})
            amounts = [gain * response(curve, value, slider.default) for value in values]
            # curve(x) = its first value + sum of rises * clip((x - start) / (end - start), 0, 1)
            base[column] += amounts[0]
            for piece, (low, high) in zip(itertools.pairwise(values), itertools.pairwise(amounts), strict=True):
                if high != low:
                    rows.setdefault((number, *piece), np.zeros(len(base)))[column] += high - low
    if not rows:
        raise ExportError(rig.name, "no slider that moves a joint or a shape, expected some")
    keys = sorted(rows)
    gains = np.array([rows[key] for key in keys])
    numbers, starts, ends = (np.array(column) for column in zip(*keys, strict=True))
    return Ramps(
        sliders=numbers,
        starts=starts,
        ends=ends,
        base=base[:joint_columns],
        gains=gains[:, :joint_columns],
        shape_base=base[joint_columns:],
        shape_gains=gains[:, joint_columns:],
    )


def ramp_nodes(nodes: Nodes, ramps: Ramps, sliders: int) -> str:
    """[batch, k] values 0..1 of the ramps, from the input ``sliders``."""
    values = "sliders"
    if not np.array_equal(ramps.sliders, np.arange(sliders)):
        values = nodes.gather(values, 1, ramps.sliders)
    past = nodes.add("Sub", values, nodes.constant("ramp_starts", ramps.starts[None]))
    risen = nodes.add("Mul", past, nodes.constant("ramp_slopes", 1 / (ramps.ends - ramps.starts)[None]))
    bounds = [nodes.constant(name, np.array(value)) for name, value in (("zero", 0.0), ("full", 1.0))]
    return nodes.add("Clip", risen, *bounds)


def slider_samples(sliders: Sequence[Slider], count: int, seed: int) -> FloatArray:
    """(count, sliders) values: the defaults, then random ones of few sliders and of many."""
    random = np.random.default_rng(seed)
    low, high, rest = (
        np.array([getattr(slider, key) for slider in sliders]) for key in ("minimum", "maximum", "default")
    )
    values = low + random.random((count, len(sliders))) * (high - low)
    moved = random.random(values.shape) < random.choice(_BUSY, size=(count, 1))
    moved[0] = False
    return np.where(moved, values, rest)


def ramp_samples(ramps: Ramps, values: FloatArray) -> FloatArray:
    """(count, k) values 0..1 of the ramps under (count, sliders) values."""
    return np.asarray(((values[:, ramps.sliders] - ramps.starts) / (ramps.ends - ramps.starts)).clip(0.0, 1.0))


class PackedNodes(Nodes):
    """Nodes whose matrices are stored in fewer bytes."""

    def __init__(self, weights: str) -> None:
        """:param weights: how matrices are stored: float32, float16 or int8"""
        super().__init__()
        self.weights = weights
        self.samples: dict[str, tuple[FloatArray, FloatArray]] = {}  # of values, (n, size): as they are, and as packed


def follow(nodes: PackedNodes, name: str, function: Callable[..., FloatArray], *sources: str) -> str:
    """`name`, a value that `function` computes from others, with samples where those have some."""
    if all(source in nodes.samples for source in sources):
        whole, packed = zip(*(nodes.samples[source] for source in sources), strict=True)
        nodes.samples[name] = (function(*whole), function(*packed))
    return name


def product_nodes(nodes: PackedNodes, value: str, names: tuple[str, str], matrix: FloatArray, bias: FloatArray) -> str:
    """[batch, columns] ``bias + value @ matrix``, the matrix stored as `nodes.weights` says.

    :param value: [batch, rows], with samples unless these are float32
    :param names: of the matrix and of the bias
    """
    if nodes.weights == "float32":
        return nodes.add("Gemm", value, nodes.constant(names[0], matrix), nodes.constant(names[1], bias))
    with np.errstate(over="ignore", invalid="ignore"):  # what does not fit is refused when the model is made
        whole, packed = nodes.samples[value]
        # the matrix that maps packed samples as nearly as possible to what `matrix` makes of the whole ones
        steps = packed[1:] - packed[0]
        missing = (whole[1:] - whole[0]) @ matrix - steps @ matrix
        wanted = np.asarray(matrix + np.linalg.solve(_products(steps), steps.T @ missing))
        if nodes.weights == "float16":
            stored = rounded(wanted, packed, lambda row: row.astype(np.float16))
            made = nodes.add("Cast", nodes.constant(names[0], stored, np.float16), to=_FLOAT)
        else:
            # scales of rows and columns that bring the matrix to -127..127, made like by turns: the root of the largest
            rows, columns = np.ones((len(wanted), 1)), np.ones((1, wanted.shape[1]))
            for _ in range(_ROUNDS):
                for axis, own in ((1, rows), (0, columns)):
                    own *= np.sqrt(_largest(wanted / (rows * columns), axis))
            columns *= _largest(wanted / (rows * columns), 0) / _LEVELS
            rows, columns = (scale.astype(np.float32).astype(np.float64) for scale in (rows, columns))
            scaled, of_rows = wanted / (rows * columns), packed * rows.T
            numbers = rounded(scaled, of_rows, lambda row: np.rint(row).clip(-_LEVELS, _LEVELS))
            made = nodes.add("Cast", nodes.constant(names[0], numbers, np.int8), to=_FLOAT)
            factors = [
                nodes.constant(f"{names[0]}_{side}", one) for side, one in (("rows", rows), ("columns", columns))
            ]
            made = nodes.add("Mul", nodes.add("Mul", made, factors[0]), factors[1])
            stored = numbers * rows * columns
        moved = bias + whole[0] @ matrix - packed[0] @ stored
        found = nodes.add("Gemm", value, made, nodes.constant(names[1], moved))
        nodes.samples[found] = (whole @ matrix + bias, packed @ stored + moved)
        return found


def _products(steps: FloatArray) -> FloatArray:
    """(rows, rows) products of samples, damped so that they have an inverse."""
    products = steps.T @ steps
    mean = float(np.mean(np.diag(products)))
    products[np.diag_indices(len(products))] += _DAMPING * mean if mean > 0 else 1.0
    return np.asarray(products)


def _largest(values: FloatArray, axis: int) -> FloatArray:
    found = np.abs(values).max(axis=axis, keepdims=True, initial=0.0)
    return np.asarray(np.where(found > 0, found, 1.0))


def rounded(matrix: FloatArray, samples: FloatArray, near: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """A matrix (rows, columns) of rounded rows whose products with samples (n, rows) stay near the matrix's own.

    Rows are rounded in the order of their samples' size; what that does to the products, as far as the rows that are
    left can do the same, goes to them. The first sample is where steps begin.

    :param near: a row -> the row rounded
    """
    left, result = matrix.copy(), np.empty_like(matrix)
    products = _products(samples[1:] - samples[0])
    order = np.argsort(-np.diag(products), kind="stable")
    upper = np.linalg.cholesky(np.linalg.inv(products[np.ix_(order, order)])).T
    for number, row in enumerate(order):
        result[row] = near(left[row])
        missed = (left[row] - result[row]) / upper[number, number]
        left[order[number + 1 :]] -= np.outer(upper[number, number + 1 :], missed)
    return result


def packed_error(packed: Any, whole: Any, rig: Rig, sliders: Sequence[Slider], mm_per_unit: float) -> dict[str, Any]:
    """Largest distance of a point in millimetres, and how many slider vectors it was measured over.

    These are the defaults, every slider alone at its ends, and random ones of few sliders and of many.

    :param packed: the model with fewer bytes
    :param whole: the same in float32
    :param rig: of the exported shapes
    """
    low, high, rest = (
        np.array([getattr(slider, key) for slider in sliders]) for key in ("minimum", "maximum", "default")
    )
    # each slider alone shows the errors of its own rows, which in a mixture may cancel
    alone = np.repeat(rest[None], 2 * len(sliders), axis=0)
    alone[::2][np.diag_indices(len(sliders))], alone[1::2][np.diag_indices(len(sliders))] = low, high
    vectors = np.concatenate([alone, slider_samples(sliders, _VECTORS, seed=1)]).astype(np.float32)
    runs = [_points(model, rig, vectors) for model in (packed, whole)]
    worst = max(
        (float(np.linalg.norm(one - other, axis=1).max(initial=0.0)) for one, other in zip(*runs, strict=True)),
        default=0.0,
    )
    return {"error_mm": worst * mm_per_unit, "vectors": len(vectors)}


def _points(model: Any, rig: Rig, vectors: FloatArray) -> Iterator[FloatArray]:
    """World points (n, 3) under every vector, as a GPU makes them of the outputs."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    inputs = {one.name: np.zeros(one.shape, np.float32) for one in session.get_inputs()}
    if "parent" in inputs:
        inputs["parent"][:] = rig.parent_world
    given = {output.name for output in session.get_outputs()}
    names = [name for name in ("coefficients", "morph_weights") if name in given]
    for vector in vectors:
        inputs["sliders"][:] = vector
        # what follows is in float64: the difference is then that of the models, not of sums made here
        outputs = dict(zip(names, session.run(names, inputs), strict=True))
        points, local = rig.points, rig.rest
        if "morph_weights" in outputs:
            points = points + (rig.deltas @ outputs["morph_weights"][0].astype(np.float64)).reshape(-1, 3)
        if "coefficients" in outputs:
            local = rig.local_transforms(outputs["coefficients"][0].astype(np.float64))
        yield rig.skin(points, rig.skinning_matrices(local))
