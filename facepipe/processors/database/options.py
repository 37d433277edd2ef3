"""How databases are made, and what may be added to them."""

from __future__ import annotations

from dataclasses import dataclass, field

from facepipe.processors.database.quality import QualityLimits


@dataclass(frozen=True, kw_only=True)
class DatabaseOptions:
    """How a database is made."""

    tolerance_mm: float = field(
        default=0.1,
        metadata={
            "help": "RMS error over all points to which each expression is held; less makes the file larger",
            "unit": "mm",
            "range": (1e-4, 10.0),
        },
    )


@dataclass(frozen=True, kw_only=True)
class AddOptions(QualityLimits):
    """What may be added to a database."""

    ignore_quality: bool = field(
        default=False, metadata={"help": "add faces that miss the limits too; the history says so"}
    )
    drop_shapes: bool = field(
        default=False,
        metadata={"help": "shapes of the database that a face lacks leave it; otherwise the face is refused"},
    )
