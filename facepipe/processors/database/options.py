"""How databases are made, and what may be added to them."""

from __future__ import annotations

from dataclasses import dataclass

from facepipe.declare import option
from facepipe.processors.database.quality import QualityLimits


@dataclass(frozen=True, kw_only=True)
class DatabaseOptions:
    """How a database is made."""

    tolerance_mm: float = option(
        0.1, "RMS error over all points to which each expression is held; less makes the file larger", 1e-4, 10.0, "mm"
    )


@dataclass(frozen=True, kw_only=True)
class AddOptions(QualityLimits):
    """What may be added to a database."""

    ignore_quality: bool = option(False, "add faces that miss the limits too; the history says so")
    drop_shapes: bool = option(
        False, "shapes of the database that a face lacks leave it; otherwise the face is refused"
    )


@dataclass(frozen=True, kw_only=True)
class FaceNames:
    """What faces are called in a database."""

    names: tuple[str, ...] = option(
        (),
        "names of the faces (default: those of their files)",
        parse=lambda words: tuple(name.strip() for word in words if word for name in word.split(",")),
        metavar="A,B,...",
        kept=False,
    )
