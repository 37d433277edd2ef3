"""Sliders of a face, their learned network, and the basis whose modes they move: read, checked and authored."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
from pxr import Usd, Vt

from facepipe.core import tokens
from facepipe.core.errors import FacepipeError, InputError, SchemaError
from facepipe.core.reading import check_values
from facepipe.parts import Curve, FaceParts, PersonBasis, Slider, SliderNetwork
from facepipe.rig.sliders import curves_fault, network_fault, sliders_fault
from facepipe.stage.prims import apply_schema, check_property_name, is_applied, put, put_value, remove_schema
from facepipe.stage.values import floats, ints, reads_prim, same, to_floats

_LONGEST_SECTION = 1 << 20  # bytes of a section
_OF_BASIS = (tokens.PERSON_BASIS, tokens.PERSON_DIGEST, tokens.PERSON_SECTION)

_NETWORK_PREFIX = tokens.NETWORK_LAYERS.rpartition(":")[0]


@reads_prim
def read_slider_network(prim: Usd.Prim) -> SliderNetwork | None:
    """The network on a face prim; None where there is none.

    :raises SchemaError: lists that are not parallel, numbers that are not those of its layers, or a damaged network
    """
    if not is_applied(prim, tokens.SLIDER_NETWORK_API):
        return None

    def value(name: str) -> Any:
        return prim.GetAttribute(name).Get()

    def words(name: str) -> tuple[str, ...]:
        return tuple(str(word) for word in value(name) or ())

    where = f"{prim.GetPath()}.{_NETWORK_PREFIX}"
    joints, channels = words(tokens.NETWORK_JOINTS), words(tokens.NETWORK_CHANNELS)
    if len(joints) != len(channels):
        raise SchemaError(where, f"{len(joints)} joints and {len(channels)} channels, expected as many of each")
    layers = ints(value(tokens.NETWORK_LAYERS)).tolist()
    weights, biases = floats(value(tokens.NETWORK_WEIGHTS)), floats(value(tokens.NETWORK_BIASES))
    if len(layers) < 2 or min(layers) < 1:
        raise SchemaError(
            f"{prim.GetPath()}.{tokens.NETWORK_LAYERS}", f"{layers[:8]}, expected 2 numbers or more from 1"
        )
    sizes = [into * out for into, out in pairwise(layers)]
    if (len(weights), len(biases)) != (sum(sizes), sum(layers[1:])):
        found = f"{len(weights)} weights and {len(biases)} biases"
        raise SchemaError(where, f"{found}, expected {sum(sizes)} and {sum(layers[1:])} for layers {layers[:8]}")
    trail, text = f"{prim.GetPath()}.{tokens.NETWORK_INFO}", str(value(tokens.NETWORK_INFO) or "{}")
    check_values(trail, text.encode())
    try:
        info = json.loads(text)
    except (ValueError, RecursionError):
        info = None
    if not isinstance(info, dict):
        raise SchemaError(trail, "no JSON object, expected one")
    # the matrices stand one after another, of each layer (outputs, inputs) row by row
    ends, shapes = list(accumulate(sizes))[:-1], pairwise(layers)
    network = SliderNetwork(
        sliders=words(tokens.NETWORK_SLIDERS),
        channels=tuple(zip(joints, channels, strict=True)),
        shapes=words(tokens.NETWORK_SHAPES),
        weights=tuple(
            part.reshape(out, into) for part, (into, out) in zip(np.split(weights, ends), shapes, strict=True)
        ),
        biases=tuple(np.split(biases, list(accumulate(layers[1:]))[:-1])),
        activation=str(value(tokens.NETWORK_ACTIVATION) or "tanh"),  # type: ignore[arg-type]
        info=info,
    )
    fault = network_fault(network)
    if fault:
        raise SchemaError(where, fault)
    return network


def check_face_network(where: object, parts: FaceParts, error: type[FacepipeError] = InputError) -> None:
    """Check that the network of a face is whole, and that the face has its sliders.

    :raises error: a damaged network, or one of sliders that the face lacks
    """
    network = parts.slider_network
    if network is None:
        return
    fault = network_fault(network)
    known = {slider.name for slider in parts.sliders}
    gone = [name for name in network.sliders if name not in known]
    if fault or gone:
        raise error(f"{where} -> slider network", fault or f"no slider '{gone[0]}'")


def author_slider_network(prim: Usd.Prim, network: SliderNetwork) -> None:
    """Apply a network to the face prim."""
    apply_schema(prim, tokens.SLIDER_NETWORK_API)
    for name, value in (
        (tokens.NETWORK_SLIDERS, list(network.sliders)),
        (tokens.NETWORK_JOINTS, [joint for joint, _ in network.channels]),
        (tokens.NETWORK_CHANNELS, [channel for _, channel in network.channels]),
        (tokens.NETWORK_SHAPES, list(network.shapes)),
        (tokens.NETWORK_LAYERS, network.layers),
        (tokens.NETWORK_WEIGHTS, to_floats(np.concatenate([weight.ravel() for weight in network.weights]))),
        (tokens.NETWORK_BIASES, to_floats(np.concatenate(network.biases))),
        (tokens.NETWORK_ACTIVATION, network.activation),
        (tokens.NETWORK_INFO, json.dumps(dict(network.info), sort_keys=True) if network.info else ""),
    ):
        put_value(prim, name, value)


def author_network_change(prim: Usd.Prim, old: SliderNetwork | None, new: SliderNetwork | None) -> tuple[str, ...]:
    """Author on the face prim the network where it differs, or hide the one that is gone; a line for it."""
    if same(old, new):
        return ()
    if new is not None:
        author_slider_network(prim, new)
        return ("slider network",)
    for attribute in prim.GetAuthoredPropertiesInNamespace(_NETWORK_PREFIX):
        put(attribute, None)
    remove_schema(prim, tokens.SLIDER_NETWORK_API)
    return ("slider network removed",)


@reads_prim
def read_person_basis(prim: Usd.Prim) -> PersonBasis | None:
    """What is on the face prim; None where there is none.

    :raises SchemaError: a section that is too long
    """
    if not is_applied(prim, tokens.PERSON_API):
        return None
    name, digest, data = (prim.GetAttribute(one).Get() for one in _OF_BASIS)
    section = b"" if data is None else np.asarray(data, np.uint8).tobytes()
    if len(section) > _LONGEST_SECTION:
        where = f"{prim.GetPath()}.{tokens.PERSON_SECTION}"
        raise SchemaError(where, f"{len(section):,} bytes, expected at most {_LONGEST_SECTION:,}")
    return PersonBasis(name=str(name or ""), digest=str(digest or ""), section=section)


def author_person_basis(prim: Usd.Prim, basis: PersonBasis | None) -> None:
    """Author a basis on the face prim, or hide that of weaker layers."""
    if basis is None:
        for name in _OF_BASIS:
            put_value(prim, name, None)
        remove_schema(prim, tokens.PERSON_API)
        return
    apply_schema(prim, tokens.PERSON_API)
    section = Vt.UCharArray.FromNumpy(np.frombuffer(basis.section, np.uint8)) if basis.section else None
    for name, value in zip(_OF_BASIS, (basis.name, basis.digest, section), strict=True):
        put_value(prim, name, value)


@reads_prim
def read_sliders(prim: Usd.Prim) -> tuple[Slider, ...]:
    """The sliders applied to the face prim, by name.

    :raises SchemaError: lists of one slider that are not parallel, an invalid range, a damaged curve, or a mirror
        that is not mutual
    """
    names = {
        attribute.GetName().removeprefix(tokens.SLIDER_PREFIX).rpartition(":")[0]
        for attribute in prim.GetAuthoredPropertiesInNamespace(tokens.SLIDER_PREFIX.rstrip(":"))
        if isinstance(attribute, Usd.Attribute)
        and attribute.HasAuthoredValue()  # an override layer blocks sliders that are gone
    }
    sliders = tuple(_slider(prim, name) for name in sorted(names))
    fault = sliders_fault(sliders)
    if fault:
        raise SchemaError(_where(prim, fault[0]), fault[1])
    return sliders


def _where(prim: Usd.Prim, name: str) -> str:
    return f"{prim.GetPath()}.{tokens.SLIDER_PREFIX}{name}"


def _slider(prim: Usd.Prim, name: str) -> Slider:
    def value(field: str) -> Any:
        return prim.GetAttribute(f"{tokens.SLIDER_PREFIX}{name}:{field}").Get()

    def number(field: str, otherwise: float) -> float:
        found = value(field)
        return otherwise if found is None else float(found)

    def words(field: str) -> list[str]:
        return [str(word) for word in value(field) or []]

    joints, channels, gains = words("joints"), words("channels"), floats(value("channelGains")).tolist()
    shapes, shape_gains = words("shapes"), floats(value("shapeGains")).tolist()
    modes, mode_gains = ints(value("modes")).tolist(), floats(value("modeGains")).tolist()
    where = _where(prim, name)
    if not len(joints) == len(channels) == len(gains) or len(shapes) != len(shape_gains):
        raise SchemaError(where, "joints, channels and gains (or shapes and gains) of different lengths")
    if len(modes) != len(mode_gains) or min(modes, default=0) < 0:
        raise SchemaError(f"{where}:modes", f"{len(modes)} modes and {len(mode_gains)} gains, expected as many, from 0")
    counts = [ints(value(field)).tolist() for field in ("channelKnots", "shapeKnots")]
    values, amounts = (floats(value(field)).tolist() for field in ("knotValues", "knotAmounts"))
    for field, own, expected in zip(("channelKnots", "shapeKnots"), counts, (len(joints), len(shapes)), strict=True):
        if len(own) not in (0, expected):
            raise SchemaError(f"{where}:{field}", f"{len(own)} counts, expected none or {expected}")
        if any(count < 0 or count == 1 for count in own):
            raise SchemaError(f"{where}:{field}", "a count of knots that is negative or 1, expected 0, or 2 or more")
    total = sum(map(sum, counts))
    if not len(values) == len(amounts) == total:
        raise SchemaError(where, f"{len(values)} knot values and {len(amounts)} amounts, expected {total} of each")
    # USD has no lists of lists: the knots of all curves stand one after another, and counts say how many are whose
    knots = list(zip(values, amounts, strict=True))
    slider = Slider(
        name=name,
        group=str(value("group") or ""),
        default=number("default", 0.0),
        minimum=number("minimum", 0.0),
        maximum=number("maximum", 1.0),
        value=None if value("value") is None else number("value", 0.0),
        channels=tuple(zip(joints, channels, gains, strict=True)),
        shapes=tuple(zip(shapes, shape_gains, strict=True)),
        channel_curves=_curves(knots, counts[0]),
        shape_curves=_curves(knots[sum(counts[0]) :], counts[1]),
        mirror=str(value("mirror") or "") or None,
        modes=tuple(zip(modes, mode_gains, strict=True)),
    )
    if not slider.minimum <= slider.default <= slider.maximum:
        raise SchemaError(where, f"default {slider.default}, expected {slider.minimum} to {slider.maximum}")
    fault = curves_fault(slider)
    if fault:
        raise SchemaError(where, fault)
    return slider


def _curves(knots: list[tuple[float, float]], counts: list[int]) -> tuple[Curve | None, ...]:
    ends = accumulate(counts)
    curves = tuple(tuple(knots[end - count : end]) or None for count, end in zip(counts, ends, strict=True))
    return curves if any(curves) else ()


def check_sliders(where: object, sliders: Sequence[Slider]) -> None:
    """Check what the sliders of a face must be together, and their curves.

    :raises InputError: a damaged curve, or a mirror that is not mutual
    """
    found = sliders_fault(sliders)
    if found:
        raise InputError(f"{where} -> slider {found[0]}", found[1])


def author_sliders(prim: Usd.Prim, sliders: Sequence[Slider]) -> None:
    """Apply sliders to the face prim.

    :raises InputError: a name that USD can't hold, or damaged curves
    """
    for slider in sliders:
        check_property_name(prim.GetPath(), "slider", slider.name, tokens.SLIDER_API)
        fault = curves_fault(slider)
        if fault:
            raise InputError(f"{prim.GetPath()} -> slider {slider.name}", fault)
    for slider in sliders:  # all before any attribute: USD composes the prim's definition anew after each
        apply_schema(prim, tokens.SLIDER_API, slider.name)
    for slider in sliders:
        prefix = f"{tokens.SLIDER_PREFIX}{slider.name}:"
        for name in ("group", "default", "minimum", "maximum"):
            put_value(prim, prefix + name, getattr(slider, name))
        put_value(prim, f"{prefix}value", slider.value)
        for fields, rows in (
            (("joints", "channels", "channelGains"), slider.channels),
            (("shapes", "shapeGains"), slider.shapes),
            (("modes", "modeGains"), slider.modes),
        ):
            for i, field in enumerate(fields):
                put_value(prim, prefix + field, [row[i] for row in rows] if rows else None)
        put_value(prim, f"{prefix}mirror", slider.mirror)
        lists = (("channelKnots", slider.channel_curves), ("shapeKnots", slider.shape_curves))
        knots = [knot for _, curves in lists for curve in curves for knot in curve or ()]
        for field, curves in lists:
            counts = [len(curve or ()) for curve in curves]
            put_value(prim, prefix + field, counts if any(counts) else None)
        for i, field in enumerate(("knotValues", "knotAmounts")):
            put_value(prim, prefix + field, [knot[i] for knot in knots] or None)
