"""Factors of sparse symmetric positive definite matrices, made once and solved many times.

``A = P^T L L^T P`` with a permutation P that keeps L sparse: on a surface of n points a fill-reducing ordering leaves L
about n log n values. The systems here are solved for 3 to some hundred right-hand sides each, which is why they are
factored rather than iterated on. A step of registration (26,719 points with three unknowns each, 68 right-hand sides,
one thread) takes 0.75 s by CHOLMOD, 0.96 s by QDLDL and 0.97 s by SuperLU.
"""

from __future__ import annotations

from typing import Any, Literal, Protocol

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError

Solver = Literal["auto", "cholespy", "splu"]


class Factor(Protocol):
    """A factored matrix A of shape (n, n)."""

    def solve(self, right: FloatArray) -> FloatArray:
        """The x of A x = `right`, (n,) or (n, m) float64."""
        ...


def elimination_order(matrix: Any) -> IntArray:
    """(n,) order of the rows of a sparse A in which factors of ``A^T A``, and of parts of it, fill in little.

    It is that of COLAMD (Davis et al., ACM TOMS 2004), which looks at A alone. The bi-Laplacians of the 142 shapes of a
    head are parts of one. Found for each, by minimum degree, orders take a quarter of the time of the factors, which
    then have 15 % fewer values; in the order of minimum degree of the whole one they have 6 % more.
    """
    from scipy.sparse import eye_array
    from scipy.sparse.linalg import splu

    if matrix.shape[0] == 0:
        return np.zeros(0, np.int64)
    solvable = (matrix + eye_array(matrix.shape[0])).tocsc()  # only its pattern counts, but scipy factors it too
    return np.argsort(splu(solvable, permc_spec="COLAMD", diag_pivot_thresh=0.0).perm_c)


def factorise(matrix: Any, solver: Solver = "auto", *, ordered: bool = False) -> Factor:
    """Factor a scipy sparse matrix, symmetric positive definite, by Cholesky.

    :param solver: ``auto`` takes CHOLMOD through cholespy where it is installed, otherwise scipy's SuperLU with a
        symmetric minimum degree ordering. CHOLMOD's METIS orders by random numbers of the whole process: where another
        thread draws some, the last digits are others
    :param ordered: its rows are in an order of elimination, which SuperLU keeps
    :raises InputError: cholespy asked for and not installed
    :raises RuntimeError, ValueError: the matrix is not positive definite
    """
    compressed = matrix.tocsc()
    compressed.sort_indices()
    # CHOLMOD refuses a matrix without rows
    if compressed.shape[0] == 0:
        return _Empty()
    if solver != "splu":
        try:
            return _Cholmod(compressed)
        except ImportError:
            if solver == "cholespy":
                raise InputError("option solver", "cholespy is not installed, expected auto or splu") from None
    return _SuperLu(compressed, "NATURAL" if ordered else "MMD_AT_PLUS_A")


class _Empty:
    def solve(self, right: FloatArray) -> FloatArray:
        return np.asarray(right, dtype=np.float64).copy()


class _Cholmod:
    def __init__(self, matrix: Any) -> None:
        from cholespy import CholeskySolverD, MatrixType

        pointers, indices = matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32)
        data = matrix.data.astype(np.float64)
        self._solver = CholeskySolverD(matrix.shape[0], pointers, indices, data, MatrixType.CSC)

    def solve(self, right: FloatArray) -> FloatArray:
        right_sides = np.ascontiguousarray(right, dtype=np.float64)
        solution = np.zeros_like(right_sides)
        if right_sides.size:
            self._solver.solve(right_sides, solution)
            # cholespy 2.2 never frees its copy of the right-hand sides, 46 MB in a fit's steps: one of no columns takes
            # its place. Twenty heads in one process grew to 17 GB
            nothing = np.zeros((len(right_sides), 0))
            self._solver.solve(nothing, nothing)
        return solution


class _SuperLu:
    def __init__(self, matrix: Any, order: str) -> None:
        from scipy.sparse.linalg import splu

        # its default, COLAMD, fills in nearly twice as much: 2.0 million values to 1.1, on a grid of 160 by 160 points
        options = {"SymmetricMode": True}
        # a column at a time, without relaxed supernodes, whose zeros it stores: 2.5 to 1.7 s for the shapes of a head
        plain = {"relax": 1, "panel_size": 1}
        self._solver = splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, options=options, **plain)

    def solve(self, right: FloatArray) -> FloatArray:
        return np.asarray(self._solver.solve(np.asarray(right, dtype=np.float64)))
