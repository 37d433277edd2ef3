"""Run an exported ONNX deformer in onnxruntime and keep its outputs as arrays.

examples:
  facepipe eval head.onnx --set jawOpen=0.7 --bone jaw:rx=0.1 -o points.npz
  facepipe eval sliders.onnx --slider noseWidth=0.8 --set jawOpen=0.7 -o matrices.npz
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError
from facepipe.core.reports import Report
from facepipe.declare import source
from facepipe.kinds import FileAction, Job, action
from facepipe.verbs.render import Posed


@dataclass(frozen=True, kw_only=True)
class EvalReport(Report):
    """What a graph gave."""

    outputs: Mapping[str, Mapping[str, Any]]  # name -> shape, minimum, maximum


@action("eval", "run an exported ONNX file")
@dataclass(frozen=True, kw_only=True)
class Eval(Posed, FileAction[EvalReport]):
    """The action."""

    output = "arrays to write: .npz, one per output of the graph"
    suffixes = (".npz",)

    model: Path = source(".onnx file of `facepipe export`")

    def write(self, job: Job) -> EvalReport:
        import numpy as np

        from facepipe.core.atomic import replacing
        from facepipe.core.names import named
        from facepipe.registry import exporter
        from facepipe.rig.bone_coefficients import coefficients_of

        if self.model.suffix.lower() != ".onnx":
            raise InputError(self.model, f"suffix '{self.model.suffix}', expected .onnx")
        graphs: Any = exporter(self.model)
        deformer = graphs.Deformer(self.model)
        weights = named(self.weights, deformer.shapes, "--set", "shape")
        sliders = named(self.sliders, deformer.sliders, "--slider", "slider")
        coefficients = coefficients_of(self.bones, deformer.joints, deformer.joint_names)
        outputs = deformer.evaluate(weights, coefficients=coefficients, sliders=sliders)
        with replacing(job.out) as temporary, temporary.open("wb") as file:
            np.savez(file, **outputs)
        return EvalReport(
            outputs={
                name: {"shape": list(array.shape), "minimum": float(array.min()), "maximum": float(array.max())}
                for name, array in outputs.items()
            }
        )

    def text(self, report: EvalReport, out: Path) -> str:
        ranges = ((name, tuple(one["shape"]), one) for name, one in report.outputs.items())
        lines = [f"{name}: {shape}, {one['minimum']:g} to {one['maximum']:g}" for name, shape, one in ranges]
        return "\n".join([*lines, str(out)])
