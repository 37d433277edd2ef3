"""Lets tests import the modules of `benchmarks/`: import this first."""

from __future__ import annotations

import sys

from places import REPOSITORY

BENCHMARKS = REPOSITORY / "benchmarks"
if str(BENCHMARKS) not in sys.path:
    sys.path.append(str(BENCHMARKS))
