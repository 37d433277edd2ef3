"""The solvers that a test runs with: every one that is installed."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

_ABSENT = pytest.mark.skipif(find_spec("cholespy") is None, reason="cholespy, which is optional, is not installed")

SOLVERS = pytest.mark.parametrize("solver", [pytest.param("cholespy", marks=_ABSENT), "splu", "auto"])
