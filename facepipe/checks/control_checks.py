"""Checks of sliders, of their learned network, of the neural rig that a face links, and of the recipe."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice

import numpy as np
from pxr import Usd

from facepipe.checks.views import FaceView, Problem, array, at, unlisted, value, words
from facepipe.core import tokens
from facepipe.core.errors import FacepipeError
from facepipe.core.reading import digest
from facepipe.parts import FaceParts
from facepipe.registry import neural_rigs
from facepipe.rig import CHANNELS
from facepipe.rig.sliders import curve_fault
from facepipe.stage import Face
from facepipe.stage.neural_rig_link import NeuralRigLink, read_neural_rig_link
from facepipe.stage.prims import exact_name
from facepipe.stage.sliders import read_slider_network
from facepipe.verbs.whole_faces import Topology


def slider_names(prim: Usd.Prim | None) -> list[str]:
    """The sliders on a face prim, sorted."""
    if prim is None:
        return []
    prefix = tokens.SLIDER_PREFIX
    found = prim.GetAuthoredPropertiesInNamespace(prefix.rstrip(":"))
    return sorted({str(one.GetName()).removeprefix(prefix).rpartition(":")[0] for one in found} - {""})


def person_pose(face: FaceView) -> Iterator[Problem]:
    """The pose that is the person is an animation of the face."""
    if face.prim is None:
        return
    name = str(value(face.prim.GetAttribute(tokens.PERSON)) or "")
    if name and name not in {exact_name(animation.GetPrim()) for animation in face.animations}:
        yield at(f"{face.prim.GetPath()}.{tokens.PERSON}", f"'{name}' is no animation of the face")


def slider_lists(face: FaceView) -> Iterator[Problem]:
    """Joints, channels and gains of a slider are parallel, and so are shapes and their gains."""
    for name in slider_names(face.prim):
        for lists in (("joints", "channels", "channelGains"), ("shapes", "shapeGains")):
            lengths = [_length(face.prim, name, one) for one in lists]
            if len(set(lengths)) > 1:
                found = ", ".join(f"{length} {one}" for one, length in zip(lists, lengths, strict=True))
                yield at(_path(face.prim, name), f"{found}, expected as many of each")


def slider_range(face: FaceView) -> Iterator[Problem]:
    """A slider's minimum is at most its default, and that at most its maximum."""
    for name in slider_names(face.prim):
        low, default, high = (_number(face.prim, name, one) for one in ("minimum", "default", "maximum"))
        if not low <= default <= high:
            yield at(_path(face.prim, name), f"default {default:g}, expected {low:g} to {high:g}")


def slider_value(face: FaceView) -> Iterator[Problem]:
    """A slider's value is within its range; values beyond are clamped."""
    for name in slider_names(face.prim):
        if value(_attribute(face.prim, name, "value")) is not None:
            own, low, high = (_number(face.prim, name, one) for one in ("value", "minimum", "maximum"))
            if not low <= own <= high:
                yield at(_path(face.prim, name), f"value {own:g}, expected {low:g} to {high:g}")


def slider_curves(face: FaceView) -> Iterator[Problem]:
    """Curves of sliders have 2 knots or more, values that ascend and amounts that never turn back."""
    for name in slider_names(face.prim):
        fault = _curves_fault(face.prim, name)
        if fault:
            yield at(_path(face.prim, name), fault)


def _curves_fault(prim: Usd.Prim | None, name: str) -> str | None:
    fields = ("channelKnots", "shapeKnots", "knotValues", "knotAmounts")
    found = (array(value(_attribute(prim, name, field))) for field in fields)
    channels, shapes, values, amounts = ([] if one is None else one.tolist() for one in found)
    for field, counts, beside in (("channelKnots", channels, "joints"), ("shapeKnots", shapes, "shapes")):
        if counts and len(counts) != _length(prim, name, beside):
            return f"{len(counts)} {field}, expected none or as many as {beside}"
    counts = [*channels, *shapes]
    if not all(count >= 0 for count in counts) or not sum(counts) == len(values) == len(amounts):
        have = f"{len(values)} knotValues and {len(amounts)} knotAmounts"
        return f"{have}, expected as many of each as channelKnots and shapeKnots say"
    knots = iter(zip(values, amounts, strict=True))
    return next(filter(None, (curve_fault(tuple(islice(knots, int(count)))) for count in counts if count)), None)


def slider_mirrors(face: FaceView) -> Iterator[Problem]:
    """The mirror of a slider is another slider, which names it as its own."""
    names = slider_names(face.prim)
    mirrors = {name: str(value(_attribute(face.prim, name, "mirror")) or "") for name in names}
    for name, other in mirrors.items():
        if other and (other == name or mirrors.get(other) != name):
            if other == name:
                fault = "is the slider itself"
            elif other not in mirrors:
                fault = "is no slider"
            else:
                fault = f"has '{mirrors[other]}' as its mirror" if mirrors[other] else "has no mirror"
            where = f"{_path(face.prim, name)}:mirror"
            yield at(where, f"'{other}' {fault}, expected two sliders that name each other")


def slider_targets(face: FaceView) -> Iterator[Problem]:
    """Sliders drive joints, channels and blendshapes that the face has."""
    for name in slider_names(face.prim):
        for field, known in (("joints", set(face.joints)), ("channels", set(CHANNELS)), ("shapes", face.shape_names)):
            yield from unlisted(_path(face.prim, name), field, words(_attribute(face.prim, name, field)), known)


def recipe_options(face: FaceView) -> Iterator[Problem]:
    """The options of the recipe are a JSON object."""
    attribute = face.prim.GetAttribute(tokens.RECIPE_OPTIONS) if face.prim else None
    text = value(attribute)
    if text is None:
        return
    try:
        parsed = json.loads(str(text))
    except (ValueError, RecursionError):
        parsed = None
    if not isinstance(parsed, dict):
        yield at(attribute, "no JSON object, expected one")


def recipe_digests(face: FaceView) -> Iterator[Problem]:
    """The recipe has a digest per source."""
    if face.prim is None:
        return
    sources, digests = (len(words(face.prim.GetAttribute(n))) for n in (tokens.RECIPE_SOURCES, tokens.RECIPE_DIGESTS))
    if sources != digests:
        yield at(f"{face.prim.GetPath()}.{tokens.RECIPE_DIGESTS}", f"{digests} digests, expected {sources}")


def _attribute(prim: Usd.Prim | None, slider: str, field: str) -> Usd.Attribute | None:
    return prim.GetAttribute(f"{tokens.SLIDER_PREFIX}{slider}:{field}") if prim else None


def _path(prim: Usd.Prim | None, slider: str) -> str:
    return f"{prim.GetPath() if prim else ''}.{tokens.SLIDER_PREFIX}{slider}"


def _length(prim: Usd.Prim | None, slider: str, field: str) -> int:
    found = value(_attribute(prim, slider, field))
    return len(found) if hasattr(found, "__len__") else 0


def _number(prim: Usd.Prim | None, slider: str, field: str) -> float:
    found = array([value(_attribute(prim, slider, field))])
    if found is not None and len(found) and np.isfinite(found[0]):
        return float(found[0])
    return 1.0 if field == "maximum" else 0.0


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
    joints, channels = (tuple(channel[i] for channel in network.channels) for i in range(2))
    for field, names, known in (
        ("sliders", network.sliders, set(slider_names(face.prim))),
        ("joints", joints, set(face.joints)),
        ("channels", channels, set(CHANNELS)),
        ("shapes", network.shapes, face.shape_names),
    ):
        yield from unlisted(where, field, names, known)


def neural_rig_file(face: FaceView) -> Iterator[Problem]:
    """The file of the neural rig that a face links is there, whole, and learned on the meshes that the link names."""
    link = _neural_rig_link(face)
    if link is None:
        return
    if link.path is None:
        where = _link_path(face, tokens.NEURAL_RIG_FILE)
        yield at(where, link.refusal or f"@{link.file}@ can't be found, expected a neural rig (.fpnr)")
        return
    try:
        rig = neural_rigs().load(link.path)
    except FacepipeError as error:
        yield at(_link_path(face, tokens.NEURAL_RIG_FILE), str(error))
        return
    if rig.topology != link.topology:
        yield at(_link_path(face, tokens.NEURAL_RIG_TOPOLOGY), "not that of the file, expected the same")


def neural_rig_digest(face: FaceView) -> Iterator[Problem]:
    """The file of the neural rig that a face links is still the one that was put on it."""
    link = _neural_rig_link(face)
    if link is not None and link.path is not None and digest([link.path]) != link.digest:
        where = _link_path(face, tokens.NEURAL_RIG_DIGEST)
        yield at(where, f"@{link.file}@ has changed, expected the file of {link.digest[:19]}...")


def neural_rig_topology(face: FaceView) -> Iterator[Problem]:
    """The neural rig that a face links was learned on meshes of the face's names, point counts and faces."""
    link = _neural_rig_link(face)
    if link is None:
        return
    try:
        meshes = Face(face.stage, face.prim).meshes
    except FacepipeError:
        return  # other checks say what is wrong with them
    if Topology.of(FaceParts(meshes=meshes)).digest != link.topology:
        yield at(_link_path(face, tokens.NEURAL_RIG_TOPOLOGY), "not that of the meshes, expected a rig learned on them")


def _neural_rig_link(face: FaceView) -> NeuralRigLink | None:
    return None if face.prim is None else read_neural_rig_link(face.prim)


def _link_path(face: FaceView, name: str) -> str:
    return f"{face.prim.GetPath() if face.prim else ''}.{name}"
