"""GLBs with KHR_materials_variants written by hand, and what stages and GLBs show of their variants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gltf_builder import PNG, Builder
from gltf_reader import read
from pxr import Usd, UsdGeom, UsdShade

Json = dict[str, Any]
EXTENSION = "KHR_materials_variants"
COLORS = {  # of materials, by which they are known again
    "skin": (0.5, 0.25, 0.125),
    "pale": (1.0, 0.75, 0.5),
    "dark": (0.125, 0.0625, 0.0),
    "red": (1.0, 0.0, 0.0),
    "cloth": (0.0, 0.25, 0.5),
}
NAMES = ("Light", "so dark / very", "夜 の色", "2-tone", "default")
# primitive -> its material, and material by variant where a mapping has one
PRIMITIVES: Sequence[tuple[str, Mapping[str, str]]] = (
    ("skin", {"Light": "pale", "so dark / very": "dark", "夜 の色": "dark", "2-tone": "red"}),
    ("skin", {"Light": "red"}),  # the same material, changed otherwise
    ("skin", {}),  # and one that no variant changes
    ("cloth", {"Light": "cloth", "default": "pale"}),
    ("pale", {"2-tone": "skin"}),  # a material that variants show elsewhere
)
EXPECTED = {
    name: [own if name is None else by_variant.get(name, own) for own, by_variant in PRIMITIVES]
    for name in (None, *NAMES)
}


def with_variants(names: Sequence[Any] = NAMES, primitives: Any = PRIMITIVES, textured: str | None = "red") -> Builder:
    """A mesh of primitives of 32 triangles each, side by side."""
    builder = Builder()
    order = [*COLORS]
    for name, color in COLORS.items():
        surface: Json = {"baseColorFactor": [*color, 1.0], "metallicFactor": 0.0}
        if name == textured:
            image = builder.add("images", {"bufferView": builder.view(PNG), "mimeType": "image/png"})
            moved = {"KHR_texture_transform": {"offset": [0.25, 0.0]}}
            surface["baseColorTexture"] = {"index": builder.add("textures", {"source": image}), "extensions": moved}
        builder.add("materials", {"name": name, "pbrMetallicRoughness": surface})
    x, y = (one.ravel() for one in np.meshgrid(np.arange(5.0), np.arange(5.0)))
    first = np.array([row * 5 + column for row in range(4) for column in range(4)])
    triangles = np.concatenate([first[:, None] + [0, 1, 6], first[:, None] + [0, 6, 5]])
    made = []
    for number, (own, by_variant) in enumerate(primitives):
        points = np.stack([x * 0.01 + number * 0.05, y * 0.05, np.zeros(25)], axis=1)
        mappings: dict[str, list[int]] = {}
        for variant, other in by_variant.items():
            mappings.setdefault(other, []).append(names.index(variant))
        primitive: Json = {
            "attributes": {"POSITION": builder.array(points), "TEXCOORD_0": builder.array(np.stack([x, y], 1) / 8)},
            "indices": builder.array(triangles.ravel(), "u2"),
            "targets": [{"POSITION": builder.array(np.tile([0.0, 0.0, 0.01], (25, 1)))}],
            "material": order.index(own),
        }
        if mappings:
            listed = [{"material": order.index(other), "variants": numbers} for other, numbers in mappings.items()]
            primitive["extensions"] = {EXTENSION: {"mappings": listed}}
        made.append(primitive)
    builder.add("meshes", {"name": "Head", "primitives": made, "extras": {"targetNames": ["out"]}})
    builder.add("nodes", {"name": "Head", "mesh": 0})
    builder.add("scenes", {"nodes": [0]})
    builder.root["extensionsUsed"] = ["KHR_texture_transform", EXTENSION]
    builder.root["extensions"] = {EXTENSION: {"variants": [{"name": name} for name in names]}}
    return builder


def called(color: Sequence[float]) -> str:
    """The material of a colour."""
    return next(name for name, own in COLORS.items() if np.allclose(own, color, atol=1e-3))


def variants_on(stage: Usd.Stage) -> dict[str | None, str]:
    """Exact name -> USD's of each variant; None for the one that is selected, with the file's own materials."""
    prim = stage.GetDefaultPrim()
    chosen = prim.GetVariantSet("shadingVariant")
    found: dict[str | None, str] = {None: chosen.GetVariantSelection()}
    stage.SetEditTarget(stage.GetSessionLayer())
    for name in chosen.GetVariantNames():
        chosen.SetVariantSelection(name)
        exact = prim.GetAttribute("facepipe:shadingVariant").Get()
        if exact or name != found[None]:
            found[exact or name] = name
    chosen.SetVariantSelection(str(found[None]))
    return found


def shown_on(stage: Usd.Stage, variant: str) -> dict[str, str]:
    """Mesh or part of one -> the material bound to it, as USD itself resolves it, by its colour."""
    prim = stage.GetDefaultPrim()
    stage.SetEditTarget(stage.GetSessionLayer())
    prim.GetVariantSet("shadingVariant").SetVariantSelection(variant)
    shown = {}
    for one in Usd.PrimRange(prim):
        if not one.IsA(UsdGeom.Mesh) and not one.IsA(UsdGeom.Subset):
            continue
        material, _ = UsdShade.MaterialBindingAPI(one).ComputeBoundMaterial()
        if material:
            surface = material.ComputeSurfaceSource()[0]
            given = surface.GetInput("diffuseColor")
            if given.HasConnectedSource():
                given = UsdShade.Shader(given.GetConnectedSources()[0][0].source.GetPrim()).GetInput("scale")
            shown[str(one.GetPath())] = called(list(given.Get())[:3])
    return shown


def by_primitive(stage: Usd.Stage, variant: str) -> list[str]:
    """The material of each primitive of `with_variants`, by where its part of the mesh lies."""
    shown, found = shown_on(stage, variant), {}
    for path, material in shown.items():
        prim = stage.GetPrimAtPath(path)
        if prim.IsA(UsdGeom.Subset):
            mesh = UsdGeom.Mesh(prim.GetParent())
            corners = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
            faces = corners[np.array(UsdGeom.Subset(prim).GetIndicesAttr().Get())]
            at = np.array(mesh.GetPointsAttr().Get())[faces].mean(axis=(0, 1))
            scale = UsdGeom.GetStageMetersPerUnit(stage)
            found[round((at[0] * scale - 0.02) / 0.05)] = material
    return [found[number] for number in sorted(found)]


def in_glb(path: Path) -> dict[str | None, list[str]]:
    """What each primitive of the first mesh of a GLB shows in each variant, None for its own, left to right."""
    file = read(path)
    materials = [one["pbrMetallicRoughness"].get("baseColorFactor", [1, 1, 1]) for one in file.list("materials")]
    names = [one["name"] for one in file.json["extensions"][EXTENSION]["variants"]]
    assert EXTENSION in file.json["extensionsUsed"]
    found: dict[str | None, list[str]] = {name: [] for name in (None, *names)}
    primitives = file.list("meshes")[0]["primitives"]
    for one in sorted(primitives, key=lambda one: file.decoded(one["attributes"]["POSITION"])[:, 0].mean()):
        found[None].append(called(materials[one["material"]][:3]))
        mapped = {
            number: mapping["material"]
            for mapping in one.get("extensions", {}).get(EXTENSION, {}).get("mappings", [])
            for number in mapping["variants"]
        }
        for number, name in enumerate(names):
            found[name].append(called(materials[mapped.get(number, one["material"])][:3]))
    return found
