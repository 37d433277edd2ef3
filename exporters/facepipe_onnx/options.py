"""Options of the ONNX exporter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from facepipe.core.errors import InputError
from facepipe.declare import POSE_HELP, check_ranges, option


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the ONNX exporter."""

    pose: str = option("set", POSE_HELP)
    sliders: bool = option(False, "a graph of the face's sliders: bone coefficients, skinning matrices, morph weights")
    encoder: bool = option(False, "with --neural: the graph from points back to controls, in place of the rig's")
    points: bool = option(False, "with --sliders: also output the points")
    weights: Literal["float32", "float16", "int8"] = option(
        "float32",
        "with --sliders: how the file holds gains and network; the report gives the point error "
        "(float16 and int8 need the operator Cast)",
    )
    inputs: Literal["coefficients", "matrices"] = option(
        "coefficients", "what moves the joints: 9 bone coefficients each, or local 4x4 joint transforms"
    )
    joint_matrices: bool = option(False, "also output the world matrices of all joints")
    normals: bool = option(False, "also output area-weighted point normals (needs the operators Div and Sqrt)")
    parent: bool = option(False, "add an input: the world matrix of the body joint that the face hangs under")
    shapes: str = option("*", "blendshapes to export: globs, separated by commas")
    batch: int = option(1, "poses per evaluation, fixed in the graph", 1, 256, "poses")

    def check(self) -> None:
        """Check the values.

        :raises InputError: a value outside its choices or range
        """
        # options of the other kind of graph are refused, not ignored: who gives them expects that they do something
        check_ranges(self)
        if not isinstance(self.batch, int):
            raise InputError("option batch", f"is {self.batch!r}, expected a whole number")
        if self.sliders and self.encoder:
            raise InputError(
                "option encoder", "given with the option sliders, which makes another graph, expected one of them"
            )
        if not self.sliders:
            if self.points:
                raise InputError("option points", "is for graphs of sliders, others always have that output")
            if self.weights != "float32":
                raise InputError("option weights", "is for graphs of sliders, expected the option sliders too")
            return
        if self.inputs != "coefficients":
            raise InputError("option inputs", "is not for graphs of sliders, which make the coefficients themselves")
        if self.joint_matrices:
            raise InputError(
                "option joint_matrices", "is not for graphs of sliders, which always have skinning_matrices"
            )
        if self.normals and not self.points:
            raise InputError("option normals", "without points, expected the option points too")
