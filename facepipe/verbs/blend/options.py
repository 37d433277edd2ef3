"""Options of a blend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from facepipe.declare import option

EdgeWeights = Literal["uniform", "cotangent"]
Missing = Literal["error", "transfer", "skip"]
Expressions = Literal["static", "document"]


@dataclass(frozen=True, kw_only=True)
class BlendOptions:
    """How to blend, whatever the weights."""

    align: str = option(
        "landmarks",
        "what each source is moved, turned and scaled onto the first one by: landmarks (nine of nose and eyes, that no "
        "expression moves), a region, or none",
        before="none",
    )
    contacts: bool = option(
        True,
        "skin is held out of eyeballs, teeth, gums and the other lip, but for how deep it lies in them in a source",
        before=False,
    )
    edges: EdgeWeights = option(
        "uniform", "weights of the edges in the solve: all the same, or cotangents of the mean shape"
    )
    expressions: Expressions = option(
        "static",
        "points that move in no source: held in the bi-Laplacian solve of each shape, or (document) put "
        "back after a free solve",
    )
    missing: Missing = option(
        "error", "shapes that some sources lack: an error, deformation transfer from those that have it, or skipped"
    )
    motion_of: int | None = option(
        None,
        "source N, from 1, that all shapes come from, whatever the weights",
        1,
        1_000_000,
        metavar="N",
        before=None,
    )
    static_mm: float = option(0.001, "a point that moves no further in any source is static", 0.0, 100.0, "mm")
    region_width_mm: float = option(
        0.0, "width of the harmonic transition put between regions; 0 takes their masks as they are", 0.0, 1000.0, "mm"
    )
    keep_shape: str = option(
        "auto",
        "meshes whose loose parts keep their shape up to rotation and scale: patterns, comma between; "
        "auto: those named like eyeballs and teeth",
    )
    anchor: str | None = option(
        None, "MESH:POINT that stays where it is in the first source; default its authored anchor"
    )
    solver: Literal["auto", "cholespy", "splu"] = option(
        "splu", "sparse factorisation: scipy's, or cholespy, whose last digits may differ from run to run"
    )
