"""What a cook is asked to do, and what it did, file by file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from facepipe.core.reports import Finding, Report
from facepipe.declare import option


@dataclass(frozen=True, kw_only=True)
class CookOptions:
    """What to do with the recipes that are found."""

    force: bool = option(False, "cook what is up to date too")
    dry_run: bool = option(False, "list what would be cooked, and write nothing")
    validate: bool = option(False, "then check each STAGE, as facepipe validate does")


Action = Literal["up to date", "cooked", "stale", "outside the roots"]


@dataclass(frozen=True, kw_only=True)
class NodeReport:
    """What was done about one file with a recipe, and why."""

    file: Path
    verb: str  # of its recipe
    action: Action  # stale: to be cooked, which a dry run does not; outside the roots: stale, and not to be written
    why: tuple[str, ...] = ()  # one line each; none where it is up to date
    seconds: float = 0.0
    missed: bool = False  # done, but a check or threshold was missed
    warnings: tuple[str, ...] = ()
    report: Mapping[str, Any] | None = None  # of the command, where it was cooked


@dataclass(frozen=True, kw_only=True)
class CookReport(Report):
    """All files with recipes, in the order in which they depend on each other."""

    nodes: tuple[NodeReport, ...]
    findings: Mapping[str, tuple[Finding, ...]]  # file -> what checks found, where they were asked for
    seconds: float

    @property
    def good(self) -> bool:
        """Whether everything is up to date now, no threshold was missed and no check found an error."""
        errors = [one for found in self.findings.values() for one in found if one.severity == "error"]
        done = all(node.action in ("up to date", "cooked") and not node.missed for node in self.nodes)
        return done and not errors
