"""glTF files as other programs write them, drawn by seed, and what a face that was read of one shows otherwise."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from gltf_builder import Builder
from PIL import Image
from their_gltf import Gltf

from facepipe.parts import FaceParts, Material, Mesh, TextureInput
from facepipe.rig.animation import at_times, sample_transforms, sample_weights
from facepipe.stage import Face

Array = np.ndarray[Any, np.dtype[Any]]
Json = dict[str, Any]
Rng = np.random.Generator
Differences = list[tuple[str, str]]
VARIANTS = "KHR_materials_variants"
NAMES = ("jawOpen", "mouthSmileLeft", "eyeBlinkLeft", "browInnerUp", "tongueOut")


def yes(rng: Rng, share: float = 0.5) -> bool:
    return bool(rng.random() < share)


def pick(rng: Rng, *choices: Any) -> Any:
    return choices[int(rng.integers(len(choices)))]


def quaternion(rng: Rng, most: float = 3.0) -> list[float]:
    """x y z w of a turn about any axis."""
    axis, angle = rng.normal(size=3), rng.uniform(-most, most)
    axis = axis / np.linalg.norm(axis) * np.sin(angle / 2)
    return [*axis.tolist(), float(np.cos(angle / 2))]


# ---- writing


def grid(rng: Rng, columns: int = 5, rows: int = 4) -> tuple[Array, Array, Array]:
    """Points of a bent patch of some centimetres, its triangles, and UVs."""
    x, y = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    flat = np.stack([x.ravel(), y.ravel(), rng.uniform(0, 0.3, x.size)], axis=1)
    at = [r * columns + c for r in range(rows - 1) for c in range(columns - 1)]
    faces = [[[i, i + 1, i + columns + 1], [i, i + columns + 1, i + columns]] for i in at]
    return flat * 0.2 - 0.1, np.array(faces).reshape(-1, 3), np.stack([x.ravel(), y.ravel()], axis=1)


def primitive(
    b: Builder, rng: Rng, targets: int = 0, joints: int = 0, material: int | None = None, quantised: bool = False
) -> Json:
    """A patch with morph targets and influences, in any layout."""
    points, faces, uvs = grid(rng, int(rng.integers(3, 7)), int(rng.integers(3, 6)))
    points = points + rng.uniform(-0.3, 0.3, 3)
    count = len(points)
    given: Json = {}
    if quantised:  # KHR_mesh_quantization: the node has the scale
        given["POSITION"] = b.array(np.rint(points / 2e-5), "i2", stride=8)
    else:
        given["POSITION"] = b.array(points, stride=pick(rng, None, 16))
    made: Json = {"attributes": given, "indices": b.array(faces.ravel(), pick(rng, "u1", "u2", "u4"))}
    coded = pick(rng, "f4", "u2", "u1")
    given["TEXCOORD_0"] = b.array(uvs, "f4") if coded == "f4" else b.array(
        np.rint(uvs * np.iinfo(coded).max), coded, normalized=True, stride=4
    )  # fmt: skip
    if yes(rng):
        given["TEXCOORD_1"] = b.array(uvs[:, ::-1] * 0.5 + 0.25)
    if joints:
        width = min(4, joints)
        order = np.argsort(rng.random((count, joints)), axis=1)[:, :width]
        shares = rng.random((count, width)) + 0.05
        shares = shares / shares.sum(1, keepdims=True)
        padding = ((0, 0), (0, 4 - width))
        given["JOINTS_0"] = b.array(np.pad(order, padding), pick(rng, "u1", "u2"))
        given["WEIGHTS_0"] = b.array(np.pad(shares, padding))
    if targets:
        made["targets"] = []
        for _ in range(targets):
            moved = rng.normal(size=(count, 3)) * 0.02 * (rng.random((count, 1)) < 0.6)
            if quantised:
                made["targets"].append({"POSITION": b.array(np.rint(moved / 2e-5), "i2", stride=8)})
            else:
                made["targets"].append({"POSITION": b.sparse(moved) if yes(rng) else b.array(moved)})
    if material is not None:
        made["material"] = material
    return made


def trs(rng: Rng, *, scaled: bool = True, negative: bool = False, even: bool = False) -> Json:
    """Where a node is, in any of the ways that glTF has."""
    size = rng.uniform(0.5, 1.6, 3) if scaled and not even else np.full(3, rng.uniform(0.5, 1.6) if scaled else 1.0)
    if negative:
        size[int(rng.integers(3))] *= -1
    own: Json = {
        "translation": (rng.normal(size=3) * 0.2).tolist(),
        "rotation": quaternion(rng),
        "scale": size.tolist(),
    }
    return {key: value for key, value in own.items() if yes(rng, 0.8) or (negative and key == "scale")}


def animation(
    b: Builder, rng: Rng, targets: list[tuple[int, str, int]], *, pointers: bool = False, modes: str = "LSC"
) -> None:
    """Channels of (node, path, width) with keys of their own times."""
    own: Json = {"channels": [], "samplers": [], "name": pick(rng, "talk", "clip", "Take 001")}
    for node, path, width in targets:
        mode = {"L": "LINEAR", "S": "STEP", "C": "CUBICSPLINE"}[pick(rng, *modes)]
        count = int(rng.integers(1, 6))
        times = np.unique(np.round(rng.uniform(0, 2, count), pick(rng, 1, 3)))
        rows = len(times) * (3 if mode == "CUBICSPLINE" else 1)
        if path == "rotation":
            keys = np.array([quaternion(rng, 2.0) for _ in range(rows)])
        elif path == "scale":
            keys = rng.uniform(0.6, 1.5, (rows, 1)) * np.ones(3)
        elif path == "translation":
            keys = rng.normal(size=(rows, 3)) * 0.1
        else:
            keys = rng.random((rows, width))
        output = b.array(keys.reshape(-1, 1) if path.startswith("weights") else keys)
        target: Json = {"node": node, "path": path}
        if pointers or "/" in path:
            pointer = f"/nodes/{node}/{path}"
            target = {"path": "pointer", "extensions": {"KHR_animation_pointer": {"pointer": pointer}}}
            b.root["extensionsUsed"] = [*{*b.root.get("extensionsUsed", []), "KHR_animation_pointer"}]
        own["samplers"].append({"input": b.array(times), "output": output, "interpolation": mode})
        own["channels"].append({"sampler": len(own["samplers"]) - 1, "target": target})
    b.add("animations", own)


def mesh(
    b: Builder, rng: Rng, count: int, *, joints: int = 0, parts: int = 1, names: str | None = "", **more: Any
) -> int:
    """A mesh of primitives with `count` named morph targets, called otherwise on each mesh but for `names` given."""
    own: Json = {"primitives": [primitive(b, rng, count, joints, **more) for _ in range(parts)]}
    if names is not None and count:
        behind = names or f" {len(b.root.get('meshes', []))}"
        own["extras"] = {"targetNames": [name + behind.strip("=") for name in NAMES[:count]]}
    return b.add("meshes", own | ({"name": pick(rng, "Head", "Body", "Mesh.001")} if yes(rng) else {}))


def finish(b: Builder, folder: Path, roots: list[int]) -> Path:
    b.add("scenes", {"nodes": roots})
    (folder / "face.glb").write_bytes(b.glb())
    return folder / "face.glb"


def png(rng: Rng, kind: str = "PNG", mode: str = "RGB", **options: Any) -> bytes:
    pixels = rng.integers(0, 256, (8, 8, len(mode)), dtype=np.uint8)
    written = io.BytesIO()
    Image.fromarray(np.kron(pixels, np.ones((4, 4, 1), np.uint8)), mode).save(written, kind, **options)
    return written.getvalue()


def texture(b: Builder, data: bytes, extension: str | None = None, fallback: bytes | None = None) -> int:
    image = b.add("images", {"bufferView": b.view(data), "mimeType": "image/png"})
    own: Json = {"source": image}
    if extension is not None:
        own = {"extensions": {extension: {"source": image}}}
        b.root.setdefault("extensionsUsed", []).append(extension)
        if fallback is not None:
            own["source"] = b.add("images", {"bufferView": b.view(fallback), "mimeType": "image/png"})
        elif extension.startswith("EXT"):
            b.root.setdefault("extensionsRequired", []).append(extension)
    return b.add("textures", own)


def place(b: Builder, rng: Rng, sets: int) -> Json:
    """Where a texture lies: a set, and a transform of some of its parts."""
    own: Json = {}
    if sets > 1 and yes(rng, 0.4):
        own["texCoord"] = 1
    if yes(rng, 0.75):
        move: Json = {}
        if yes(rng):
            move["offset"] = rng.uniform(-1, 1, 2).tolist()
        if yes(rng):
            move["scale"] = rng.uniform(-2, 3, 2).tolist()
        if yes(rng):
            move["rotation"] = float(rng.uniform(-3, 3))
        if sets > 1 and yes(rng, 0.4):
            move["texCoord"] = int(rng.integers(sets))
        own["extensions"] = {"KHR_texture_transform": move}
        b.root["extensionsUsed"] = [*{*b.root.get("extensionsUsed", []), "KHR_texture_transform"}]
    return own


# ---- kinds


def texture_transforms(rng: Rng, folder: Path) -> Path:
    """Several textures a material, materials a mesh, and meshes a material, each lying where it wants."""
    b = Builder()
    meshes = [
        mesh(b, rng, int(rng.integers(0, 2)), parts=int(rng.integers(1, 4))) for _ in range(int(rng.integers(1, 4)))
    ]
    every = [one for own in meshes for one in b.root["meshes"][own]["primitives"]]
    for one in every:
        one["material"] = int(rng.integers(0, 3)) if yes(rng, 0.9) else 0
    for number in range(3):
        users = [one for one in every if one["material"] == number]
        sets = min([sum(key.startswith("TEXCOORD") for key in one["attributes"]) for one in users], default=1)

        def lies(sets: int = sets) -> Json:
            return {"index": texture(b, png(rng))} | place(b, rng, sets)

        material: Json = {"name": f"m{number}", "pbrMetallicRoughness": {"baseColorTexture": lies()}}
        material |= {key: lies() for key in ("normalTexture", "occlusionTexture") if yes(rng)}
        if yes(rng):
            material |= {"emissiveTexture": lies(), "emissiveFactor": [1, 1, 1]}
        if yes(rng):
            material["pbrMetallicRoughness"]["metallicRoughnessTexture"] = lies()
        b.add("materials", material)
    nodes = [b.add("nodes", {"name": f"n{i}", "mesh": own} | trs(rng)) for i, own in enumerate(meshes)]
    if yes(rng, 0.3):
        nodes.append(b.add("nodes", {"name": "again", "mesh": meshes[0], "translation": [1, 0, 0]}))
    return finish(b, folder, nodes)


def quantised(rng: Rng, folder: Path) -> Path:
    """As gltfpack writes: integers for points, targets and UVs, scales in nodes, skins and texture transforms."""
    b = Builder()
    b.root["extensionsUsed"] = b.root["extensionsRequired"] = ["KHR_mesh_quantization", "KHR_texture_transform"]
    skinned = yes(rng)
    joints = 3 if skinned else 0
    own = mesh(b, rng, 2, joints=joints, quantised=True)
    bits = int(pick(rng, 10, 12, 14, 16))
    points = b.root["accessors"][b.root["meshes"][own]["primitives"][0]["attributes"]["POSITION"]]["count"]
    values, most = rng.random((points, 2)) * pick(rng, 1.0, 3.0), 2**bits - 1
    given = b.root["meshes"][own]["primitives"][0]["attributes"]
    given.pop("TEXCOORD_1", None)
    size = values.max(0)
    normalised = yes(rng)
    stored = np.rint(values / size * most)
    given["TEXCOORD_0"] = b.array(stored, "u2", normalized=normalised, stride=4)
    scale = size / most * (65535 if normalised else 1)
    offset = rng.uniform(-1, 1, 2) if yes(rng) else np.zeros(2)
    lies = {"extensions": {"KHR_texture_transform": {"scale": scale.tolist(), "offset": offset.tolist()}}}
    textures = {"baseColorTexture": {"index": texture(b, png(rng))} | lies}
    material: Json = {"pbrMetallicRoughness": textures, "normalTexture": {"index": texture(b, png(rng))} | lies}
    b.root["meshes"][own]["primitives"][0]["material"] = b.add("materials", material)
    node: Json = {"name": "Face", "mesh": own}
    if not skinned:
        node |= {"scale": [2e-5] * 3, "translation": rng.normal(size=3).tolist(), "rotation": quaternion(rng)}
        b.add("nodes", node)
        if yes(rng):
            animation(b, rng, [(0, "weights", 2)])
        return finish(b, folder, [0])
    bones = chain(b, rng, joints)
    binds = np.stack([np.linalg.inv(world_of(b, one)) for one in bones]) @ np.diag([2e-5, 2e-5, 2e-5, 1.0])
    own_skin = b.add("skins", {"joints": bones, "inverseBindMatrices": matrices(b, binds)})
    made = b.add("nodes", node | {"skin": own_skin})
    animation(b, rng, [(bones[1], "rotation", 4), (made, "weights", 2)])
    return finish(b, folder, [bones[0], made])


def encodings(rng: Rng, folder: Path) -> Path:
    """WebP and AVIF with and without a PNG beside, transparent ones, and images that are damaged or not there."""
    b = Builder()
    own = mesh(b, rng, 1, parts=3)
    for number in range(3):
        kind = pick(rng, "WEBP", "AVIF", "PNG", "JPEG", "corrupt", "ktx2", "missing")
        mode = pick(rng, "RGB", "RGBA") if kind in ("WEBP", "AVIF", "PNG") else "RGB"
        options: Json = {"lossless": True} if kind == "WEBP" else {"quality": 95} if kind in ("AVIF", "JPEG") else {}
        if kind in ("WEBP", "AVIF"):
            fallback = png(rng) if yes(rng) else None
            index = texture(b, png(rng, kind, mode, **options), f"EXT_texture_{kind.lower()}", fallback)
        elif kind == "corrupt":
            data = bytearray(png(rng, pick(rng, "PNG", "WEBP")))
            cut = int(rng.integers(20, len(data) - 8))
            index = texture(b, bytes(data[:cut]) if yes(rng) else bytes(data[:30]) + rng.bytes(len(data) - 30))
        elif kind == "ktx2":
            index = texture(
                b, b"\xabKTX 20\xbb\r\n\x1a\n" + rng.bytes(200), "KHR_texture_basisu", png(rng) if yes(rng) else None
            )
        elif kind == "missing":
            image = b.add("images", {"uri": "textures/no%20such.png"})
            index = b.add("textures", {"source": image})
        else:
            index = texture(b, png(rng, kind, mode, **options))
        factor = [*rng.random(3).tolist(), 1.0] if yes(rng) else [1, 1, 1, 1]
        surface = {"baseColorTexture": {"index": index}, "baseColorFactor": factor}
        material: Json = {"name": kind, "pbrMetallicRoughness": surface}
        if yes(rng, 0.3):
            material["alphaMode"] = pick(rng, "MASK", "BLEND")
        b.root["meshes"][own]["primitives"][number]["material"] = b.add("materials", material)
    b.add("nodes", {"name": "Face", "mesh": own})
    return finish(b, folder, [0])


def surfaces(rng: Rng, folder: Path) -> Path:
    """specular-glossiness, unlit, and plain factors."""
    b = Builder()
    own = mesh(b, rng, 1, parts=4)
    for number in range(4):
        kind = pick(rng, "glossy", "glossy", "unlit", "plain")
        material: Json = {"name": f"{kind} {number}"} if yes(rng) else {}
        if kind == "glossy":
            metal = yes(rng)
            glossy: Json = {
                "diffuseFactor": [*([0, 0, 0] if metal else rng.random(3).tolist()), 1.0],
                "specularFactor": rng.uniform(0.5, 1, 3).tolist() if metal else [0.04] * 3,
                "glossinessFactor": float(rng.random()),
            }
            if not metal and yes(rng):
                glossy["diffuseTexture"] = {"index": texture(b, png(rng))} | place(b, rng, 1)
            if yes(rng, 0.3):
                glossy["specularGlossinessTexture"] = {"index": texture(b, png(rng, mode="RGBA"))}
            material["extensions"] = {"KHR_materials_pbrSpecularGlossiness": glossy}
        else:
            material["pbrMetallicRoughness"] = {
                "baseColorFactor": [*rng.random(3).tolist(), 1.0],
                "metallicFactor": float(rng.random()),
                "roughnessFactor": float(rng.random()),
            }
            if kind == "unlit":
                material["extensions"] = {"KHR_materials_unlit": {}}
        if yes(rng, 0.3):
            material |= {"doubleSided": True}
        b.root["meshes"][own]["primitives"][number]["material"] = b.add("materials", material)
    b.root["extensionsUsed"] = ["KHR_materials_pbrSpecularGlossiness", "KHR_materials_unlit", "KHR_texture_transform"]
    b.add("nodes", {"name": "Face", "mesh": own})
    return finish(b, folder, [0])


def variants(rng: Rng, folder: Path) -> Path:
    """Primitives of one material that variants change otherwise, mapped in any of the ways that the extension has."""
    b = Builder()
    own = mesh(b, rng, 1, parts=6)
    for number in range(5):
        color = {"baseColorFactor": [*rng.random(3).tolist(), 1.0], "metallicFactor": 0.0}
        if number == 3:
            color["baseColorTexture"] = {"index": texture(b, png(rng))} | place(b, rng, 1)
        b.add("materials", {"name": f"material {number}", "pbrMetallicRoughness": color})
    names = ["Light", "Dark", "a b/c", "夜", "2nd", "default"][: int(rng.integers(1, 7))]
    for one in b.root["meshes"][own]["primitives"]:
        if yes(rng, 0.9):
            one["material"] = int(rng.integers(3))
        free = [number for number in range(len(names)) if yes(rng, 0.7)]
        mappings = [{"material": int(rng.integers(5)), "variants": [number]} for number in free]
        if len(mappings) > 1 and yes(rng):
            last = mappings.pop()
            mappings[0]["variants"] += last["variants"]
        if mappings and yes(rng, 0.8):
            one["extensions"] = {VARIANTS: {"mappings": mappings}}
    b.root["extensions"] = {VARIANTS: {"variants": [{"name": name} for name in names]}}
    b.root["extensionsUsed"] = [VARIANTS, "KHR_texture_transform"]
    for number in range(int(rng.integers(1, 3))):
        b.add("nodes", {"name": f"Face {number}", "mesh": own})
    return finish(b, folder, list(range(len(b.root["nodes"]))))


def chain(b: Builder, rng: Rng, count: int, names: str = "neck head jaw eye tip", **more: Any) -> list[int]:
    """Nodes one below the other; new ones are the last of the document."""
    first = len(b.root.get("nodes", []))
    called = names.split()
    for i in range(count):
        below = {"children": [first + i + 1]} if i + 1 < count else {}
        b.add("nodes", {"name": called[i % len(called)]} | trs(rng, **({"scaled": False} | more)) | below)
    return list(range(first, first + count))


def world_of(b: Builder, node: int) -> Array:
    """World matrix at rest, of the document as far as it is written."""
    reader = Gltf.__new__(Gltf)
    reader.root, reader.nodes = b.root, b.root["nodes"]
    reader.parents = {child: i for i, one in enumerate(reader.nodes) for child in one.get("children", [])}
    return reader.world(node, {})


def matrices(b: Builder, values: Array) -> int:
    return b.array(values.transpose(0, 2, 1).reshape(-1, 16))


def rigid(rng: Rng, folder: Path) -> Path:
    """Hierarchies of nodes that move, with meshes on some, beside a skinned mesh or without."""
    b = Builder()
    negative, even = yes(rng, 0.3), yes(rng, 0.6)
    nodes = chain(b, rng, int(rng.integers(2, 6)), "Hips Head Hat eye.L Brille", scaled=yes(rng), even=even)
    if negative:
        b.root["nodes"][nodes[-1]]["scale"] = [1.0, -1.0, 1.0] if yes(rng) else [-1.0, -1.0, -1.0]
    if yes(rng, 0.3):  # a branch
        b.root["nodes"][nodes[0]]["children"].append(
            b.add("nodes", {"name": "branch", "mesh": mesh(b, rng, 0)} | trs(rng, even=True))
        )
    shapes = {}
    for node in nodes:
        if yes(rng, 0.6) or node == nodes[-1]:
            shapes[node] = int(rng.integers(0, 3))
            b.root["nodes"][node]["mesh"] = mesh(b, rng, shapes[node])
    if yes(rng, 0.3) and not even:
        matrix = world_of(b, nodes[0])
        for key in ("translation", "rotation", "scale"):
            b.root["nodes"][nodes[0]].pop(key, None)
        b.root["nodes"][nodes[0]]["matrix"] = matrix.T.ravel().tolist()
    moving = [n for n in nodes if yes(rng, 0.7) and "matrix" not in b.root["nodes"][n]] or [nodes[-1]]
    paths = [(n, path, 3) for n in moving for path in ("translation", "rotation") if yes(rng, 0.6)]
    paths += [(n, "scale", 3) for n in moving if yes(rng, 0.3) and "scale" not in b.root["nodes"][n]]
    paths += [(n, "weights", k) for n, k in shapes.items() if k and yes(rng)]
    paths = paths or [(nodes[-1], "rotation", 4)]
    roots = [nodes[0]]
    if yes(rng, 0.4):
        bones = chain(b, rng, 3, "neck head jaw")
        roots += [bones[0]] if yes(rng) else []
        if bones[0] not in roots:
            b.root["nodes"][nodes[0]].setdefault("children", []).append(bones[0])
        binds = np.stack([np.linalg.inv(world_of(b, one)) for one in bones])
        skin = b.add("skins", {"joints": bones, "inverseBindMatrices": matrices(b, binds)})
        roots.append(b.add("nodes", {"name": "Skinned", "mesh": mesh(b, rng, 1, joints=3), "skin": skin}))
        paths += [(bones[int(rng.integers(3))], "rotation", 4)]
    animation(b, rng, paths, pointers=yes(rng, 0.25))
    if yes(rng, 0.3):
        animation(b, rng, [(moving[0], "rotation", 4)])
    return finish(b, folder, roots)


def pointers(rng: Rng, folder: Path) -> Path:
    """KHR_animation_pointer to weights, all or one, of nodes and of meshes, and to transforms."""
    b = Builder()
    own = mesh(b, rng, 3)
    node = b.add("nodes", {"name": "Face", "mesh": own} | trs(rng))
    nodes = [node]
    if yes(rng):
        b.root["meshes"][own]["weights"] = rng.random(3).tolist()
    if yes(rng, 0.4):
        nodes.append(b.add("nodes", {"name": "Twin", "mesh": own, "translation": [0.5, 0, 0]}))
    paths = (
        [(node, "weights", 3)]
        if yes(rng)
        else [(node, f"weights/{i}", 1) for i in rng.permutation(3)[: int(rng.integers(1, 4))]]
    )
    paths += [(node, path, 3) for path in ("translation", "rotation") if yes(rng, 0.4)]
    animation(b, rng, paths, pointers=True)
    for channel in b.root["animations"][0]["channels"]:
        pointer = channel["target"]["extensions"]["KHR_animation_pointer"]
        if yes(rng, 0.3) and "weights" in pointer["pointer"]:
            pointer["pointer"] = pointer["pointer"].replace(f"/nodes/{node}", f"/meshes/{own}")
    if yes(rng, 0.3):
        b.root["extensionsRequired"] = ["KHR_animation_pointer"]
    return finish(b, folder, nodes)


def default_weights(rng: Rng, folder: Path) -> Path:
    """Default weights of meshes and of nodes, played or not."""
    b = Builder()
    nodes, same = [], yes(rng, 0.4)
    for i in range(int(rng.integers(1, 4))):
        count = int(rng.integers(1, 5))
        own = mesh(b, rng, count, names="=" if same else "")
        if yes(rng, 0.7):
            b.root["meshes"][own]["weights"] = (np.round(rng.random(count), 2) * (rng.random(count) < 0.7)).tolist()
        node: Json = {"name": f"part{i}", "mesh": own} | trs(rng)
        if yes(rng, 0.4):
            node["weights"] = np.round(rng.random(count), 2).tolist()
        nodes.append(b.add("nodes", node))
        if yes(rng, 0.2):
            nodes.append(b.add("nodes", {"name": f"again{i}", "mesh": own, "weights": rng.random(count).tolist()}))
    kind = rng.integers(3)
    if kind == 1:
        counts = [len(b.root["meshes"][b.root["nodes"][nodes[0]]["mesh"]]["primitives"][0]["targets"])]
        animation(b, rng, [(nodes[0], "weights", counts[0])])
    elif kind == 2:
        animation(b, rng, [(nodes[0], "rotation", 4)])
    return finish(b, folder, nodes)


def twin_skins(rng: Rng, folder: Path) -> Path:
    """Skins that share joints, bind them elsewhere, with places of their own, at rest in another pose than bound."""
    b = Builder()
    bones = chain(b, rng, 4, "root neck head jaw", scaled=yes(rng, 0.3), even=True)
    nodes = []
    if yes(rng, 0.4):  # an armature above, in centimetres
        nodes.append(
            b.add(
                "nodes", {"name": "Armature", "children": [bones[0]], "scale": [0.01] * 3, "rotation": quaternion(rng)}
            )
        )
        for one in bones:
            at = b.root["nodes"][one].get("translation", [0, 0, 0])
            b.root["nodes"][one]["translation"] = [100 * value for value in at]
    else:
        nodes.append(bones[0])
    worlds = {one: world_of(b, one) for one in bones}
    skins = int(rng.integers(1, 4))
    drift = [np.eye(4) for _ in bones]
    if yes(rng, 0.4):  # stands otherwise than it is bound
        for one in bones[1:]:
            b.root["nodes"][one]["rotation"] = quaternion(rng, 0.5)
    for number in range(skins):
        used = bones if yes(rng) else [bones[i] for i in sorted(rng.choice(4, 3, replace=False))]
        used = [used[i] for i in rng.permutation(len(used))]
        place = np.eye(4)
        if yes(rng):
            turned = Builder()
            turned.add("nodes", trs(rng, even=True, negative=yes(rng, 0.2)))
            place = world_of(turned, 0)
        binds = np.stack([np.linalg.inv(worlds[one]) @ place for one in used])
        if number and yes(rng, 0.5):  # one joint is bound elsewhere
            which = int(rng.integers(len(used)))
            moved = np.eye(4)
            moved[:3, 3] = rng.normal(size=3) * 0.1
            binds[which] = binds[which] @ moved
        entry: Json = {"joints": used, "inverseBindMatrices": matrices(b, binds)}
        if yes(rng):
            entry["skeleton"] = bones[0]
        skin = b.add("skins", entry)
        own = mesh(b, rng, int(rng.integers(0, 3)), joints=len(used))
        nodes.append(b.add("nodes", {"name": f"skin{number}", "mesh": own, "skin": skin} | trs(rng)))
    del drift
    if yes(rng, 0.6):
        animation(b, rng, [(one, "rotation", 4) for one in bones if yes(rng, 0.6)] or [(bones[0], "rotation", 4)])
    if yes(rng, 0.3):  # a hat on a joint
        b.root["nodes"][bones[2]]["children"] = [*b.root["nodes"][bones[2]].get("children", []), len(b.root["nodes"])]
        b.add("nodes", {"name": "hat", "mesh": mesh(b, rng, 1)} | trs(rng))
    return finish(b, folder, nodes)


def names(rng: Rng, folder: Path) -> Path:
    """Primitives of unequal targets, names in any place that writers put them, joints and nodes that share one."""
    b = Builder()
    bones = chain(b, rng, 4, pick(rng, "head head head head", "a.b a.b a/b jaw", "Köpfchen head jaw jaw"))
    own = mesh(b, rng, 3, joints=4, parts=3, names=None)
    kept = b.root["meshes"][own]["primitives"]
    for one in kept[1:]:
        one["targets"] = one["targets"][: int(rng.integers(0, 4))]
        if not one["targets"]:
            del one["targets"]
    way = pick(rng, "targetNames", "extras", "extra", "name", "accessors", "none")
    called = [pick(rng, "jawOpen", "Mund offen", "head.jaw"), "smile L", "blink/left"]
    for i, target in enumerate(kept[0]["targets"]):
        if way in ("extras", "extra"):
            target[way] = {"name": called[i]}
        elif way == "name":
            target["name"] = called[i]
        elif way == "accessors":
            b.root["accessors"][target["POSITION"]]["name"] = called[i]
    if way == "targetNames":
        b.root["meshes"][own]["extras"] = {"targetNames": called}
    binds = np.stack([np.linalg.inv(world_of(b, one)) for one in bones])
    skin = b.add("skins", {"joints": bones, "inverseBindMatrices": matrices(b, binds)})
    nodes = [bones[0], b.add("nodes", {"name": "head", "mesh": own, "skin": skin})]
    nodes.append(b.add("nodes", {"name": "head", "mesh": mesh(b, rng, 2, names="=")} | trs(rng)))
    if yes(rng):
        animation(b, rng, [(nodes[1], "weights", 3), (bones[1], "rotation", 4)])
    return finish(b, folder, nodes)


KINDS: dict[str, Callable[[Rng, Path], Path]] = {
    "texture transforms": texture_transforms,
    "quantised": quantised,
    "encodings": encodings,
    "surfaces": surfaces,
    "variants": variants,
    "rigid nodes": rigid,
    "pointers": pointers,
    "default weights": default_weights,
    "twin skins": twin_skins,
    "names and targets": names,
}


# ---- comparing

WITHIN = 3e-5  # metres that points may be off: float32, and half precision of scales beside exact coefficients
SLIGHT = 1e-3  # metres that scales in half precision may make of it
CURVED = 4e-4  # metres where curves became lines


def differences(path: Path, parts: FaceParts) -> Differences:
    """(subject, figure) of each thing that a face has otherwise than its file, by the formulas of the specification."""
    gltf = Gltf(path)
    shown = gltf.shown()
    if len(shown) != len(parts.meshes):
        return [("meshes", f"{len(parts.meshes)} meshes, expected {len(shown)}")]
    face = Face.from_parts(parts)
    found = _named(gltf, shown, parts)
    worst: dict[tuple[str, str], float] = {}
    pairs = [*zip(shown, parts.meshes, strict=True)]
    for node, own in pairs:
        expected = sum(len(gltf.corners(one)) for one in gltf.primitives(node))
        if len(own.face_vertex_indices) != expected:
            found.append(("faces", f"{own.name} has {len(own.face_vertex_indices)} corners, expected {expected}"))
            return found

    def compare(subject: str, points: Array, truth: dict[int, Array], within: float = WITHIN) -> None:
        split = face.split(points)
        for node, own in pairs:
            size = max(1.0, float(np.abs(truth[node]).max()))
            mine = split[own.name][own.face_vertex_indices].reshape(-1, 3, 3)
            off = _apart(mine, truth[node].reshape(-1, 3, 3))
            if not off <= within * size:
                worst[subject, own.name] = max(worst.get((subject, own.name), 0.0), off)

    still = {node: gltf.points(node, {}, np.zeros(9)) for node in shown}
    compare("rest", face.evaluate(), still)
    default = {node: gltf.points(node, {}) for node in shown}
    pose = next((one for one in parts.animations if one.name == "default" and one.times is None), None)
    if any(gltf.weights(node, {}).any() for node in shown):
        compare("default weights", face.evaluate(pose="default") if pose else face.evaluate(), default)
    for number, one in enumerate(gltf.root.get("animations", [])):
        _play(gltf, number, one, face, parts, shown, compare, found)
    for (subject, name), off in worst.items():
        slightly = ", slightly" if off < SLIGHT else ""
        found.append((subject + slightly, f"{name} off by {off:.3g} m"))
    for node, own in pairs:
        found += _surfaces(gltf, node, own, parts)
    return list(dict.fromkeys(found))


def _apart(mine: Array, truth: Array) -> float:
    """Largest distance of corners of triangles; those of a mirrored mesh may run the other way round."""
    ways = [mine, *(mine[:, order] for order in ([0, 2, 1], [2, 1, 0], [1, 0, 2]))]
    return min(float(np.linalg.norm(way - truth, axis=2).max(initial=0.0)) for way in ways)


def _play(
    gltf: Gltf, number: int, own: Json, face: Face, parts: FaceParts, shown: list[int], compare: Any, found: Differences
) -> None:
    clips = [one for one in parts.animations if one.name != "default"]
    if not clips:  # of nodes that carry nothing
        for time in gltf.key_times(number):
            state = gltf.state(number, float(time))
            compare("animation", face.evaluate(), {node: gltf.points(node, state) for node in shown})
        return
    if len(clips) != len(gltf.root["animations"]):
        found.append(("animation", f"{len(clips)} animations, expected {len(gltf.root['animations'])}"))
        return
    clip, keys = clips[number], gltf.key_times(number)
    steps = any(one.get("interpolation") == "STEP" for one in own["samplers"])
    curves = any(one.get("interpolation") == "CUBICSPLINE" for one in own["samplers"])
    times = np.unique(np.concatenate([keys, (keys[1:] + keys[:-1]) / 2, keys[:-1] + 0.3 * np.diff(keys)]))
    if steps:  # a value holds until a millisecond before the next key
        near = np.abs(times[:, None] - keys[None]).min(1)
        times = times[(near > 2e-3) | (near == 0)]
    if clip.times is None:
        moving, times = clip, times[:1]
    else:
        moving = at_times(parts.skeleton, clip, times)
    for index, time in enumerate(times):
        state = gltf.state(number, float(time))
        local, weights = sample_transforms(parts.skeleton, moving, index), sample_weights(moving, index)
        points = face.evaluate(weights, joint_transforms=local)
        compare(
            "animation", points, {node: gltf.points(node, state) for node in shown}, CURVED if curves else WITHIN * 3
        )


def _named(gltf: Gltf, shown: list[int], parts: FaceParts) -> Differences:
    """Names of nodes, joints and shapes."""
    found: Differences = []
    for node, own in zip(shown, parts.meshes, strict=True):
        wanted = gltf.nodes[node].get("name") or gltf.root["meshes"][gltf.nodes[node]["mesh"]].get("name")
        called = own.label if own.label is not None else own.name
        if wanted and called != wanted:
            found.append(("names", f"mesh {called!r}, expected {wanted!r}"))
        shapes = {one.label if one.label else one.name for one in own.blendshapes}
        listed = set(_target_names(gltf, node))
        if shapes - listed and listed and not {re.sub(r"_\d+$", "", one) for one in shapes} <= listed:
            found.append(("names", f"shapes {sorted(shapes)}, expected {sorted(listed)}"))
        if len(own.blendshapes) < len(listed):
            found.append(("shapes", f"{own.name} has {len(own.blendshapes)} shapes, expected {len(listed)}"))
    wanted_joints = [gltf.nodes[j].get("name") for one in gltf.root.get("skins", []) for j in one["joints"]]
    missing = [one for one in dict.fromkeys(wanted_joints) if one and one not in parts.skeleton.names]
    if missing:
        found.append(("names", f"joints {missing} are not there"))
    return found


def _target_names(gltf: Gltf, node: int) -> list[str]:
    own = gltf.root["meshes"][gltf.nodes[node]["mesh"]]
    listed = own.get("extras", {}).get("targetNames")
    if listed:
        return list(listed)
    targets = max((one.get("targets", []) for one in own["primitives"]), key=len)
    found = []
    for one in targets:
        name = one.get("extras", {}).get("name") or one.get("extra", {}).get("name") or one.get("name")
        name = name or gltf.root["accessors"][one["POSITION"]].get("name")
        found += [name] if name else []
    return found


_INPUTS = {
    "baseColorTexture": "diffuse_color",
    "diffuseTexture": "diffuse_color",
    "normalTexture": "normal",
    "occlusionTexture": "occlusion",
    "emissiveTexture": "emissive_color",
    "metallicRoughnessTexture": "roughness",
    "specularGlossinessTexture": "roughness",
}


def _surfaces(gltf: Gltf, node: int, own: Mesh, parts: FaceParts) -> Differences:
    found: Differences = []
    by_name = {one.name: one for one in parts.materials}
    of_face = np.array([own.material] * len(own.face_vertex_counts), object)
    for group in own.material_faces:
        of_face[group.faces] = group.material
    first = 0
    for one in gltf.primitives(node):
        count = len(gltf.corners(one)) // 3
        here, first = slice(first, first + count), first + count
        if "material" not in one:
            continue
        given = gltf.root["materials"][one["material"]]
        if len(set(of_face[here])) != 1 or of_face[here][0] not in by_name:
            found.append(("materials", f"faces of {own.name} without their material"))
            continue
        material = by_name[of_face[here][0]]
        if (material.label or material.name) != given.get("name", material.label or material.name):
            found.append(("names", f"material {material.name}, expected {given['name']}"))
        found += _variants(gltf, one, material, by_name)
        glossy = given.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
        found += _factors(given, glossy, material)
        for key, reference in [*given.items(), *given.get("pbrMetallicRoughness", {}).items(), *(glossy or {}).items()]:
            if key not in _INPUTS or (key == "emissiveTexture" and not any(given.get("emissiveFactor", [0]))):
                continue
            used = getattr(material, _INPUTS[key])
            expected = _decoded(gltf, reference)
            if not isinstance(used, TextureInput):
                if expected is not None:
                    found.append(("textures", f"{key} of {material.name} is not there"))
                else:
                    found.append(("damaged", f"{key} of {material.name}"))
                continue
            if expected is None:
                found.append(("textures", f"{key} of {material.name} is there, but its image can't be decoded"))
                continue
            mine = np.asarray(Image.open(io.BytesIO(used.texture.data)).convert("RGBA"), int)
            if mine.shape != expected.shape or np.abs(mine - expected).max() > 0:
                found.append(("textures", f"other pixels of {key} of {material.name}"))
            sets = {uvs.name: uvs for uvs in own.uv_sets}
            if used.uv_set not in sets:
                found.append(("uvs", f"{key} of {material.name} reads the set {used.uv_set}, which {own.name} lacks"))
                continue
            uvs = sets[used.uv_set]
            values = np.asarray(uvs.values, float)[uvs.indices if uvs.indices is not None else own.face_vertex_indices]
            mine_uv = (values * [1, -1] + [0, 1])[3 * here.start : 3 * here.stop].reshape(-1, 3, 2)
            truth = gltf.uvs(one, reference).reshape(-1, 3, 2)
            off = _apart(mine_uv, truth)
            if off > 2e-5 * max(1.0, float(np.abs(truth).max())):
                found.append(("uvs", f"{key} of {material.name} on {own.name} off by {off:.3g}"))
    return found


def _variants(gltf: Gltf, primitive: Json, material: Material, by_name: dict[str, Material]) -> Differences:
    """What variants show in place of a primitive's material, by the names that the file has."""
    listed = gltf.root.get("extensions", {}).get(VARIANTS, {}).get("variants", [])
    mappings = primitive.get("extensions", {}).get(VARIANTS, {}).get("mappings", [])
    mapped = {number: one["material"] for one in mappings for number in one["variants"]}
    found: Differences = []
    for number, variant in enumerate(listed):
        other = by_name[material.variants.get(variant["name"], material.name)]
        expected = gltf.root["materials"][mapped.get(number, primitive["material"])].get("name")
        if (other.label or other.name) != expected:
            found.append(("variants", f"{material.name} is {other.name} in {variant['name']}, expected {expected}"))
    return found


def _decoded(gltf: Gltf, reference: Json) -> Array | None:
    texture = gltf.root["textures"][reference["index"]]
    # a reader shows the first source that it can decode
    sources = [one["source"] for one in texture.get("extensions", {}).values()]
    sources = [*([texture["source"]] if "source" in texture else []), *sources]
    for source in sources:
        entry = gltf.root["images"][source]
        if "uri" in entry:
            continue
        view = gltf.root["bufferViews"][entry["bufferView"]]
        data = gltf.buffers[0][view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        try:
            return np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"), int)
        except (OSError, SyntaxError, ValueError):
            continue
    return None


def _factors(given: Json, glossy: Json | None, material: Any) -> Differences:
    found: Differences = []
    extensions = given.get("extensions", {})
    if ("KHR_materials_unlit" in extensions) != material.unlit:
        found.append(("unlit", f"{material.name} is {'lit' if not material.unlit else 'unlit'}"))
    base = material.diffuse_color
    color = np.array(base.scale[:3] if isinstance(base, TextureInput) else base)
    rough, metal = material.roughness, material.metallic
    if glossy is None:
        own = given.get("pbrMetallicRoughness", {})
        wanted = np.array(own.get("baseColorFactor", [1, 1, 1, 1])[:3])
        if np.abs(color - wanted).max() > 1e-5:
            found.append(("colours", f"{material.name} {color.tolist()}, expected {wanted.tolist()}"))
        for key, value in (("metallicFactor", metal), ("roughnessFactor", rough)):
            if not isinstance(value, TextureInput) and abs(value - own.get(key, 1.0)) > 1e-5 and not material.unlit:
                found.append(("colours", f"{key} of {material.name} {value}, expected {own.get(key, 1.0)}"))
        return found
    if isinstance(rough, float) and abs(rough - (1 - glossy["glossinessFactor"])) > 1e-5:
        found.append(("colours", f"roughness of {material.name} {rough}, expected {1 - glossy['glossinessFactor']}"))
    if isinstance(metal, float):  # what it reflects and scatters, both ways
        specular = np.array(glossy["specularFactor"])
        wanted = np.array([*(np.array(glossy["diffuseFactor"][:3]) * (1 - specular.max())), *specular])
        mine = np.array([*(color * 0.96 * (1 - metal)), *(0.04 * (1 - metal) + color * metal)])
        if np.abs(mine - wanted).max() > 0.03:
            found.append(("specular", f"{material.name} reflects {np.round(mine, 3)}, expected {np.round(wanted, 3)}"))
    return found
