"""Options of a bone fit."""

from __future__ import annotations

from dataclasses import dataclass, field

from facepipe.options import check_ranges

_ROUNDS = 2


@dataclass(frozen=True, kw_only=True)
class FitBonesOptions:
    """How far to go, and what to keep of what bones can't reach.

    :raises InputError: a number out of range
    """

    threshold_mm: float = field(
        default=0.1,
        metadata={
            "help": "a target is reached where no point is further from it",
            "range": (1e-6, 1e6),
            "unit": "mm",
        },
    )
    max_iterations: int = field(default=200, metadata={"help": "steps of a solve, at most", "range": (1, 1_000_000)})
    rounds: int | None = field(
        default=None,
        metadata={
            "help": "rounds that even the largest distance, at most, where a target is not reached (default 2; with a "
            "residual 0, which keeps it small)",
            "range": (0, 1000),
        },
    )
    regularise: float = field(
        default=0.0,
        metadata={
            "help": "weight of the mean square strain of the bones beside that of the distances: 0.1 to 1 calms bones "
            "that points hardly hold",
            "range": (0.0, 1e6),
        },
    )
    sparsity: float = field(
        default=0.0,
        metadata={
            "help": "weight of the mean strain: fewer channels move, the others stay exactly at rest; 1 to 20 for some",
            "range": (0.0, 1e6),
        },
    )
    symmetric: bool = field(
        default=False,
        metadata={
            "help": "joints of one side move as the mirror image of the other's, paired by names (left and right, L "
            "and R); joints in the middle keep to it"
        },
    )
    residual: bool = field(
        default=False,
        metadata={"help": "keep what bones can't reach as a sparse blendshape TARGET_residual"},
    )

    def __post_init__(self) -> None:
        check_ranges(self)

    @property
    def evening(self) -> int:
        """Rounds that even the largest distance."""
        if self.rounds is not None:
            return self.rounds
        return 0 if self.residual else _ROUNDS
