"""Authors a learned network beside the sliders of a face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from facepipe.core.errors import InputError
from facepipe.core.reports import Report
from facepipe.parts import Recipe, Slider, SliderNetwork
from facepipe.rig import slide
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes


@dataclass(frozen=True, kw_only=True)
class AuthorNetworkReport(Report):
    """What was authored."""

    sliders: tuple[str, ...]  # that go in
    channels: int  # that are added to
    shapes: int
    layers: tuple[int, ...]  # numbers that go into the first, and that come out of each
    replaced: bool  # the face had another network
    authored: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class AuthorNetwork:
    """A learned network on a face, which adds to what its sliders do; one that it has is replaced."""

    network: SliderNetwork

    def __call__(self, face: Face, *, recipe: Recipe | None = None) -> AuthorNetworkReport:
        """Author it.

        :param recipe: authored with the result; None leaves what the face has
        :raises InputError: a damaged network, or one of sliders, joints, channels or shapes that the face has not
        """
        parts, network = face.parts(), self.network
        try:
            slide(parts.sliders, parts.skeleton.joints, network=network)
            face.rig().weight_vector(dict.fromkeys(network.shapes, 0.0))
        except InputError as error:
            raise error.under(face.where) from None
        changed = replace(parts, slider_network=network, recipe=recipe or parts.recipe)
        authored = author_changes(face, changed)
        return AuthorNetworkReport(
            sliders=network.sliders,
            channels=len(network.channels),
            shapes=len(network.shapes),
            layers=(len(network.sliders), *(len(bias) for bias in network.biases)),
            replaced=parts.slider_network is not None,
            authored=authored,
        )


def fitting_network(
    network: SliderNetwork | None, sliders: Sequence[Slider]
) -> tuple[SliderNetwork | None, tuple[str, ...]]:
    """The network of a face that gets other `sliders`, and a warning where it can't stay: one of its own is gone."""
    if network is None:
        return None, ()
    known = {one.name for one in sliders}
    gone = [name for name in network.sliders if name not in known]
    if not gone:
        return network, ()
    return None, (f"the learned network of the sliders is dropped: it needs '{gone[0]}'",)
