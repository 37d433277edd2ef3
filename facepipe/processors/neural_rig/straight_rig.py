"""The neural rig of what is straight in its controls: no hidden layer, a linear map that is solved for."""

from __future__ import annotations

import numpy as np

from facepipe.processors.neural_rig.motion import Motion
from facepipe.processors.neural_rig.output_basis import OutputBasis
from facepipe.rig.neural_rig import NeuralRig, from_default


def straight_rig(motion: Motion, basis: OutputBasis) -> NeuralRig:
    """The map of least squared error on all frames, which is 0 where the controls are at their defaults."""
    inputs = from_default(motion.controls, motion.values)
    outputs = basis.outputs(motion) @ np.linalg.inv(basis.metric)
    count = outputs.shape[1]
    return NeuralRig(
        controls=motion.controls,
        rest=basis.rest,
        shapes=basis.shapes,
        linear=np.linalg.lstsq(inputs, outputs, rcond=None)[0],
        hidden=np.zeros((0, len(motion.controls))),
        hidden_bias=np.zeros(0),
        last=np.zeros((count, 0)),
        last_bias=np.zeros(count),
        topology=motion.topology.digest,
        bones=motion.bones,
        channels=basis.channels,
    )
