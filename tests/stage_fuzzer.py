"""Reads damaged stages with every reader, and prints one line per stage that broke the rule.

A program of its own: what kills the interpreter inside USD must not take the other tests along.

usage: python stage_fuzzer.py bytes|values SUFFIX SEED FIRST COUNT FOLDER
       python stage_fuzzer.py usd FILE: reads all of FILE by USD alone, to see whether USD survives it
"""

from __future__ import annotations

import contextlib
import json
import math
import random
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Tf, Usd
from test_validate import good_face

import facepipe
from facepipe.errors import FacepipeError
from facepipe.importers import load
from facepipe.stage import save_parts
from facepipe.validate import validate

MEMORY = 3 << 29  # bytes
SECONDS = 30  # no reader may take longer over a file of some kilobytes

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


def readers(path: Path) -> dict[str, Callable[[], object]]:
    def open_all() -> None:
        face = facepipe.open(path)
        parts = face.parts()
        face.evaluate(dict.fromkeys(face.shapes, 0.5))
        face.evaluate(sliders={one.name: one.maximum for one in parts.sliders})

    return {"open": open_all, "import": lambda: load("usd", path), "validate": lambda: validate(path)}


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
    kinds = {
        "attribute": lambda: _damage_attribute(rng, [one for one in specs if isinstance(one, Sdf.AttributeSpec)]),
        "relationship": lambda: _damage_targets(rng, [one for one in specs if isinstance(one, Sdf.RelationshipSpec)]),
        "prim": lambda: _damage_prim(rng, [one for one in specs if isinstance(one, Sdf.PrimSpec) and one.name]),
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


def check(name: str, path: Path, counts: Counter[str]) -> None:
    """Reads `path` with every reader; a line for each that breaks the rule."""
    for reader, run in readers(path).items():
        print(f"at {name} {reader}", flush=True)  # the last such line names what killed the program
        start = time.monotonic()
        try:
            run()
            counts[f"{reader} read"] += 1
        except FacepipeError as error:
            counts[f"{reader} refused"] += 1
            if "\n" in str(error) or "Traceback" in str(error):
                print(f"FAILED {name} {reader}: not one line: {error!r}", flush=True)
        except BaseException as error:
            trace = " | ".join(line.strip().replace("\n", " ") for line in traceback.format_exception(error)[-3:])
            print(f"FAILED {name} {reader}: {trace}", flush=True)
        if time.monotonic() - start > SECONDS:
            print(f"FAILED {name} {reader}: took more than {SECONDS} s", flush=True)


def usd_alone(path: str) -> None:
    """What our readers ask of USD, without them."""
    with contextlib.suppress(Tf.ErrorException, UnicodeDecodeError, RuntimeError):
        stage = Usd.Stage.Open(path)
        stage.GetCompositionErrors()
        for prim in stage.Traverse():
            for attribute in prim.GetAttributes():
                for time_code in [Usd.TimeCode.Default(), *map(Usd.TimeCode, attribute.GetTimeSamples())]:
                    with contextlib.suppress(Tf.ErrorException, UnicodeDecodeError):
                        attribute.Get(time_code)
            for relationship in prim.GetRelationships():
                relationship.GetForwardedTargets()


def limit_memory() -> None:
    """A count of billions in a damaged file ends as an error of memory, not of time."""
    with contextlib.suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main() -> None:
    limit_memory()
    if sys.argv[1] == "usd":
        usd_alone(sys.argv[2])
        return
    mode, suffix, seed, folder = sys.argv[1], sys.argv[2], int(sys.argv[3]), Path(sys.argv[6])
    np.seterr(all="ignore")
    good = folder / f"good{suffix}"
    if not good.exists():
        save_parts(good_face(), good)
    data, counts = good.read_bytes(), Counter[str]()
    text = Sdf.Layer.FindOrOpen(str(good)).ExportToString()
    for number in range(int(sys.argv[4]), int(sys.argv[4]) + int(sys.argv[5])):
        rng = random.Random(f"{mode} {suffix} {seed} {number}")
        path = folder / f"case{number}{suffix}"
        if mode == "bytes":
            path.write_bytes(damaged_bytes(rng, data, suffix))
        else:
            layer = Sdf.Layer.CreateAnonymous(".usda")
            layer.ImportFromString(text)
            for _ in range(rng.choice([1, 1, 2, 3])):
                with contextlib.suppress(Tf.ErrorException, TypeError, OverflowError):  # no value of that kind
                    damage_value(rng, layer)
            layer.Export(str(path))
        check(path.name, path, counts)
        path.unlink()
    print(f"DONE {json.dumps(counts, sort_keys=True)}", flush=True)


if __name__ == "__main__":
    main()
