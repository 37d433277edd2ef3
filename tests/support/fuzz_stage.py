"""Damage done to USD stages: bytes, and values of other types, lengths, targets and units."""

from __future__ import annotations

import contextlib
import math
import random
from collections.abc import Callable
from typing import Any

from pxr import Gf, Sdf, Tf

TEXT = b'0123456789-.e,()[]"{}</>abcxyz \n\0\xff'
TYPES: dict[str, Any] = {
    "string": "text",
    "token[]": ["a", "b"],
    "token": "b",
    "float": 1.5,
    "float[]": [1.0, math.nan],
    "int[]": [-1, 2**31 - 1],
    "int": -(2**31),
    "bool": True,
    "double[]": [1e300, -1e300],
    "point3f[]": [Gf.Vec3f(math.inf)],
    "matrix4d[]": [Gf.Matrix4d(0), Gf.Matrix4d(math.nan)],
    "matrix4d": Gf.Matrix4d(math.nan),
    "quatf[]": [Gf.Quatf(0)],
    "asset": Sdf.AssetPath("../../../etc/passwd"),
    "texCoord2f[]": [Gf.Vec2f(1)],
}
NUMBERS = [math.nan, math.inf, -1.0, 0.0, 1e38, 2**31 - 1, -(2**31), 7]
TARGETS = ["/Tiny", "/Tiny/Head", "/Tiny/Skeleton", "/Gone", "/Tiny/Head.points", "/Tiny/Head/jawOpen"]
PRIM_TYPES = [
    "Mesh",
    "Xform",
    "Skeleton",
    "SkelRoot",
    "SkelAnimation",
    "BlendShape",
    "GeomSubset",
    "Material",
    "",
    "Nonsense",
]


def damaged_bytes(rng: random.Random, good: bytes, suffix: str) -> bytes:
    data = bytearray(good)
    if rng.random() < 0.2:
        return bytes(data[: rng.randrange(len(data))])
    for _ in range(rng.choice([1, 1, 2, 4, 16])):
        at = rng.randrange(len(data))
        if suffix == ".usdc" and rng.random() < 0.5:  # the header, and the tables at the end
            at = rng.choice([rng.randrange(88), len(data) - 1 - rng.randrange(2500)])
        data[at] = rng.choice(TEXT) if suffix == ".usda" else rng.choice([0, 127, 128, 255, rng.randrange(256)])
    return bytes(data)


def damage_value(rng: random.Random, layer: Sdf.Layer) -> None:
    """One change of a value, type, target or unit."""
    specs: list[Any] = []
    layer.Traverse("/", lambda path: specs.append(layer.GetObjectAtPath(path)))
    kinds: dict[str, Callable[[], None]] = {
        "attribute": lambda: _damage_attribute(rng, [spec for spec in specs if isinstance(spec, Sdf.AttributeSpec)]),
        "relationship": lambda: _damage_targets(
            rng, [spec for spec in specs if isinstance(spec, Sdf.RelationshipSpec)]
        ),
        "prim": lambda: _damage_prim(rng, [spec for spec in specs if isinstance(spec, Sdf.PrimSpec) and spec.name]),
        "unit": lambda: _damage_units(rng, layer),
    }
    kinds[rng.choice(["attribute"] * 6 + ["relationship", "prim", "unit"])]()


def _damage_attribute(rng: random.Random, specs: list[Sdf.AttributeSpec]) -> None:
    spec = rng.choice(specs)
    action = rng.choice(["type", "number", "length", "remove", "sample", "info", "block"])
    name, prim = spec.name, spec.owner
    if action == "type":
        kind = rng.choice(list(TYPES))
        del prim.properties[name]
        Sdf.AttributeSpec(prim, name, Sdf.ValueTypeNames.Find(kind)).default = TYPES[kind]
    elif action == "number":
        _replace_number(rng, spec)
    elif action == "length":
        value = spec.default
        if hasattr(value, "__len__") and not isinstance(value, str) and len(value):
            kept = rng.choice([0, 1, len(value) - 1])
            spec.default = type(value)(list(value)[:kept]) if rng.random() < 0.7 else type(value)([*value, value[0]])
    elif action == "remove":
        del prim.properties[name]
    elif action == "sample":
        if spec.default is not None:
            spec.layer.SetTimeSample(spec.path, rng.choice([-1.0, 0.0, 1e9]), spec.default)
            if rng.random() < 0.5:
                spec.ClearDefaultValue()
    elif action == "info":
        spec.SetInfo("elementSize", rng.choice([0, -1, 2, 2**31 - 1]))
        spec.SetInfo("interpolation", rng.choice(["constant", "uniform", "vertex", "faceVarying", "nonsense"]))
    else:
        spec.default = Sdf.ValueBlock()


def _replace_number(rng: random.Random, spec: Sdf.AttributeSpec) -> None:
    value = spec.default
    number = rng.choice(NUMBERS)
    if isinstance(value, float | int) and not isinstance(value, bool):
        spec.default = type(value)(number) if isinstance(value, float) or math.isfinite(number) else value
    elif hasattr(value, "__len__") and not isinstance(value, str) and len(value):
        at = rng.randrange(len(value))
        item = value[at]
        values = list(value)
        if isinstance(item, int):
            values[at] = int(number) if math.isfinite(number) and abs(number) < 2**31 else -5
        elif isinstance(item, float):
            values[at] = number
        elif isinstance(item, str):
            values[at] = rng.choice(["", "a b", "root/jaw", values[0]])
        else:
            values[at] = type(item)(number)
        spec.default = type(value)(values)


def _damage_targets(rng: random.Random, specs: list[Sdf.RelationshipSpec]) -> None:
    spec = rng.choice(specs)
    targets = rng.sample(TARGETS, rng.randrange(3))
    spec.targetPathList.ClearEditsAndMakeExplicit()
    for target in targets:
        spec.targetPathList.explicitItems.append(target)


def _damage_prim(rng: random.Random, specs: list[Sdf.PrimSpec]) -> None:
    spec = rng.choice(specs)
    action = rng.choice(["type", "api", "instance", "reference", "inactive"])
    if action == "type":
        spec.typeName = rng.choice(PRIM_TYPES)
    elif action == "api":
        spec.ClearInfo("apiSchemas")
    elif action == "instance":
        spec.instanceable = True
        spec.referenceList.Prepend(Sdf.Reference("", rng.choice(["/Tiny/Head", "/Tiny/Skeleton"])))
    elif action == "reference":
        spec.referenceList.Prepend(Sdf.Reference(rng.choice(["", "./gone.usda"]), rng.choice(["/Tiny", "/Gone"])))
    else:
        spec.active = False


def _damage_units(rng: random.Random, layer: Sdf.Layer) -> None:
    key = rng.choice(["metersPerUnit", "timeCodesPerSecond", "upAxis", "defaultPrim"])
    if key in ("upAxis", "defaultPrim"):
        layer.pseudoRoot.SetInfo(key, rng.choice(["X", "Z", "", "Gone", "Tiny/Head"]))
    else:
        layer.pseudoRoot.SetInfo(key, rng.choice([math.nan, 0.0, -1.0, 1e-300, math.inf]))


def damaged_stage(rng: random.Random, text: str) -> Sdf.Layer:
    """A layer of the text with some values changed."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(text)
    for _ in range(rng.choice([1, 1, 2, 3])):
        with contextlib.suppress(Tf.ErrorException, TypeError, OverflowError, IndexError):  # no value of that kind
            damage_value(rng, layer)
    return layer
