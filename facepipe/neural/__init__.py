"""Learn what a rig does, as one small network: a neural rig.

examples:
  facepipe neural-rig train head.usdc -o head.fpnr
  facepipe neural-rig apply head.usdc head.fpnr -o neural.usda
  facepipe neural-rig retarget head.fpnr anna.usdc --frames anna_clip.usdc -o anna.fpnr
  facepipe neural-rig invert head.fpnr talk.usdc -o controls.usda --threshold-mm 0.5

`facepipe neural-rig ACTION --help` shows options. `facepipe export --neural` writes what an engine loads.
"""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.neural.apply_action import ApplyNeuralRig
    from facepipe.neural.attach import AttachNeuralRig, with_neural_rig
    from facepipe.neural.invert import InvertNeuralRig
    from facepipe.neural.motion import Motion, ReadClips, SampleMotion
    from facepipe.neural.neural_rig_file import load_encoder, load_neural_rig, save_neural_rig
    from facepipe.neural.options import (
        AttachOptions,
        FrameBlocksOptions,
        InvertNeuralRigOptions,
        SampleMotionOptions,
        TrainEncoderOptions,
        TrainNeuralRigOptions,
    )
    from facepipe.neural.read_motion import ReadMotion
    from facepipe.neural.train_encoder import TrainedEncoder, TrainEncoder
    from facepipe.neural.train_neural_rig import TrainedNeuralRig, TrainNeuralRig
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "ApplyNeuralRig",
    "AttachNeuralRig",
    "AttachOptions",
    "FrameBlocksOptions",
    "InvertNeuralRig",
    "InvertNeuralRigOptions",
    "Motion",
    "ReadClips",
    "ReadMotion",
    "SampleMotion",
    "SampleMotionOptions",
    "TrainEncoder",
    "TrainEncoderOptions",
    "TrainNeuralRig",
    "TrainNeuralRigOptions",
    "TrainedEncoder",
    "TrainedNeuralRig",
    "load_encoder",
    "load_neural_rig",
    "save_neural_rig",
    "with_neural_rig",
]
