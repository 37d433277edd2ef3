"""The neural rig that a face was given, by reference to its file."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from pxr import Sdf, Usd

from facepipe.core import tokens
from facepipe.stage.api_schemas import apply_schema, is_applied, put_value
from facepipe.stage.guard import reads_prim


class NeuralRigLink(NamedTuple):
    """A face's link to its neural rig."""

    file: str  # as authored
    path: Path | None  # of that file; None where there is none
    digest: str  # "sha256:..." of the file when it was put on the face
    topology: str  # digest of the meshes that it was learned on


@reads_prim
def read_neural_rig_link(prim: Usd.Prim) -> NeuralRigLink | None:
    """The link on a face prim; None where there is none."""
    if not is_applied(prim, tokens.NEURAL_RIG_API):
        return None
    file = prim.GetAttribute(tokens.NEURAL_RIG_FILE).Get() or Sdf.AssetPath()
    resolved = Path(str(file.resolvedPath)) if file.resolvedPath else None
    texts = [str(prim.GetAttribute(one).Get() or "") for one in (tokens.NEURAL_RIG_DIGEST, tokens.NEURAL_RIG_TOPOLOGY)]
    return NeuralRigLink(str(file.path), resolved if resolved and resolved.is_file() else None, *texts)


def author_neural_rig_link(prim: Usd.Prim, file: str, digest: str, topology: str) -> None:
    """Author the link on a face prim.

    :param file: path, relative to the layer where it can be
    """
    apply_schema(prim, tokens.NEURAL_RIG_API)
    put_value(prim, tokens.NEURAL_RIG_FILE, Sdf.AssetPath(file))
    put_value(prim, tokens.NEURAL_RIG_DIGEST, digest)
    put_value(prim, tokens.NEURAL_RIG_TOPOLOGY, topology)
