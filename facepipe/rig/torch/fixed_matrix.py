"""Products with a matrix that never changes, sparse where that pays."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

DENSE = 0.1  # share of non-zero entries from which a dense product is the faster one


class FixedMatrix:
    """``A x`` for a constant matrix A, with gradients to x.

    torch's own sparse products need MKL, or lose half their speed going backward; sums of weighted rows
    (`embedding_bag`) of A, and of its transpose for the gradient, run everywhere.
    """

    def __init__(self, matrix: sparse.sparray, dtype: torch.dtype, device: torch.device | str) -> None:
        """:param matrix: (r, c), copied"""
        self.shape: tuple[int, int] = matrix.shape
        rows, columns = matrix.shape
        self._dense: Tensor | None = None
        if matrix.nnz >= DENSE * rows * columns:
            self._dense = torch.as_tensor(matrix.toarray(), dtype=dtype, device=device)
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
