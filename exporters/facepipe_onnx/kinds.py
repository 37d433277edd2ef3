"""The kinds of graphs that facepipe writes: their formats, and what they take and give."""

from __future__ import annotations

from typing import NamedTuple


class Kind(NamedTuple):
    """One kind of graph."""

    name: str
    inputs: frozenset[str]
    outputs: frozenset[str]
    needed: tuple[frozenset[str], ...]  # inputs and outputs of which one of these sets is always there

    @property
    def format(self) -> dict[str, object]:
        """What the metadata says under ``format``."""
        return {"name": self.name, "version": 1}


DEFORMER = Kind(
    "facepipe deformer",
    frozenset({"weights", "coefficients", "joint_transforms", "parent"}),
    frozenset({"points", "joint_matrices", "normals"}),
    (frozenset({"points"}),),
)
SLIDERS = Kind(
    "facepipe sliders",
    frozenset({"sliders", "weights", "parent"}),
    frozenset({"coefficients", "skinning_matrices", "morph_weights", "points", "normals"}),
    (frozenset({"sliders", "coefficients", "skinning_matrices"}), frozenset({"sliders", "morph_weights"})),
)
ENCODER = Kind(
    "facepipe encoder",
    frozenset({"points"}),
    frozenset({"controls"}),
    (frozenset({"points", "controls"}),),
)
KINDS = (DEFORMER, SLIDERS, ENCODER)
