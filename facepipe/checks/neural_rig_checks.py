"""Checks of the neural rig that a face links."""

from __future__ import annotations

from collections.abc import Iterator

from facepipe.checks.views import FaceView, Problem, at
from facepipe.core import tokens
from facepipe.core.errors import FacepipeError
from facepipe.core.reading import digest
from facepipe.parts import FaceParts
from facepipe.processors.database import Topology
from facepipe.processors.neural_rig import load_neural_rig
from facepipe.stage import Face
from facepipe.stage.neural_rig_link import NeuralRigLink, read_neural_rig_link


def neural_rig_file(face: FaceView) -> Iterator[Problem]:
    """The file of the neural rig that a face links is there, whole, and learned on the meshes that the link names."""
    link = _link(face)
    if link is None:
        return
    if link.path is None:
        yield at(_where(face, tokens.NEURAL_RIG_FILE), f"@{link.file}@ can't be found, expected a neural rig (.fpnr)")
        return
    try:
        rig = load_neural_rig(link.path)
    except FacepipeError as error:
        yield at(_where(face, tokens.NEURAL_RIG_FILE), str(error))
        return
    if rig.topology != link.topology:
        yield at(_where(face, tokens.NEURAL_RIG_TOPOLOGY), "not that of the file, expected the same")


def neural_rig_digest(face: FaceView) -> Iterator[Problem]:
    """The file of the neural rig that a face links is still the one that was put on it."""
    link = _link(face)
    if link is not None and link.path is not None and digest([link.path]) != link.digest:
        where = _where(face, tokens.NEURAL_RIG_DIGEST)
        yield at(where, f"@{link.file}@ has changed, expected the file of {link.digest[:19]}...")


def neural_rig_topology(face: FaceView) -> Iterator[Problem]:
    """The neural rig that a face links was learned on meshes of the face's names, point counts and faces."""
    link = _link(face)
    if link is None:
        return
    try:
        meshes = Face(face.stage, face.prim).meshes
    except FacepipeError:
        return  # other checks say what is wrong with them
    if Topology.of(FaceParts(meshes=meshes)).digest != link.topology:
        yield at(_where(face, tokens.NEURAL_RIG_TOPOLOGY), "not that of the meshes, expected a rig learned on them")


def _link(face: FaceView) -> NeuralRigLink | None:
    return None if face.prim is None else read_neural_rig_link(face.prim)


def _where(face: FaceView, name: str) -> str:
    return f"{face.prim.GetPath() if face.prim else ''}.{name}"
