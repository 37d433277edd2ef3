"""Checks of the learned network of the sliders."""

from __future__ import annotations

from collections.abc import Iterator

from facepipe.checks.control_checks import slider_names
from facepipe.checks.problem import Problem, at, some
from facepipe.checks.views import FaceView
from facepipe.core import tokens
from facepipe.core.errors import FacepipeError
from facepipe.rig import CHANNELS
from facepipe.stage.read_slider_network import read_slider_network


def slider_network(face: FaceView) -> Iterator[Problem]:
    """The learned network of the sliders is whole, and takes and gives what the face has."""
    if face.prim is None:
        return
    where = f"{face.prim.GetPath()}.{tokens.NETWORK_LAYERS.rpartition(':')[0]}"
    try:
        network = read_slider_network(face.prim)
    except FacepipeError as error:
        yield at(error.where or where, error.what)
        return
    if network is None:
        return
    joints, channels = (tuple(one[i] for one in network.channels) for i in range(2))
    for field, found, known in (
        ("sliders", network.sliders, set(slider_names(face.prim))),
        ("joints", joints, set(face.joints)),
        ("channels", channels, set(CHANNELS)),
        ("shapes", network.shapes, face.shape_names),
    ):
        unknown = sorted(set(found) - set(known))
        if unknown:
            yield at(f"{where}:{field}", f"{some(unknown)}: unknown, expected {field} of the face")
