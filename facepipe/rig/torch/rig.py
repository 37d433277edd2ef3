"""The rig with gradients: what `facepipe.rig` defines, on batches of torch tensors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.parts import Slider, SliderNetwork
from facepipe.rig import Rig
from facepipe.rig.torch.sliders import DifferentiableSliders, PiecewiseLinear, Term

DENSE = 0.1  # share of non-zero entries from which a dense product is the faster one


class FixedMatrix:
    """``A x`` for a constant matrix A, with gradients to x.

    torch's own sparse products need MKL, or lose half their speed going backward; sums of weighted rows
    (`embedding_bag`) of A, and of its transpose for the gradient, run everywhere.
    """

    def __init__(self, matrix: sparse.sparray | FloatArray, dtype: torch.dtype, device: torch.device | str) -> None:
        """:param matrix: (r, c), copied if it is sparse"""
        self.shape: tuple[int, int] = matrix.shape
        rows, columns = matrix.shape
        self._dense: Tensor | None = None
        if isinstance(matrix, np.ndarray):
            self._dense = torch.as_tensor(matrix, dtype=dtype, device=device)
        elif matrix.nnz >= DENSE * rows * columns:
            # column by column, as shapes come: a single pose takes a third of the time that it takes row by row
            self._dense = torch.as_tensor(matrix.T.toarray(), dtype=dtype, device=device).mT
        else:
            self._own = _bags(matrix, dtype, device)
            self._transposed = _bags(matrix.T, dtype, device)

    def __matmul__(self, x: Tensor) -> Tensor:
        """(r, k) product with (c, k)."""
        if self._dense is not None:
            return self._dense @ x
        return _Product.apply(x, self._own, self._transposed)


_Bags = tuple[Tensor, Tensor, Tensor]


def _bags(matrix: sparse.sparray, dtype: torch.dtype, device: torch.device | str) -> _Bags:
    """Columns, first entry of each row, and values."""
    matrix = sparse.csr_array(matrix)
    return (
        torch.as_tensor(matrix.indices.astype(np.int64), device=device),
        torch.as_tensor(matrix.indptr[:-1].astype(np.int64), device=device),
        torch.as_tensor(np.array(matrix.data, dtype=np.float64), dtype=dtype, device=device),
    )


class _Product(torch.autograd.Function):  # type: ignore[misc]
    """The product, and the transposed one backward."""

    @staticmethod
    def forward(context: Any, x: Tensor, own: _Bags, transposed: _Bags) -> Tensor:
        context.own, context.transposed = own, transposed
        columns, first, values = own
        if not len(first):
            return x.new_zeros((0, x.shape[1]))
        return torch.nn.functional.embedding_bag(columns, x.contiguous(), first, mode="sum", per_sample_weights=values)

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return _Product.apply(gradient, context.transposed, context.own), None, None


class DifferentiableRig:
    """Sliders, bone coefficients and shape weights to points, differentiable in all of them.

    Any leading dimensions are a batch. Constants are made once, in one float type and on one device.
    """

    def __init__(
        self,
        rig: Rig,
        sliders: Sequence[Slider] = (),
        *,
        network: SliderNetwork | None = None,
        expressions_last: bool = False,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        """
        :param network: of the face, which adds to what the sliders do
        :param expressions_last: add blendshapes after skinning, in the space of the skeleton, as
            photo-to-face-sliders [0242] does; by default they come first, as in DESIGN section 7, USD and glTF
        :raises InputError: a slider or network of a joint, channel or shape that the rig lacks
        """
        rig.require_linear("the differentiable rig")
        self.joints, self.shapes, self.point_count = rig.joints, rig.shapes, len(rig.points)
        self.expressions_last, self.dtype, self.device = expressions_last, dtype, torch.device(device)
        self.sliders = DifferentiableSliders(sliders, rig.joints, rig.shapes, dtype, device, network)
        self._points = self._constant(rig.points)
        self._rest = self._constant(rig.rest)
        self._inverse_bind = self._constant(rig.inverse_bind)
        self._parent_world = self._constant(rig.parent_world)
        self._deltas = FixedMatrix(_deltas(rig, np.float32 if dtype == torch.float32 else np.float64), dtype, device)
        self._influences = FixedMatrix(rig.influences, dtype, device)
        self._activations = PiecewiseLinear(
            _activations(rig), len(rig.shapes), np.zeros(len(rig.targets)), dtype, device
        )
        # joints by generation with the places of their parents in the one before, and where each joint is in all
        generations = [joints for joints in rig.generations if len(joints)]
        place = np.zeros(len(rig.joints), dtype=np.int64)
        levels = []
        for joints in generations:
            parents = np.maximum(rig.parents[joints], 0)
            levels.append((torch.as_tensor(joints, device=device), torch.as_tensor(place[parents], device=device)))
            place[joints] = np.arange(len(joints))
        order = np.argsort(np.concatenate([*generations, np.zeros(0, np.int64)]), kind="stable")
        self._generations, self._order = levels, torch.as_tensor(order, device=device)

    def __call__(
        self,
        sliders: Tensor | None = None,
        weights: Tensor | None = None,
        *,
        coefficients: Tensor | None = None,
        parent_world: Tensor | None = None,
    ) -> Tensor:
        """(..., n, 3) world points in stage units.

        :param sliders: (..., s) values, instead of coefficients; their shape weights add to `weights`
        :param weights: (..., shapes) shape weights; default 0
        :param coefficients: (..., j, 9) bone coefficients relative to rest
        :param parent_world: (..., 4, 4) what root joints hang under; default the skeleton's place
        :raises InputError: both sliders and coefficients, or a wrong number of them
        """
        if sliders is not None:
            if coefficients is not None:
                raise InputError("differentiable rig", "sliders and bone coefficients, expected only one of them")
            self._check("sliders", sliders, (len(self.sliders.names),))
            coefficients, driven = self.sliders(sliders)
            coefficients = coefficients if self.sliders.moves_joints else None
            weights = driven if weights is None else weights + driven
        if weights is not None:
            self._check("shape weights", weights, (len(self.shapes),))
        if coefficients is not None:
            self._check("bone coefficients", coefficients, (len(self.joints), 9))
        # p = sum_i w_i W_i B_i^-1 (x + D a), with D a after the sum where expressions come last, turned into the world.
        still = coefficients is None and parent_world is None
        blended = self._at_rest if still else self.blended(self.skinning_matrices(coefficients, parent_world))
        if weights is None:
            return under(blended, self._points)
        offsets = self.offsets(weights)
        if not self.expressions_last:
            return under(blended, self._points + offsets)
        placed = self._parent_world if parent_world is None else parent_world
        return under(blended, self._points) + offsets @ placed[..., :3, :3].mT

    def offsets(self, weights: Tensor) -> Tensor:
        """(..., n, 3) what shape weights (..., shapes) add to the points, in skeleton space at bind time."""
        flat = self._activations(weights).flatten(0, -2) if weights.ndim > 1 else self._activations(weights)[None]
        moved = (self._deltas @ flat.mT).mT
        return moved.reshape(*weights.shape[:-1], self.point_count, 3)

    def skinning_matrices(self, coefficients: Tensor | None = None, parent_world: Tensor | None = None) -> Tensor:
        """(..., j + 1, 4, 4) matrices from bind-time skeleton space to world, the skeleton's own last."""
        root = self._parent_world if parent_world is None else parent_world
        local = self._rest if coefficients is None else self._rest @ coefficient_matrices(coefficients)
        batch = np.broadcast_shapes(local.shape[:-3], root.shape[:-2])  # torch's own loads sympy
        root_matrix = root.expand(*batch, 4, 4)[..., None, :, :]
        if not self.joints:
            return root_matrix
        # (..., j, 4, 4) world matrices, one generation of the tree after the other
        levels: list[Tensor] = []
        for joints, parents in self._generations:
            above = levels[-1].index_select(-3, parents) if levels else root[..., None, :, :]
            levels.append(above @ local.index_select(-3, joints))
        skinning = torch.cat(levels, dim=-3).index_select(-3, self._order) @ self._inverse_bind
        return torch.cat([skinning, root_matrix], dim=-3)

    @cached_property
    def _at_rest(self) -> Tensor:
        """(n, 3, 4) what points are under where no joint moves, which is the same for every pose of a fit of shapes."""
        return self.blended(self.skinning_matrices())

    def blended(self, matrices: Tensor) -> Tensor:
        """(..., n, 3, 4) what each point is under of (..., j + 1, 4, 4) skinning matrices."""
        batch = matrices.shape[:-3]
        flat = matrices[..., :3, :].reshape(-1, matrices.shape[-3], 12)
        columns = flat.transpose(0, 1).reshape(matrices.shape[-3], -1)
        blended = (self._influences @ columns).reshape(self.point_count, len(flat), 3, 4).transpose(0, 1)
        return blended.reshape(*batch, self.point_count, 3, 4)

    def _constant(self, values: FloatArray) -> Tensor:
        return torch.as_tensor(np.array(values, dtype=np.float64), dtype=self.dtype, device=self.device)

    def _check(self, what: str, values: Tensor, shape: tuple[int, ...]) -> None:
        if tuple(values.shape[-len(shape) :]) != shape:
            expected = ", ".join(map(str, ("...", *shape)))
            raise InputError("differentiable rig", f"{what} of shape {tuple(values.shape)}, expected ({expected})")


def under(matrices: Tensor, points: Tensor) -> Tensor:
    """(..., n, 3) points (..., n, 3), each under its own of (..., n, 3, 4) matrices."""
    return (matrices[..., :3] @ points[..., None])[..., 0] + matrices[..., 3]


def coefficient_matrices(coefficients: Tensor) -> Tensor:
    """(..., 4, 4) matrices ``T Rz Rx Ry S`` of (..., 9) bone coefficients (DESIGN section 7)."""
    t, scale = coefficients[..., :3], coefficients[..., 6:]
    cx, cy, cz = coefficients[..., 3:6].cos().unbind(-1)
    sx, sy, sz = coefficients[..., 3:6].sin().unbind(-1)
    x = torch.stack([cz * cy - sz * sx * sy, sz * cy + cz * sx * sy, -cx * sy], dim=-1)
    y = torch.stack([-sz * cx, cz * cx, sx], dim=-1)
    z = torch.stack([cz * sy + sz * sx * cy, sz * sy - cz * sx * cy, cx * cy], dim=-1)
    upper = torch.cat([torch.stack([x, y, z], dim=-1) * scale[..., None, :], t[..., None]], dim=-1)
    last = coefficients.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*upper.shape[:-2], 1, 4)
    return torch.cat([upper, last], dim=-2)


def _deltas(rig: Rig, dtype: type[np.floating]) -> sparse.sparray | FloatArray:
    """(3 n, targets) as `Rig.delta_columns`; of identity modes, which move all points, without the detour of a sparse
    one, which takes five times as long."""
    if sum(len(target.point_indices) for target in rig.targets) < DENSE * len(rig.points) * len(rig.targets):
        return rig.delta_columns
    columns = np.zeros((len(rig.targets), len(rig.points), 3), dtype)
    for column, target in zip(columns, rig.targets, strict=True):
        column[target.point_indices] = target.offsets
    return columns.reshape(len(columns), 3 * len(rig.points)).T


def _activations(rig: Rig) -> list[Term]:
    terms = []
    for number, target in enumerate(rig.targets):
        base, slope, bends = target.curve.hinges()
        terms.append(Term(output=number, input=target.shape, base=base, slope=slope, bends=bends))
    return terms
