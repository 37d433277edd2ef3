"""Options of a cook."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class CookOptions:
    """What to do with the recipes that are found."""

    force: bool = field(default=False, metadata={"help": "cook also what is up to date"})
    dry_run: bool = field(default=False, metadata={"help": "tell what would be cooked, and write nothing"})
    validate: bool = field(default=False, metadata={"help": "then check each STAGE, as facepipe validate does"})
