"""The reference runtime: evaluates a graph of facepipe with onnxruntime on the CPU."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe_onnx.metadata import PREFIX, model_metadata
from facepipe_onnx.read import problems, read

Array = npt.NDArray[Any]


class Deformer:
    """A loaded graph. `sliders` and `shapes` name what it takes, `joints` what it moves, `outputs` what it gives."""

    def __init__(self, path: str | os.PathLike[str], *, threads: int = 1) -> None:
        """:raises InputError: no such file, or no sound facepipe graph"""
        self.path = Path(path)
        model = read(self.path)
        for problem in problems(model):
            raise InputError(f"{self.path} -> {problem.where}", problem.message)
        self.metadata: dict[str, Any] = model_metadata(model)
        self._inputs = {one["name"]: one for one in self.metadata["inputs"]}
        self.sliders: tuple[str, ...] = tuple(self._inputs.get("sliders", {}).get("names", ()))
        self.shapes: tuple[str, ...] = tuple(self._inputs.get("weights", {}).get("names", ()))
        given = {one["name"]: one for one in self.metadata["outputs"]}
        jointed = self._inputs.get("coefficients", self._inputs.get("joint_transforms", given.get("coefficients", {})))
        self.joints: tuple[str, ...] = tuple(jointed.get("joints", ()))
        names = {one["path"]: str(one.get("name", one["path"])) for one in self.metadata.get("joints", ())}
        self.joint_names = tuple(names.get(joint, joint) for joint in self.joints)
        self.outputs: tuple[str, ...] = tuple(given)
        # unless given: the values set on the face, or the default, which may be of the last axes alone
        self._defaults: dict[str, Array] = {}
        for name, entry in self._inputs.items():
            if entry.get("required"):
                continue
            try:
                values = np.asarray(entry["values"] if "values" in entry else entry["default"], dtype=np.float64)
                if not np.isfinite(values).all():
                    raise ValueError("not finite")
                whole = np.broadcast_to(values, tuple(entry["shape"]))
                self._defaults[name] = np.ascontiguousarray(whole, dtype=np.float32)
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                where = f"{self.path} -> metadata {PREFIX}inputs -> {name}"
                raise InputError(where, f"no default that fits shape {entry['shape']}") from error
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what fails is raised, and said once
        providers, data = ["CPUExecutionProvider"], model.SerializeToString()
        try:
            self._session: Any = onnxruntime.InferenceSession(data, options, providers=providers)
        except Exception as error:  # onnxruntime's errors share no other base
            raise InputError(self.path, f"onnxruntime can't load it ({_line(error)})") from error

    def evaluate(
        self,
        weights: Mapping[str, float] | None = None,
        *,
        coefficients: npt.ArrayLike | Mapping[str, npt.ArrayLike] | None = None,
        joint_transforms: npt.ArrayLike | None = None,
        parent: npt.ArrayLike | None = None,
        sliders: Mapping[str, float] | None = None,
    ) -> dict[str, Array]:
        """The outputs of one pose by name, float32, without batch axis: ``points`` (n, 3), ...

        :param weights: shape weights by name; those not named are 0
        :param coefficients: (joints, 9), or 9 numbers by joint path; joints not named stay at rest
        :param joint_transforms: (joints, 4, 4) local transforms, for graphs made with matrix inputs
        :param parent: (4, 4) world matrix that roots hang under, for graphs with that input
        :param sliders: slider values by name, for graphs of sliders; those not named are as on the face
        :raises InputError: names, counts or inputs that the graph has not, or numbers that are not finite
        """
        feeds: dict[str, npt.ArrayLike] = {}  # an empty mapping is no input: a graph without shapes has none of them
        if weights:
            feeds["weights"] = self._by_name("weights", weights, self.shapes)
        if sliders:
            feeds["sliders"] = self._by_name("sliders", sliders, self.sliders)
        if isinstance(coefficients, Mapping):
            if coefficients:
                feeds["coefficients"] = self._by_name("coefficients", coefficients, self.joints)
        elif coefficients is not None:
            feeds["coefficients"] = coefficients
        if joint_transforms is not None:
            feeds["joint_transforms"] = joint_transforms
        if parent is not None:
            feeds["parent"] = parent
        return {name: values[0] for name, values in self.run(feeds).items()}

    def run(self, feeds: Mapping[str, npt.ArrayLike]) -> dict[str, Array]:
        """All outputs by name, with batch axis.

        :param feeds: inputs by name, with or without batch axis; those not given have their defaults
        :raises InputError: unknown inputs, missing ones, wrong shapes, or numbers that are not finite in float32
        """
        full = dict(self._defaults)
        for name, values in feeds.items():
            where = f"{self.path} -> {name}"
            if name not in self._inputs:
                raise InputError(where, f"no such input, expected one of {', '.join(self._inputs) or 'none'}")
            shape = tuple(self._inputs[name]["shape"])
            try:
                with np.errstate(over="ignore"):
                    array = np.asarray(values, dtype=np.float64).astype(np.float32)
            except (TypeError, ValueError) as error:
                raise InputError(where, f"expected numbers of shape {shape[1:]}") from error
            if array.shape not in (shape, shape[1:]):
                raise InputError(where, f"shape {array.shape}, expected {shape[1:]}")
            if not np.isfinite(array).all():
                raise InputError(where, "NaN, infinity or beyond float32, expected finite numbers")
            full[name] = np.ascontiguousarray(np.broadcast_to(array, shape))
        for name in sorted(self._inputs.keys() - full.keys()):
            shape = tuple(self._inputs[name]["shape"][1:])
            raise InputError(f"{self.path} -> {name}", f"not given, expected numbers of shape {shape}")
        try:
            results = self._session.run(list(self.outputs), full)
        except Exception as error:  # onnxruntime's errors share no other base
            raise InputError(self.path, f"can't be evaluated ({_line(error)})") from error
        found = dict(zip(self.outputs, results, strict=True))
        for name, values in found.items():
            if not np.isfinite(values).all():
                raise InputError(f"{self.path} -> {name}", "NaN or infinity came out; are the inputs too large?")
        return found

    def _by_name(self, name: str, values: Mapping[str, Any], names: tuple[str, ...]) -> Array:
        """(names, ...) defaults of an input with `values` put in by name."""
        where = f"{self.path} -> {name}"
        if name not in self._inputs:
            raise InputError(where, f"no such input, expected one of {', '.join(self._inputs) or 'none'}")
        full: Array = self._defaults[name][0].astype(np.float64)
        number = {one: i for i, one in enumerate(names)}
        for key, value in values.items():
            if key not in number:
                raise InputError(where, unknown(key, names, name.rstrip("s")))
            try:
                full[number[key]] = np.asarray(value, dtype=np.float64).reshape(full.shape[1:])
            except (TypeError, ValueError) as error:
                size = full[number[key]].size
                raise InputError(f"{where} -> {key}", f"expected {size} number{'s' if size > 1 else ''}") from error
        return full


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
