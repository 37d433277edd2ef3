"""What exports and checks of the core do with neural rigs, found by name: `facepipe.registry.NeuralRigs`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.neural.options import AttachOptions as Options

if TYPE_CHECKING:
    from facepipe.neural.attach import AttachedNeuralRig
    from facepipe.parts import FaceParts
    from facepipe.rig.neural_rig import NeuralEncoder, NeuralRig

NAME = "neural rigs"
FORMER = {"facepipe.processors.neural_rig": ("facepipe.neural",)}
__all__ = ["FORMER", "NAME", "Options", "attached", "encoder", "load"]


def load(path: Path) -> NeuralRig:
    """The rig in a file.

    :raises InputError: no neural rig
    """
    from facepipe.neural.neural_rig_file import load_neural_rig

    return load_neural_rig(path)


def attached(face: FaceParts, path: Path, options: Options, where: str) -> AttachedNeuralRig:
    """The face with the rig of a file.

    :raises InputError: a damaged rig
    :raises TopologyError: other meshes, joints or skin than the rig was learned on
    """
    from facepipe.neural.attach import AttachNeuralRig

    return AttachNeuralRig(options=options)(face, load(path), where)


def encoder(path: Path) -> NeuralEncoder:
    """The encoder in the file of a rig.

    :raises InputError: a damaged rig, or one without an encoder
    """
    from facepipe.neural.neural_rig_file import load_encoder

    return load_encoder(path)
