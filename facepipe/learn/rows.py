"""Rows of a table by number."""

from __future__ import annotations

from torch import Tensor


def take(table: Tensor, rows: Tensor) -> Tensor:
    """(..., c) rows of a table (n, c).

    `gather`, whose gradient is a `scatter_add`: on a CPU several times as fast as that of indexing.
    """
    columns = table.shape[1]
    return table.gather(0, rows.reshape(-1, 1).expand(-1, columns)).reshape(*rows.shape, columns)
