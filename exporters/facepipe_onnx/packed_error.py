"""How far off the points of a graph of sliders are whose matrices are stored in fewer bytes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.parts import Slider
from facepipe.rig import Rig
from facepipe_onnx.slider_samples import slider_samples

_VECTORS = 256


def packed_error(packed: Any, whole: Any, rig: Rig, sliders: Sequence[Slider], mm_per_unit: float) -> dict[str, Any]:
    """Largest distance of a point in millimetres, and how many slider vectors it was measured over.

    These are the defaults, every slider alone at its ends, and random ones of few sliders and of many.

    :param packed: the model with fewer bytes
    :param whole: the same in float32
    :param rig: of the exported shapes
    """
    low, high, rest = (np.array([getattr(one, key) for one in sliders]) for key in ("minimum", "maximum", "default"))
    alone = np.repeat(rest[None], 2 * len(sliders), axis=0)
    alone[::2][np.diag_indices(len(sliders))], alone[1::2][np.diag_indices(len(sliders))] = low, high
    vectors = np.concatenate([alone, slider_samples(sliders, _VECTORS, seed=1)]).astype(np.float32)
    runs = [_points(model, rig, vectors) for model in (packed, whole)]
    worst = max(
        (float(np.linalg.norm(one - other, axis=1).max(initial=0.0)) for one, other in zip(*runs, strict=True)),
        default=0.0,
    )
    return {"error_mm": worst * mm_per_unit, "vectors": len(vectors)}


def _points(model: Any, rig: Rig, vectors: FloatArray) -> Iterator[FloatArray]:
    """World points (n, 3) under every vector, as a GPU makes them of the outputs."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    inputs = {one.name: np.zeros(one.shape, np.float32) for one in session.get_inputs()}
    if "parent" in inputs:
        inputs["parent"][:] = rig.parent_world
    given = {one.name for one in session.get_outputs()}
    names = [name for name in ("coefficients", "morph_weights") if name in given]
    for vector in vectors:
        inputs["sliders"][:] = vector
        found = dict(zip(names, session.run(names, inputs), strict=True))
        points, local = rig.points, rig.rest
        if "morph_weights" in found:
            points = points + (rig.deltas @ found["morph_weights"][0].astype(np.float64)).reshape(-1, 3)
        if "coefficients" in found:
            local = rig.local_transforms(found["coefficients"][0].astype(np.float64))
        yield rig.skin(points, rig.skinning_matrices(local))
