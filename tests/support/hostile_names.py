"""Names that a source may have and few formats hold, and a GLB that bears them on everything that has a name."""

from typing import Any

import numpy as np
from gltf_builder import Builder

HOSTILE = (
    *("Key 1", "あ", "mixamorig:Hips", "DEF-spine.001", "Fcl_ALL.Joy", "Idle Loop|baked", "a/b", "/", "\\", ".."),
    *("Key 1", "Key 1", "", "", "2nd tooth", "007", "👩\u200d🚀 smile", "مرحبا بالعالم", "שלום", "\u202eevil"),
    *("café", "cafe\u0301", "\u0301start", "ﬁ", "x" * 5000, "' \" `", '"""', "'''", "tab\there", "line\nbreak"),
    *("{expr}", "$(rm)", "#bar", "@asset@", "[0]", "<prim>", "</Face>", " lead", "trail ", "Skeleton"),
    *("\u2028", "\x01\x7f", "_", "__2", "Key_1", "Key_1_2", "名前.001", "\uff21\uff22\uff23", "Ω≈ç√", "prim{v=a}"),
)


def names_of(root: dict[str, Any]) -> dict[str, list[Any]]:
    """All names of a document, by what they are of, in its order; joints with the name of each one's parent joint."""
    nodes = root["nodes"]
    parents = {child: number for number, node in enumerate(nodes) for child in node.get("children", [])}
    joints = root["skins"][0]["joints"]
    place = {node: number for number, node in enumerate(joints)}
    shown = [node for node in nodes if "mesh" in node]
    return {
        "joints": [(nodes[node]["name"], place.get(parents.get(node, -1), -1)) for node in joints],
        "meshes": [root["meshes"][node["mesh"]]["name"] for node in shown],
        "mesh nodes": [node["name"] for node in shown],
        "shapes": [root["meshes"][node["mesh"]].get("extras", {}).get("targetNames", []) for node in shown],
        "materials": [one["name"] for one in root["materials"]],
        "clips": [one["name"] for one in root["animations"]],
    }


def hostile_document() -> Builder:
    """A mesh with a shape, and a joint, a clip, a material and a mesh of one triangle for each of the names.

    Joints hang below one another in pairs: the second of two below the first, all pairs below the first joint.
    """
    builder, count = Builder(), len(HOSTILE)
    triangle = builder.array(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]))
    skin = {
        "JOINTS_0": builder.array(np.zeros((3, 4)), "u2"),
        "WEIGHTS_0": builder.array(np.tile([1.0, 0, 0, 0], (3, 1))),
    }
    target = {"POSITION": builder.array(np.full((3, 3), 0.01))}
    builder.root["materials"] = [{"name": name} for name in HOSTILE]
    first = {"attributes": {"POSITION": triangle, **skin}, "targets": [target] * count, "material": 0}
    meshes = [{"name": HOSTILE[0], "primitives": [first], "extras": {"targetNames": list(HOSTILE)}}]
    for number, name in enumerate(HOSTILE[1:], 1):
        primitive = {"attributes": {"POSITION": triangle, **skin}, "material": number}
        meshes.append({"name": name, "primitives": [primitive]})
    builder.root["meshes"] = meshes
    nodes: list[dict[str, Any]] = [{"name": name, "translation": [0, 0.01, 0]} for name in HOSTILE]
    for number in range(1, count, 2):
        nodes[0].setdefault("children", []).append(number)
        if number + 1 < count:
            nodes[number]["children"] = [number + 1]
    shown = reversed(HOSTILE)  # a node has another name than its mesh
    builder.root["nodes"] = [*nodes, *({"name": name, "mesh": i, "skin": 0} for i, name in enumerate(shown))]
    builder.root["skins"] = [{"joints": list(range(count))}]
    times, values = builder.array(np.arange(2.0)), builder.array(np.array([[0, 0.01, 0], [0, 0.02, 0]]))
    for number, name in enumerate(HOSTILE):
        channel = {"sampler": 0, "target": {"node": number, "path": "translation"}}
        builder.add(
            "animations", {"name": name, "samplers": [{"input": times, "output": values}], "channels": [channel]}
        )
    builder.root["scenes"] = [{"nodes": [0, *range(count, 2 * count)]}]
    return builder
