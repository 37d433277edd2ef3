"""Options of a cook."""

from __future__ import annotations

from dataclasses import dataclass

from facepipe.declare import option


@dataclass(frozen=True, kw_only=True)
class CookOptions:
    """What to do with the recipes that are found."""

    force: bool = option(False, "cook also what is up to date")
    dry_run: bool = option(False, "tell what would be cooked, and write nothing")
    validate: bool = option(False, "then check each STAGE, as facepipe validate does")
