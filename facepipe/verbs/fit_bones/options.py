"""Options of a bone fit, and limits of bones as a field of an action."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.declare import JsonValue, Ranged, option

if TYPE_CHECKING:
    from facepipe.verbs.fit_bones.limits import LimitRules

STRICTER = 0.99  # of the threshold: what solves stop at leaves room for the rounding of what is authored
_ROUNDS = 2


@dataclass(frozen=True, kw_only=True)
class FitBonesOptions(Ranged):
    """How far to go, and what to keep of what bones can't reach.

    :raises InputError: a number out of range
    """

    threshold_mm: float = option(0.1, "a target is reached where no point is further from it", 1e-6, 1e6, "mm")
    max_iterations: int = option(200, "steps of a solve, at most", 1, 1_000_000)
    rounds: int | None = option(
        None,
        "rounds that even the largest distance, at most, where a target is not reached (default 2; with a "
        "residual 0, which keeps it small)",
        0,
        1000,
    )
    regularise: float = option(
        0.0,
        "weight of the mean square strain of the bones beside that of the distances: 0.1 to 1 calms bones "
        "that points hardly hold",
        0.0,
        1e6,
    )
    sparsity: float = option(
        0.0,
        "weight of the mean strain: fewer channels move, the others stay exactly at rest; 1 to 20 for some",
        0.0,
        1e6,
    )
    symmetric: bool = option(
        False,
        "joints of one side move as the mirror image of the other's, paired by names (left and right, L "
        "and R); joints in the middle keep to it",
    )
    residual: bool = option(False, "keep what bones can't reach as a sparse blendshape TARGET_residual")

    @property
    def evening(self) -> int:
        """Rounds that even the largest distance."""
        if self.rounds is not None:
            return self.rounds
        return 0 if self.residual else _ROUNDS


def read_rules(path: Path) -> LimitRules:
    """The limits in a file."""
    from facepipe.verbs.fit_bones.limits import read_limits

    return read_limits(path)


def _load_rules(content: object, where: str) -> LimitRules | None:
    from facepipe.verbs.fit_bones.limits import limits_from_json

    return None if content is None else limits_from_json(content, where)


LIMIT_RULES = JsonValue(lambda rules: None if rules is None else rules.to_json(), _load_rules)  # whole in recipes
