"""What a foreign stage says of the face in facepipe's own words, where it is a face already, or holds one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pxr import Usd

from facepipe.core import tokens
from facepipe.core.errors import FacepipeError
from facepipe.parts import BoneLimits, Slider, SliderNetwork
from facepipe.rig.sliders import with_mutual_mirrors
from facepipe.stage.foreign.scene import Scene, ancestors
from facepipe.stage.read_skeleton import read_limits
from facepipe.stage.read_slider_network import read_slider_network
from facepipe.stage.read_sliders import read_sliders


def attribution(scene: Scene) -> str:
    """The licence lines of every face that is read or that holds what is read, each once."""
    return "; ".join(_texts(scene, tokens.ATTRIBUTION))


def attach_joint(scene: Scene) -> str | None:
    """The body joint that the root joints hang under; the first where the stage names several."""
    found = _texts(scene, tokens.ATTACH_JOINT)
    if len(found) > 1:
        scene.warn(f"{len(found)} attach joints: '{found[0]}' is kept")
    return found[0] if found else None


def sliders(scene: Scene) -> tuple[Slider, ...]:
    """The sliders of all faces, the first of each name; those of a prim where they don't fit are left out."""
    found: dict[str, Slider] = {}
    for prim in _prims(scene):
        try:
            own = read_sliders(prim)
        except FacepipeError as error:
            scene.warn(f"{error}: sliders left out")
            continue
        twice = sorted({one.name for one in own} & {*found})
        if twice:
            scene.warn(f"sliders {', '.join(twice[:3])} ({len(twice)} in all) once more: left out", [prim])
        found = {one.name: one for one in own} | found
    return with_mutual_mirrors([found[name] for name in sorted(found)])


def slider_network(scene: Scene, own: Sequence[Slider]) -> SliderNetwork | None:
    """The first learned network that the sliders `own` are enough for; others are left out."""
    names, found = {one.name for one in own}, None
    for prim in _prims(scene):
        try:
            network = read_slider_network(prim)
        except FacepipeError as error:
            scene.warn(f"{error}: network left out")
            continue
        if network is not None and (found is not None or not names.issuperset(network.sliders)):
            scene.warn(
                "a learned network of sliders left out: it is one too many, or its sliders are not there", [prim]
            )
        elif network is not None:
            found = network
    return found


def limits(scene: Scene, skeleton: Usd.Prim, joint_count: int) -> BoneLimits | None:
    """The bone limits of the skeleton; None where they don't fit its joints."""
    try:
        return read_limits(skeleton, joint_count)
    except FacepipeError as error:
        scene.warn(f"{error}: bone limits left out")
        return None


def _texts(scene: Scene, name: str) -> list[str]:
    values = [prim.GetAttribute(name).Get() for prim in _prims(scene)]
    return list(dict.fromkeys(text for value in values if value and (text := str(value).strip())))


def _prims(scene: Scene) -> Iterator[Usd.Prim]:
    """The default prim, what stands above the roots, and all that is read, each once."""
    default = scene.stage.GetDefaultPrim()
    above = [one for root in scene.roots for one in ancestors(root)]
    yield from dict.fromkeys([*([default] if default else []), *above, *scene.prims])
