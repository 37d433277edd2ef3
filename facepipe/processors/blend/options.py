"""Options of a blend."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

EdgeWeights = Literal["uniform", "cotangent"]
Missing = Literal["error", "transfer", "skip"]
Expressions = Literal["static", "document"]


@dataclass(frozen=True, kw_only=True)
class BlendOptions:
    """How to blend, whatever the weights."""

    edges: EdgeWeights = field(
        default="uniform",
        metadata={
            "help": "weights of the edges in the solve: all the same, or cotangents of the mean shape",
            "choices": ("uniform", "cotangent"),
        },
    )
    expressions: Expressions = field(
        default="static",
        metadata={
            "help": "points that move in no source: held in the bi-Laplacian solve of each shape, or (document) put "
            "back after a free solve",
            "choices": ("static", "document"),
        },
    )
    missing: Missing = field(
        default="error",
        metadata={
            "help": "shapes that some sources lack: an error, deformation transfer from those that have it, or skipped",
            "choices": ("error", "transfer", "skip"),
        },
    )
    static_mm: float = field(
        default=0.001,
        metadata={
            "help": "a point that moves no further in any source is static",
            "range": (0.0, 100.0),
            "unit": "mm",
        },
    )
    region_width_mm: float = field(
        default=0.0,
        metadata={
            "help": "width of the harmonic transition put between regions; 0 takes their masks as they are",
            "range": (0.0, 1000.0),
            "unit": "mm",
        },
    )
    keep_shape: str = field(
        default="auto",
        metadata={
            "help": "meshes whose loose parts keep their shape up to rotation and scale: patterns, comma between; "
            "auto: those named like eyeballs and teeth"
        },
    )
    anchor: str | None = field(
        default=None,
        metadata={"help": "MESH:POINT that stays where it is in the first source; default its authored anchor"},
    )
    solver: Literal["auto", "cholespy", "splu"] = field(
        default="auto",
        metadata={
            "help": "sparse factorisation: cholespy where installed, otherwise splu (scipy)",
            "choices": ("auto", "cholespy", "splu"),
        },
    )
