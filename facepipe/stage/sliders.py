"""Sliders of a face: read, checked and authored."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

from pxr import Usd

from facepipe.core import tokens
from facepipe.core.errors import InputError, SchemaError
from facepipe.parts import Curve, Slider
from facepipe.rig.sliders import curves_fault, sliders_fault
from facepipe.stage.api_schemas import apply_schema, check_property_name, put_value
from facepipe.stage.guard import reads_prim
from facepipe.stage.values import floats, ints


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
    where = _where(prim, name)
    if not len(joints) == len(channels) == len(gains) or len(shapes) != len(shape_gains):
        raise SchemaError(where, "joints, channels and gains (or shapes and gains) of different lengths")
    counts = [ints(value(field)).tolist() for field in ("channelKnots", "shapeKnots")]
    values, amounts = (floats(value(field)).tolist() for field in ("knotValues", "knotAmounts"))
    _check_counts(where, counts, (len(joints), len(shapes)), (len(values), len(amounts)))
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
    )
    if not slider.minimum <= slider.default <= slider.maximum:
        raise SchemaError(where, f"default {slider.default}, expected {slider.minimum} to {slider.maximum}")
    fault = curves_fault(slider)
    if fault:
        raise SchemaError(where, fault)
    return slider


def _check_counts(where: str, counts: list[list[int]], entries: tuple[int, int], knots: tuple[int, int]) -> None:
    for field, own, expected in zip(("channelKnots", "shapeKnots"), counts, entries, strict=True):
        if len(own) not in (0, expected):
            raise SchemaError(f"{where}:{field}", f"{len(own)} counts, expected none or {expected}")
        if any(count < 0 or count == 1 for count in own):
            raise SchemaError(f"{where}:{field}", "a count of knots that is negative or 1, expected 0, or 2 or more")
    total = sum(map(sum, counts))
    if knots != (total, total):
        raise SchemaError(where, f"{knots[0]} knot values and {knots[1]} amounts, expected {total} of each")


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
        _author_slider(prim, slider)


def _author_slider(prim: Usd.Prim, slider: Slider) -> None:
    prefix = f"{tokens.SLIDER_PREFIX}{slider.name}:"
    for name in ("group", "default", "minimum", "maximum"):
        put_value(prim, prefix + name, getattr(slider, name))
    put_value(prim, f"{prefix}value", slider.value)
    for fields, rows in (
        (("joints", "channels", "channelGains"), slider.channels),
        (("shapes", "shapeGains"), slider.shapes),
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
