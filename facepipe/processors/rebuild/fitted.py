"""What the fits of a rebuild hand on to the stages after them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from facepipe.geometry.similarity import Similarity
from facepipe.processors.rebuild.register_scans import Composite, NeutralScan


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """How a result lies on its scan."""

    place: Similarity  # from the scan's coordinates to those of the points
    report: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class FittedNeutral(Fitted):
    """The neutral, as corrected."""

    scan: NeutralScan


@dataclass(frozen=True, kw_only=True)
class FittedExpression(Fitted):
    """An expression, as corrected."""

    composite: Composite
