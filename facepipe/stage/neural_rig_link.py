"""The neural rig that a face was given, by reference to its file."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from pxr import Sdf, Usd

from facepipe.core import tokens
from facepipe.core.reading import is_file
from facepipe.stage.api_schemas import apply_schema, is_applied, put_value
from facepipe.stage.assets import copy_refusal
from facepipe.stage.guard import reads_prim


class NeuralRigLink(NamedTuple):
    """A face's link to its neural rig."""

    file: str  # as authored
    path: Path | None  # of that file; None where there is none, or it may not be read
    digest: str  # "sha256:..." of the file when it was put on the face
    topology: str  # digest of the meshes that it was learned on
    refusal: str = ""  # why the file may not be read


@reads_prim
def read_neural_rig_link(prim: Usd.Prim) -> NeuralRigLink | None:
    """The link on a face prim; None where there is none."""
    if not is_applied(prim, tokens.NEURAL_RIG_API):
        return None
    attribute = prim.GetAttribute(tokens.NEURAL_RIG_FILE)
    file = attribute.Get() or Sdf.AssetPath()
    names = (tokens.NEURAL_RIG_DIGEST, tokens.NEURAL_RIG_TOPOLOGY)
    digest, topology = (str(prim.GetAttribute(name).Get() or "") for name in names)
    path = Path(str(file.resolvedPath)) if file.resolvedPath else None
    refused = copy_refusal(attribute.GetPath(), attribute, file) if path else None
    found = path if path and refused is None and is_file(path) else None
    return NeuralRigLink(str(file.path), found, digest, topology, refused.what if refused else "")


def author_neural_rig_link(prim: Usd.Prim, file: str, digest: str, topology: str) -> None:
    """Author the link on a face prim.

    :param file: path, relative to the layer where it can be
    """
    apply_schema(prim, tokens.NEURAL_RIG_API)
    put_value(prim, tokens.NEURAL_RIG_FILE, Sdf.AssetPath(file))
    put_value(prim, tokens.NEURAL_RIG_DIGEST, digest)
    put_value(prim, tokens.NEURAL_RIG_TOPOLOGY, topology)
