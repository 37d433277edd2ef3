"""What facepipe reads, as good files, the damage that fits each kind, and the commands that read it."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import io
import json
import random
import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cook_cases
import draco_files
import fuzz_damage as damage
import gltf_builder
import neural_faces
import neutral_files
import numpy as np
import obj_files
import photographed_face
import rebuild_project
import rebuild_stages
import scan_domes
import slider_tables
import vrm_files
from blender_texts import TextBlock
from bone_faces import save_sources
from faces import clipped_face, tiny_face
from full_faces import full_face, good_face
from fuzz_farm import FARM
from fuzz_fbx import damage_fbx, put_ascii, put_binary
from fuzz_meshes import damaged_off, damaged_ply, damaged_stl
from fuzz_remains import REMAINS
from fuzz_stage import damaged_stage
from fuzzing import Format, Line
from gltf_builder import PNG, glb
from network_faces import network, networked, save_network
from packed_makehuman import PACKED, small_head
from payloads import tiny_payload
from photo_booth import camera_at
from photo_files import encoded, oriented, picture
from PIL import Image
from places import SHARED
from region_painter import legend_of, paint
from region_painter import save as save_map
from scan_files import SIDES, cube
from small_head import make as make_sample
from small_sources import made

import facepipe
from facepipe.actions import summaries
from facepipe.cli import main
from facepipe.scanning.database import DatabaseOptions, create_database, save_database
from facepipe.stage import save_parts

Rng = random.Random
TERMS = ("--authors", "A. Author", "--license-url", "https://vrm.dev/licenses/1.0/")


def change(name: str, how: Callable[[Rng, bytes], bytes], rng: Rng) -> None:
    """One file damaged."""
    path = Path(name)
    path.write_bytes(how(rng, path.read_bytes()))


def one_of(lines: Sequence[Line], how: Callable[[Rng, bytes], bytes], *names: str) -> Callable[[Rng, str], list[Line]]:
    """Damage to one of the files, and one of the commands."""

    def damaged(rng: Rng, part: str) -> list[Line]:
        change(rng.choice(names), how, rng)
        return [rng.choice(lines)]

    return damaged


def put_face(name: str = "face.usda") -> None:
    save_parts(made(0), Path(name))


def put_text(name: str, content: Any) -> Callable[[], None]:
    """The face, and a file of a text or JSON."""

    def put() -> None:
        put_face()
        Path(name).write_text(content if isinstance(content, str) else json.dumps(content))

    return put


# ---- stages


STAGE_LINES = [
    ("inspect", "{}"),
    ("validate", "{}"),
    ("import", "usd", "{}", "out.usda"),
    ("sliders", "{}"),
    ("regions", "{}"),
    ("cook", "{}"),
    ("export", "{}", "-o", "out.glb"),
    ("export", "{}", "-o", "out.onnx"),
    ("render", "{}", "-o", "out.png", "--size", "32"),
    ("bake", "{}", "-o", "out.usda"),
]


def stage_lines(rng: Rng, name: str) -> list[Line]:
    chosen = [*rng.sample(STAGE_LINES[:3], 1), rng.choice(STAGE_LINES)]
    return [[word.format(name) for word in line] for line in dict.fromkeys(chosen)]


def damage_stage(rng: Rng, part: str) -> list[Line]:
    name = f"face{part}"
    if part == ".usda" and rng.random() < 0.6:
        text = Path(name).read_text()
        damaged_stage(rng, text).Export(name)
    elif part == ".usda":
        change(name, damage.damaged_text, rng)
    elif rng.random() < 0.5:  # the header, and the tables at the end
        data = bytearray(Path(name).read_bytes())
        for _ in range(damage.some(rng)):
            at = rng.choice([rng.randrange(88), len(data) - 1 - rng.randrange(2500)])
            data[at] = rng.choice([0, 127, 128, 255, rng.randrange(256)])
        Path(name).write_bytes(data)
    else:
        change(name, damage.damaged_bytes, rng)
    return stage_lines(rng, name)


def put_package() -> None:
    """A package of layers, one below another, and pictures."""
    save_parts(full_face(), Path("base.usda"))
    Path("sub").mkdir()
    Path("sub/base.usda").write_bytes(Path("base.usda").read_bytes())
    Path("face.usda").write_text('#usda 1.0\n(\n    defaultPrim = "Rich"\n    subLayers = [@./sub/base.usda@]\n)\n')
    files = [
        "face.usda",
        *sorted(
            str(path)
            for path in Path().rglob("*")
            if path.is_file() and path.name != "base.usda" and path.name != "face.usda"
        ),
        "sub/base.usda",
    ]
    Path("face.usdz").write_bytes(damage.zipped([(Path(name).as_posix(), Path(name).read_bytes()) for name in files]))


def damage_member(rng: Rng, name: str, data: bytes) -> bytes:
    if name.endswith(".usda"):
        if rng.random() < 0.5:
            return str(damaged_stage(rng, data.decode()).ExportToString()).encode()
        return damage.damaged_text(rng, data)
    if name.endswith((".png", ".jpg")) and rng.random() < 0.7:
        return (
            damage.damaged_picture(rng, data)
            if data[:4] != PNG[:4] or len(data) > 200
            else damage.damaged_bytes(rng, data)
        )
    return damage.damaged_bytes(rng, data)


def damage_package(rng: Rng, part: str) -> list[Line]:
    change("face.usdz", lambda rng, data: damage.damaged_zip(rng, data, damage_member), rng)
    return stage_lines(rng, "face.usdz")


# ---- recipes


def put_recipe(name: str) -> Callable[[], None]:
    case = cook_cases.CASES[name]

    def put() -> None:
        case.put(Path())
        assert main([*case.line, "-o", "out.usda"]) == case.code

    return put


def command(words: Iterable[object]) -> None:
    assert main([*map(str, words)]) in (0, 1)


def put_stage(verb: str) -> Callable[[], None]:
    """A stage of a rebuild, after those before it."""

    def put() -> None:
        files = rebuild_stages.put_scans(Path())
        if verb != "personal-template":
            command([*files.personal()[:-1], "personal.usda"])
        if verb == "split-shapes":
            for name in rebuild_stages.SEEN:
                command(files.register(name))
        last = {"personal-template": files.personal, "register-scan": lambda: files.register("open")}
        words = list(last.get(verb, files.split)())
        words[words.index("-o") + 1] = "out.usda"
        command(words)

    return put


def put_neutral(verb: str) -> Callable[[], None]:
    def put() -> None:
        files = neutral_files.Files(Path())
        save_parts(scan_domes.face(), Path("head.usda"))
        save_database(scan_domes.database(), Path("faces.fpdb"))
        files.put(*scan_domes.scan(neutral_files.PERSON))
        command(files.words())
        if verb == "refine-neutral":
            Path("out.usda").rename("anna.usda")
            command([verb, "anna.usda", "scan.ply", "-o", "out.usda"])

    return put


def put_fitted() -> None:
    save_parts(make_sample(0), Path("head.usdc"))
    photographed_face.write_photos(facepipe.open("head.usdc").parts(), Path())
    words = (
        "fit-photo",
        "front.png",
        "head.usdc",
        "--landmarks",
        "front.json",
        "-o",
        "out.usda",
        *photographed_face.SOON,
    )
    command(words)


def damage_recipe(rng: Rng, part: str) -> list[Line]:
    """Attributes of the recipe changed, and the result read, cooked, or edited."""
    from pxr import Sdf, Tf

    layer = Sdf.Layer.FindOrOpen("out.usda")
    specs = {
        name: layer.GetAttributeAtPath(f"/{layer.defaultPrim}.facepipe:recipe:{name}")
        for name in ("options", "sources", "digests", "verb", "version")
    }
    for _ in range(rng.choice([1, 1, 2])):
        name = rng.choice(["options"] * 6 + ["sources", "sources", "digests", "verb", "version"])
        with contextlib.suppress(Tf.ErrorException, TypeError, ValueError):  # no value of that kind
            _damage_attribute(rng, name, specs[name])
    layer.Save()
    del layer, specs
    lines = [["cook", "out.usda", "--force"]] * 6 + [["cook", "out.usda", "--dry-run"], ["inspect", "out.usda"]]
    words = cook_cases.CASES[part].command if part in cook_cases.CASES else (part,)
    lines += [[*words, "--edit", "out.usda", "-o", "out2.usda"]] * 6
    return [rng.choice(lines)]


def _damage_attribute(rng: Rng, name: str, spec: Any) -> None:
    if spec is None or spec.default is None:
        return
    if rng.random() < 0.03:
        spec.ClearDefaultValue()
    elif name == "options":
        text = damage.damaged_json(rng, spec.default.encode())
        spec.default = text.decode("utf-8", "replace").replace("\0", "")
    elif name in ("verb", "version"):
        spec.default = rng.choice([*summaries(), *damage.NAMES, "0.0", "99.0.0", "0.1.0", "1.x"])
    else:
        items = list(spec.default)
        at = rng.randrange(len(items) + 1)
        own = [path.name for path in Path().iterdir()]
        item = rng.choice([*damage.NAMES, *own, "sha256:0", "sha256:" + "0" * 64])
        items[at : at + rng.choice([0, 1])] = [item] * rng.choice([0, 1, 1, 1, 3])
        spec.default = type(spec.default)(items)


# ---- projects of rebuilds


def put_project() -> None:
    for name in ("head.usda", "faces.fpdb", "neutral.ply", "smile.ply", "wink.ply", "smile.landmarks.json"):
        Path(name).write_text("")
    text = rebuild_project.HEAD.replace("\n[neutral]", '\nwork = "work"\njoint = true\n[neutral]')
    text += "weights = { eyeBlink_L = 1 }\n"
    text += '[expressions.smile]\nscan = "smile.ply"\n[expressions.wink]\nscan = "wink.ply"\nweights = { blink = 1 }\n'
    text += "[options.neutral]\nunit = 'mm'\n[options.refinement]\nregions = ['nose', 'mouth']\ndetail_mm = 8\n"
    text += "[options.template]\n[options.expressions]\nweight_sigma = 0.01\n[options.split]\nnoise = 0.2\n"
    Path("anna.toml").write_text(text)


def read_project() -> None:
    from facepipe.scanning.rebuild import read_project as read

    read(Path("anna.toml"))


def damage_project(rng: Rng, part: str) -> list[Line]:
    change("anna.toml", damage.damaged_toml, rng)
    return [rng.choice([read_project, read_project, read_project, ["rebuild", "anna.toml", "-o", "out.usda"]])]


# ---- array files with their sums: .fpdb, .fpnr, .fpstage, trainings


def damaged_arrays(rng: Rng, data: bytes) -> bytes:
    """Another header, other content, or other numbers; the sum is right."""
    if rng.random() < 0.15:
        return damage.damaged_bytes(rng, data)
    size = int.from_bytes(data[:8], "little")
    head, arrays = json.loads(data[8 : 8 + size]), bytearray(data[8 + size :])
    about = head["__metadata__"]
    way = rng.randrange(10)
    if way < 5:
        about["content"] = damage.json_text(rng, damage.damaged_value(rng, json.loads(about["content"]))).decode(
            "utf-8", "replace"
        )
    elif way < 7:
        head = damage.damaged_value(rng, head)
    elif way < 9 and arrays:
        for _ in range(damage.some(rng)):
            at = 4 * rng.randrange(len(arrays) // 4)
            odd = [b"\xff" * 4, b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\0" * 4, b"\xff\xff\xff\x7f"]
            floats = [1e11, -1e11, 1e-30, -1e-45, 1.0, rng.gauss(0.0, 10.0)]
            number = rng.choice(
                [*odd, *(struct.pack("<f", one) for one in floats), struct.pack("<i", rng.randrange(9))]
            )
            arrays[at : at + 4] = number
    else:
        _resized(rng, head, arrays)
    return _summed(head, bytes(arrays))


def _resized(rng: Rng, head: dict[str, Any], arrays: bytearray) -> None:
    """One array is shorter, of another shape, or gone; those behind it follow."""
    names = sorted((name for name in head if name != "__metadata__"), key=lambda name: head[name]["data_offsets"])
    chosen = rng.choice(names)
    first, last = head[chosen]["data_offsets"]
    shape = head[chosen]["shape"]
    row = (last - first) // max(1, shape[0]) if shape else last - first
    cut = row if rng.random() < 0.7 and shape and shape[0] else last - first
    if rng.random() < 0.3:
        head[chosen]["shape"] = [1, *shape] if rng.random() < 0.5 else [int(np.prod(shape))]
        return
    del arrays[last - cut : last]
    head[chosen]["shape"] = [shape[0] - cut // max(1, row), *shape[1:]] if shape else [0]
    for name in names:
        start, end = head[name]["data_offsets"]
        head[name]["data_offsets"] = [start - cut * (start >= last), end - cut * (end >= last)]
    if rng.random() < 0.3 and cut == last - first:
        del head[chosen]


def _summed(head: Any, arrays: bytes) -> bytes:
    blank = "0" * 64
    if isinstance(head, dict) and isinstance(head.get("__metadata__"), dict) and "sha256" in head["__metadata__"]:
        head["__metadata__"]["sha256"] = blank
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 8)
    data = struct.pack("<Q", len(text)) + text + arrays
    return data.replace(f'"sha256": "{blank}"'.encode(), f'"sha256": "{hashlib.sha256(data).hexdigest()}"'.encode(), 1)


def put_database() -> None:
    from database_faces import sources

    save_database(create_database(sources(3), DatabaseOptions(tolerance_mm=5.0)).database, Path("faces.fpdb"))


DATABASE_LINES = [
    ["database", "info", "faces.fpdb"],
    ["database", "info", "faces.fpdb", "--json"],
    ["database", "remove", "faces.fpdb", "face2", "-o", "out.fpdb"],
]


def put_neural(bones: bool) -> Callable[[], None]:
    """A rig, with an encoder where it has no bones."""

    def put() -> None:
        from facepipe.neural import save_neural_rig

        save_parts(neural_faces.face(joints=bones), Path("face.usda"))
        rig = neural_faces.neural_rig(facepipe.open("face.usda").parts(), bones=bones)
        save_neural_rig(rig, Path("rig.fpnr"), {}, None if bones else neural_faces.neural_encoder(rig))

    return put


NEURAL_LINES = [
    ["neural-rig", "apply", "face.usda", "rig.fpnr", "-o", "out.usda"],
    ["neural-rig", "invert", "rig.fpnr", "face.usda", "-o", "out.usda"],
    ["export", "face.usda", "--neural", "rig.fpnr", "-o", "out.onnx"],
]


def put_rebuilt() -> None:
    """A rebuild whose stages are all in its work folder."""
    rebuild_project.put_drawer(Path())
    Path("anna.toml").write_text(f'work = "work"\n{rebuild_project.PROJECT}')
    command(["rebuild", "anna.toml", "-o", "out.usda"])


def damage_rebuilt(rng: Rng, part: str) -> list[Line]:
    stages = sorted(str(path) for path in Path("work").rglob("*.fpstage"))
    change(rng.choice(stages), damaged_arrays, rng)
    return [["rebuild", "anna.toml", "-o", "out.usda", "--force"]]


# ---- payloads of bones, of persons


def put_payload() -> None:
    put_face()
    tiny_payload(Path("pose.fpb"), frames=2)


def put_person() -> None:
    """Against the face itself, which has no modes: points."""
    put_face()
    save_parts(made(1), Path("other.usda"))
    assert main(["person", "other.usda", "--template", "face.usda", "--within", "0.2", "-o", "pose.fpb"]) == 0


def damaged_payload(rng: Rng, data: bytes) -> bytes:
    """Mostly with the right sum."""
    found = damage.damaged_bytes(rng, data[:-4])
    return found + struct.pack("<I", zlib.crc32(found)) if rng.random() < 0.8 else found + data[-4:]


# ---- networks


def put_models() -> None:
    save_parts(networked(network()), Path("face.usda"))
    assert main(["export", "face.usda", "-o", "head.onnx"]) == 0
    assert main(["export", "face.usda", "--sliders", "-o", "sliders.onnx"]) == 0


def damage_model(rng: Rng, part: str) -> list[Line]:
    name = rng.choice(["head", "sliders"])
    if rng.random() < 0.3:
        change(f"{name}.onnx.json", damage.damaged_json, rng)
    else:
        change(f"{name}.onnx", damaged_graph, rng)
    return [rng.choice([["validate", f"{name}.onnx"], ["eval", f"{name}.onnx", "-o", "out.npz"]])]


def damaged_graph(rng: Rng, data: bytes) -> bytes:
    """Another node, tensor, input or text of the metadata."""
    import onnx

    if rng.random() < 0.3:
        return damage.damaged_bytes(rng, data)
    model = onnx.load_from_string(data)
    for _ in range(damage.some(rng)):
        way = rng.randrange(7)
        nodes, tensors = model.graph.node, model.graph.initializer
        if way == 0 and len(nodes):
            rng.choice(nodes).op_type = rng.choice(
                ["Add", "Loop", "If", "Nonsense", "MatMul", "Identity", "", "Gather", "Reshape"]
            )
        elif way == 1 and len(nodes):
            node = rng.choice(nodes)
            if len(node.input):
                node.input[rng.randrange(len(node.input))] = rng.choice(
                    ["", "gone", rng.choice(tensors).name, node.output[0]]
                )
        elif way == 2:
            tensor = rng.choice(tensors)
            tensor.dims[:] = rng.choice([[], [0], [-1], [2**40], [2**31, 2**31], [*tensor.dims, 1], [1]])
        elif way == 3:
            rng.choice(tensors).data_type = rng.choice([0, 1, 7, 8, 10, 11, 99])
        elif way == 4 and len(model.metadata_props):
            one = rng.choice(model.metadata_props)
            try:
                one.value = damage.json_text(rng, damage.damaged_value(rng, json.loads(one.value))).decode(
                    "utf-8", "ignore"
                )
            except ValueError:
                one.value = rng.choice(["", "[", "null", "1e999"])
        elif way == 5:
            tensor = rng.choice(tensors)
            if tensor.raw_data:
                tensor.raw_data = damage.damaged_bytes(rng, tensor.raw_data)
            tensor.data_location = rng.choice([0, 0, 1])
        else:
            model.ir_version = rng.choice([0, 8, 99, 2**40])
            model.opset_import[0].version = rng.choice([0, -1, 15, 999])
    return model.SerializeToString()


# ---- glTF


def put_gltf(suffix: str, *flags: str) -> Callable[[], None]:
    def put() -> None:
        save_parts(clipped_face(), Path("source.usda"))
        assert main(["export", "source.usda", "-o", f"face{suffix}", *flags]) == 0
        Path("source.usda").unlink()

    return put


def put_draco(name: str) -> Callable[[], None]:
    def put() -> None:
        Path("face.glb").write_bytes((draco_files.FOLDER / f"{name}.glb").read_bytes())

    return put


def damage_gltf(rng: Rng, part: str) -> list[Line]:
    path = next(Path().glob("face.*[fbm]"))
    data = path.read_bytes()
    if rng.random() < 0.2:
        data = damage.damaged_bytes(rng, data)
    elif path.suffix == ".gltf":
        data = damage.damaged_json(rng, data)
    else:
        size = int.from_bytes(data[12:16], "little")
        root, binary = data[20 : 20 + size], data[28 + size :]
        if rng.random() < (0.3 if b"KHR_draco" in root else 0.8):
            root = damage.damaged_json(rng, root)
        else:
            binary = damage.damaged_bytes(rng, binary)
        data = glb(root, binary)
    path.write_bytes(data)
    lines = [["import", "gltf", path.name, "out.usda"], ["validate", path.name]]
    return [rng.choice(lines + ([["export", path.name, "-o", "out.vrm", *TERMS]] if path.suffix == ".vrm" else []))]


def put_avatar(data: Callable[[int], bytes]) -> Callable[[], None]:
    def put() -> None:
        Path("face.vrm").write_bytes(data(5))

    return put


def put_kept() -> None:
    """A stage that keeps what a VRM says."""
    Path("face.vrm").write_bytes(vrm_files.avatar(5))
    assert main(["import", "gltf", "face.vrm", "face.usda"]) == 0
    Path("face.vrm").unlink()


def damage_avatar(rng: Rng, part: str) -> list[Line]:
    """A damaged file, or one of its extensions in a stage that keeps them."""
    if not Path("face.usda").is_file():
        return damage_gltf(rng, part)
    from pxr import Sdf, Tf

    layer = Sdf.Layer.FindOrOpen("face.usda")
    spec = layer.GetAttributeAtPath(f"/{layer.defaultPrim}.facepipe:vrm")
    text = damage.damaged_json(rng, spec.default.encode())
    with contextlib.suppress(Tf.ErrorException, TypeError, ValueError):
        spec.default = text.decode("utf-8", "replace").replace("\0", "")
    layer.Save()
    del layer, spec
    line = ["export", "face.usda", "-o", "out.vrm", *TERMS]
    return [rng.choice([line] * 4 + [["export", "face.usda", "-o", "out.glb"], ["inspect", "face.usda"]])]


def put_foreign_gltf() -> None:
    """What other programs write and facepipe doesn't: other images and shading, rigid motion, skins that disagree."""
    builder = gltf_builder.full_document()
    del builder.root["meshes"][0]["extras"]
    for target in builder.root["meshes"][0]["primitives"][0]["targets"]:
        target["extras"] = {"name": f"shape{len(builder.root['accessors'])}"}
    written = io.BytesIO()
    Image.new("RGB", (8, 8), (200, 150, 130)).save(written, "WEBP")
    image = builder.add("images", {"bufferView": builder.view(written.getvalue()), "mimeType": "image/webp"})
    texture = builder.add("textures", {"extensions": {"EXT_texture_webp": {"source": image}}})
    place = {"KHR_texture_transform": {"offset": [0.1, 0], "scale": [2, 2], "rotation": 0.5}}
    glossy = {
        "diffuseTexture": {"index": texture, "extensions": place},
        "specularGlossinessTexture": {"index": 0},
        "specularFactor": [0.2, 0.2, 0.2],
        "glossinessFactor": 0.4,
    }
    builder.root["materials"][0]["extensions"] = {
        "KHR_materials_pbrSpecularGlossiness": glossy,
        "KHR_materials_unlit": {},
    }
    dark = builder.add("materials", {"name": "dark"})
    builder.root["extensions"] = {"KHR_materials_variants": {"variants": [{"name": "dark"}, {"name": "a/b"}]}}
    shown = {"KHR_materials_variants": {"mappings": [{"material": dark, "variants": [0]}]}}
    builder.root["meshes"][0]["primitives"][0]["extensions"] = shown
    builder.root["nodes"][11]["weights"] = [0.1, 0, 0.5]
    skin = builder.root["skins"][0]
    turned = np.tile(np.eye(4), (len(skin["joints"]), 1, 1)).reshape(-1, 16)
    other = builder.add("skins", skin | {"inverseBindMatrices": builder.array(turned)})
    shown = builder.add("nodes", {"mesh": 0, "skin": other})
    hat = builder.add("nodes", {"mesh": 0, "name": "hat"})
    builder.root["scenes"][0]["nodes"] += [shown, hat]
    animation = builder.root["animations"][0]
    times = builder.array(np.array([0.0, 1.0]))
    animation["samplers"].append({"input": times, "output": builder.array(np.zeros((2, 3)))})
    animation["channels"].append({"sampler": 2, "target": {"node": hat, "path": "translation"}})
    weight = {"KHR_animation_pointer": {"pointer": f"/nodes/{shown}/weights/1"}}
    animation["samplers"].append({"input": times, "output": builder.array(np.array([0.0, 1.0]))})
    animation["channels"].append({"sampler": 3, "target": {"path": "pointer", "extensions": weight}})
    Path("face.glb").write_bytes(builder.glb())


FOREIGN_STAGE = """#usda 1.0
(
    defaultPrim = "Root"
    timeCodesPerSecond = 24
)
def Xform "Root"
{
    double3 xformOp:translate.timeSamples = { 0: (0, 0, 0), 10: (1, 0, 0) }
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Mesh "Face"
    {
        int[] faceVertexCounts = [3, 3]
        int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
        point3f[] points.timeSamples = {
            0: [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)],
            5: [(0, 0, 1), (1, 0, 0), (1, 1, 0), (0, 1, 0)],
        }
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "vertex")
        rel material:binding = </Root/Skin>
    }
    def Xform "Eye"
    {
        float xformOp:rotateY.timeSamples = { 0: 0, 10: 20 }
        uniform token[] xformOpOrder = ["xformOp:rotateY"]
        def Mesh "Ball"
        {
            int[] faceVertexCounts = [3]
            int[] faceVertexIndices = [0, 1, 2]
            point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0)]
            rel material:binding = </Root/Glass>
        }
    }
    def Material "Skin"
    {
        token outputs:mtlx:surface.connect = </Root/Skin/Surface.outputs:out>
        def Shader "Surface"
        {
            uniform token info:id = "ND_standard_surface_surfaceshader"
            color3f inputs:base_color.connect = </Root/Skin/Tint.outputs:out>
            float inputs:specular_roughness = 0.4
            token outputs:out
        }
        def Shader "Tint"
        {
            uniform token info:id = "ND_multiply_color3"
            color3f inputs:in1.connect = </Root/Skin/Image.outputs:out>
            color3f inputs:in2 = (0.5, 1, 1)
            color3f outputs:out
        }
        def Shader "Image"
        {
            uniform token info:id = "ND_image_color3"
            asset inputs:file = @skin.png@
            float2 inputs:texcoord.connect = </Root/Skin/Place.outputs:out>
            color3f outputs:out
        }
        def Shader "Place"
        {
            uniform token info:id = "ND_place2d_vector2"
            float2 inputs:scale = (2, 2)
            float inputs:rotate = 30
            float2 outputs:out
        }
    }
    def Material "Glass"
    {
        token outputs:surface.connect = </Root/Glass/Surface.outputs:surface>
        def Shader "Surface"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </Root/Glass/Image.outputs:rgb>
            token outputs:surface
        }
        def Shader "Image"
        {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @skin.png@
            float2 inputs:st.connect = </Root/Glass/Place.outputs:result>
            float3 outputs:rgb
        }
        def Shader "Place"
        {
            uniform token info:id = "UsdTransform2d"
            float2 inputs:scale = (2, 2)
            float2 outputs:result
        }
    }
}
"""


def put_foreign_stage() -> None:
    Path("skin.png").write_bytes(gltf_builder.PNG)
    Path("face.usda").write_text(FOREIGN_STAGE)


def damage_foreign(rng: Rng, part: str) -> list[Line]:
    if part == "gltf":
        return damage_gltf(rng, part)
    damage_stage(rng, ".usda")
    return [["import", "usd", "face.usda", "out.usda"]]


# ---- meshes of text


def put_obj() -> None:
    folder = Path("shapes")
    folder.mkdir()
    (folder / "neutral.obj").write_text(obj_files.NEUTRAL)
    (folder / "jawOpen.obj").write_text(obj_files.NEUTRAL.replace("v 1 1 0", "v 1 1 0.5"))
    (folder / "face.mtl").write_text(obj_files.MTL)
    (folder / "maps").mkdir()
    Image.fromarray(picture(16, 16)).save(folder / "maps" / "eye 1.png")
    (folder / "landmarks.json").write_text(json.dumps({"multipie68": [3, 0], "eyes": {"tip": 7}}))


def damage_obj(rng: Rng, part: str) -> list[Line]:
    name = rng.choice(["neutral.obj", "neutral.obj", "jawOpen.obj", "face.mtl", "landmarks.json"])
    how = damage.damaged_json if name.endswith(".json") else damage.damaged_text
    change(f"shapes/{name}", how, rng)
    return [
        rng.choice(
            [
                ["import", "obj", "shapes", "out.usda"],
                ["import", "obj", "shapes/neutral.obj", "out.usda"],
                read_obj_scan,
            ]
        )
    ]


def read_obj_scan() -> None:
    from facepipe.importers.scan_file import read_scan

    read_scan(Path("shapes/neutral.obj"))


def put_ply(element: bytes = b"face", **form: Any) -> Callable[[], None]:
    data = cube(**form).replace(b"element face", b"element " + element)
    return lambda: Path("scan.ply").write_bytes(data) and None


def put_box(name: str, kind: str) -> Callable[[], None]:
    def put() -> None:
        import trimesh

        data = trimesh.creation.box().export(file_type=kind)
        Path(name).write_bytes(data.encode() if isinstance(data, str) else data)

    return put


def damage_scan(rng: Rng, part: str) -> list[Line]:
    (file,) = Path().glob("scan.*")
    change(file.name, {".ply": damaged_ply, ".stl": damaged_stl, ".off": damaged_off}[file.suffix], rng)
    return [read_the_scan]


def read_the_scan() -> None:
    from facepipe.importers.scan_file import read_scan

    (file,) = Path().glob("scan.*")
    read_scan(file)


# ---- arrays


def put_network() -> None:
    save_parts(networked(None), Path("face.usda"))
    save_network(Path("net.npz"), network())


def put_makehuman() -> None:
    Path("head.npz").write_bytes(small_head())


def put_ict() -> None:
    Path("head.npz").write_bytes((SHARED / "ict_facekit" / "ict_facekit.npz").read_bytes())


def put_record() -> None:
    from facepipe_blender.face_objects import Kept, keep

    text, parts = TextBlock(), tiny_face()
    places = {mesh.name: np.eye(4) for mesh in parts.meshes}
    keep(Kept(parts=parts, bones=dict.fromkeys(parts.skeleton.joints, np.eye(4)), places=places, file="a.usda"), text)
    (content,) = text.values()
    Path("record.npz").write_bytes(content)


def read_record() -> None:
    from facepipe_blender.face_objects import kept_in

    kept_in(TextBlock(facepipe_content=Path("record.npz").read_bytes()))


def damage_record(rng: Rng, part: str) -> list[Line]:
    """Its arrays, or the JSON and the face in them; the face is also a file, to see whether it kills USD alone."""
    file = Path("record.npz")
    data = damage.damaged_npz(rng, file.read_bytes())
    if rng.random() < 0.5:
        with np.load(file) as found:
            arrays = {name: found[name] for name in found.files}
        name, how = rng.choice([("header", damage.damaged_json), ("face", damage.damaged_bytes)])
        arrays[name] = np.frombuffer(how(rng, arrays[name].tobytes()), np.uint8)
        stream = io.BytesIO()
        np.savez_compressed(stream, **arrays)
        data = stream.getvalue()
    file.write_bytes(data)
    with contextlib.suppress(Exception), np.load(file) as found:
        Path("face.usdc").write_bytes(found["face"].tobytes())
    return [read_record]


# ---- pictures and what goes with them


def put_map() -> None:
    put_face()
    head = tiny_face().meshes[0]
    save_map(paint(head, 16), Path("map.png"))
    Path("legend.json").write_text(json.dumps(legend_of(list(head.regions))))


def damage_map(rng: Rng, part: str) -> list[Line]:
    if rng.random() < 0.5:
        change("map.png", damage.damaged_picture, rng)
    else:
        change("legend.json", damage.damaged_json, rng)
    return [["regions", "face.usda", "--map", "map.png", "--legend", "legend.json", "-o", "out.usda"]]


def put_photo(kind: str, **options: Any) -> Callable[[], None]:
    def put() -> None:
        Path("a.png").write_bytes(
            oriented(picture(), 6, kind) if kind == "JPEG" else encoded(Image.fromarray(picture()), kind, **options)
        )
        (Path("a.landmarks.json")).write_text(
            json.dumps({"multipie68": [[i % 9 * 8 + 5, i // 9 * 8 + 5] for i in range(68)], "units": "pixels"})
        )

    return put


def read_photo() -> None:
    from facepipe.photo.fit import read_photo as read

    read(Path("a.png"))


def read_photos() -> None:
    from facepipe.scanning.photos.photos import read_photos as read

    read([Path("a.png")], 64)


def read_landmarks() -> None:
    from facepipe.photo.fit import read_photo as read
    from facepipe.photo.fit.photo_landmarks import read_landmarks as landmarks

    landmarks(Path("a.landmarks.json"), read(Path("a.png")))


def damage_photo(rng: Rng, part: str) -> list[Line]:
    if rng.random() < 0.7:
        change("a.png", damage.damaged_picture, rng)
        return [rng.choice([read_photo, read_photos, read_landmarks])]
    change("a.landmarks.json", damage.damaged_json, rng)
    return [read_landmarks]


def put_textured() -> None:
    """A face of which a picture covers the mesh."""
    folder = Path("shapes")
    put_obj()
    (folder / "face.mtl").write_text("newmtl skin\nmap_Kd maps/a.png\nnewmtl eye\nmap_Kd maps/a.png\n")
    (folder / "maps" / "a.png").write_bytes(encoded(Image.fromarray(picture(32, 32)), "PNG"))
    assert main(["import", "obj", "shapes", "face.usda"]) == 0


def damage_texture(rng: Rng, part: str) -> list[Line]:
    change(str(rng.choice(sorted(Path().rglob("a.png")))), damage.damaged_picture, rng)
    lines: list[Line] = [
        ["export", "face.usda", "-o", "out.glb"],
        ["render", "face.usda", "-o", "out.png", "--size", "32"],
    ]
    return [rng.choice([*lines, ["import", "obj", "shapes", "out.usda"], read_obj_scan, ["validate", "face.usda"]])]


def put_cameras() -> None:
    from facepipe.scanning.photos.cameras import Cameras, write_cameras

    one = camera_at(np.array([120.0, 60.0, 700.0]), 0.4, distortion=(-0.11, 0.05, 0.002, -0.003))
    write_cameras(Path("rig.json"), Cameras(cameras={"a.jpg": one, "b.jpg": one}, unit="cm"))
    Path("markers.json").write_text('{"photos": {"a": {"m": [1, 2], "n": [3.5, 4]}, "b": {"m": [1, 2]}}}')
    points = [None if i in (3, 67) else [i, 2.5, -i] for i in range(68)]
    marks = {"scheme": "multipie68", "points": points, "markers": {"cheek": [1, 2.5, -3]}, "sigma_mm": [0.5] * 68}
    Path("scan.landmarks.json").write_text(json.dumps(marks))


def read_cameras() -> None:
    from facepipe.scanning.photos.cameras import read_cameras as read

    read(Path("rig.json"))


def read_markers() -> None:
    from facepipe.scanning.photos.cameras import read_markers as read

    read(Path("markers.json"))


def read_scan_marks() -> None:
    from facepipe.importers.scan_landmarks import read_scan_landmarks as read

    read(Path("scan.landmarks.json"))


def damage_cameras(rng: Rng, part: str) -> list[Line]:
    name, read = rng.choice(
        [("rig.json", read_cameras), ("markers.json", read_markers), ("scan.landmarks.json", read_scan_marks)]
    )
    change(name, damage.damaged_json, rng)
    return [read]


# ---- small files of words and numbers


JOINTS = {
    "unit": "mm",
    "joints": {
        "head": {"position": [0, 40, -20]},
        "head/jaw": {"position": [0, 10, -15], "radius": 300, "rotation": [0, 0, 0, 1], "surface": True},
        "head/brow": {"position": [0, 80, 5], "regions": ["mouth"]},
    },
    "parts": {"Teeth*": "head/jaw"},
}
LANDMARKS = {"multipie68": list(range(20)), "mine": {"a": 1, "b": 2}}
RULES = {
    "joints": {"*": {"t": [-1, 1], "s": [0.5, 2]}, "jaw": {"rx": [0, 0.4], "tz": [None, 0]}},
    "lock": ["root:*"],
    "units": "cm",
}
WEIGHTS = {"regions": {"mouth": [0.8, 0.2]}, "default": [0.5, 0.5], "gains": [1, 1], "locked": {"neck": 2}}


def put_skinnable() -> None:
    from bone_faces import skeletonless

    save_parts(skeletonless(made(0)), Path("face.usda"))
    Path("joints.json").write_text(json.dumps(JOINTS))


def put_tables() -> None:
    put_face("own.usda")
    parts = facepipe.open("own.usda").parts()
    joints = replace(parts.skeleton, joints=("root", "root/jaw", "root/lidLeft"))
    save_parts(replace(parts, skeleton=joints), Path("face.usda"))
    for name, text in (
        ("a.toml", slider_tables.TOML),
        ("b.csv", slider_tables.LIST),
        ("c.csv", slider_tables.MATRIX),
    ):
        text = text.replace("lidRight", "jaw").replace("smileLeft", "jawOpen").replace("smileRight", "mouthSmileLeft")
        Path(name).write_text(text)


def damage_table(rng: Rng, part: str) -> list[Line]:
    name = rng.choice(["a.toml", "b.csv", "c.csv"])
    change(name, damage.damaged_toml if name == "a.toml" else damage.damaged_text, rng)
    return [["sliders", "face.usda", "--from", name, "-o", "out.usda"]]


def put_renames() -> None:
    save_parts(clipped_face(), Path("face.usda"))
    Path("names.json").write_text(
        json.dumps({"jawOpen": "Mund auf", "mouthSmileLeft": "smile", "jaw": "mixamorig:Jaw"})
    )
    Path("names.csv").write_text("old,new\njawOpen,open\nroot/jaw/lip,DEF-lip.001\n")


def damage_renames(rng: Rng, part: str) -> list[Line]:
    name = rng.choice(["names.json", "names.csv"])
    change(name, damage.damaged_json if name == "names.json" else damage.damaged_text, rng)
    return [["export", "face.usda", "--rename", name, "-o", "out.glb"]]


def put_clips() -> None:
    put_face()
    Path("take.csv").write_text(
        "Timecode,jawOpen,mouthSmileLeft,HeadYaw\n00:00:00:00,0,0.5,0.1\n00:00:00:01,0.25,0,0\n00:00:00:02,1,0,0\n"
    )
    Path("talk.csv").write_text("jawOpen\n0\n0.25\n1\n")
    Path("take.json").write_text(json.dumps(CLIPS))
    Path("matrix.json").write_text(json.dumps(MATRIX))
    Path("lost.csv").write_text(
        "Timecode,BlendShapeCount,JawOpen,HeadYaw\n10:00:59;28,2,0,12\n10:00:59;29,2,,\n10:01:00;02,2,0.4,15\n"
    )
    Path("table.txt").write_text("sep=;\n;timeCode;blendShapes.JawOpen\n0;0,0;0,1\n1;0,033;0,5\n2;0,067;0,2\n")
    for name, content in OTHER_CLIPS.items():
        Path(name).write_text(json.dumps(content))
    Path("tracked.jsonl").write_text("\n".join(map(json.dumps, TRACKED)))
    Path("alone.usda").write_text(
        '#usda 1.0\n(\n    timeCodesPerSecond = 30\n)\ndef SkelAnimation "World"\n{\n'
        '    uniform token[] blendShapes = ["jawOpen"]\n    uniform token[] joints = ["head"]\n'
        "    float[] blendShapeWeights.timeSamples = { 0: [0], 1: [0.5] }\n"
        "    quatf[] rotations.timeSamples = { 0: [(1, 0, 0, 0)], 1: [(0.9, 0.1, 0, 0)] }\n"
        "    float3[] translations = [(0, 1, 0)]\n    half3[] scales = [(1, 1, 1)]\n}\n"
    )


TRACKED = [
    {
        "timestampMs": 33 * i,
        "faceBlendshapes": [{"categories": [{"categoryName": "jawOpen", "score": 0.1 * i}]}],
        "facialTransformationMatrixes": [
            {"rows": 4, "columns": 4, "data": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, -30, 1]}
        ],
    }
    for i in range(3)
]
OTHER_CLIPS = {
    "tracked.json": TRACKED,
    "keys.json": {"name": "x", "dt": [33, 100, 33], "vs": {"jawOpen": [0, 1, None], "mouthSmileLeft": [0.1, 0.2, 0.3]}},
    "cues.json": {"visemes": ["aa", "PP"], "vtimes": [0, 100], "vdurations": [100, 80]},
    "ids.json": [{"audioOffset": 500000, "visemeId": 2}, {"audioOffset": 1500000, "visemeId": 21}],
    "azure.json": [{"FrameIndex": 0, "BlendShapes": [[0.1] * 55, [0.2] * 55]}],
}
CLIPS = {
    "fps": 30,
    "frames": [
        {"time": 0.0, "blendShapes": {"jawOpen": 0.2}, "HeadYaw": 0.1},
        {"time": 0.1, "blendShapes": {"jawOpen": 0.5}, "HeadYaw": 0.2},
    ],
}
MATRIX = {"exportFps": 60, "facsNames": ["jawOpen", "mouthSmileLeft"], "weightMat": [[0.1, 0.2], [0.3, 0.4]]}


def damage_clip(rng: Rng, part: str) -> list[Line]:
    tables = ["take.csv", "talk.csv", "lost.csv", "table.txt", "tracked.jsonl", "alone.usda"]
    name = rng.choice([*tables, "take.json", "matrix.json", *OTHER_CLIPS])
    change(name, damage.damaged_json if name.endswith(".json") else damage.damaged_text, rng)
    return [["animate", "face.usda", name, "-o", "out.usda"]]


def put_settings() -> None:
    save_sources(Path())
    put_face("face.usda")
    save_parts(made(1), Path("other.usda"))
    Path("limits.json").write_text(json.dumps(RULES))
    Path("weights.json").write_text(json.dumps(WEIGHTS))


def damage_settings(rng: Rng, part: str) -> list[Line]:
    if rng.random() < 0.5:
        change("weights.json", damage.damaged_json, rng)
        return [["blend", "face.usda", "other.usda", "--weights", "weights.json", "-o", "out.usda"]]
    change("limits.json", damage.damaged_json, rng)
    return [
        ["sliders", "face.usda", "--from-shapes", "jawOpen", "--limits", "limits.json", "--residual", "-o", "out.usda"]
    ]


# ---- trainings that were broken off


def put_training() -> None:
    from neural_training import turning_face

    save_parts(turning_face(), Path("head.usda"))
    train()


def train() -> None:
    from neural_training import FEW_SAMPLES, FEW_STEPS

    from facepipe.neural import SampleMotion, TrainNeuralRig

    motion = SampleMotion(options=FEW_SAMPLES)(facepipe.open("head.usda").parts(), "head.usda")
    TrainNeuralRig(options=FEW_STEPS)(motion, checkpoint=Path("head.training"))


def damage_training(rng: Rng, part: str) -> list[Line]:
    change("head.training", damaged_arrays, rng)
    return [train]


FORMATS: dict[str, Format] = {
    "usda": Format({".usda": lambda: save_parts(good_face(), Path("face.usda"))}, damage_stage, stages=True),
    "usdc": Format({".usdc": lambda: save_parts(good_face(), Path("face.usdc"))}, damage_stage, stages=True),
    "usdz": Format(
        {"saved": lambda: save_parts(full_face(), Path("face.usdz")), "layers": put_package},
        damage_package,
        stages=True,
    ),
    "recipes": Format({name: put_recipe(name) for name in cook_cases.CASES}, damage_recipe),
    "long recipes": Format(
        {
            **{verb: put_stage(verb) for verb in ("personal-template", "register-scan", "split-shapes")},
            **{verb: put_neutral(verb) for verb in ("fit-neutral", "refine-neutral")},
            "rebuild": lambda: put_rebuilt(),
            **({"fit-photo": put_fitted} if importlib.util.find_spec("torch") else {}),
        },
        damage_recipe,
        writes=("out", "work"),
        keeps=("work",),
    ),
    "projects": Format({"project": put_project}, damage_project, keeps=("work",)),
    "databases": Format({"database": put_database}, one_of(DATABASE_LINES, damaged_arrays, "faces.fpdb")),
    "neural rigs": Format(
        {"bones": put_neural(True), "encoder": put_neural(False)}, one_of(NEURAL_LINES, damaged_arrays, "rig.fpnr")
    ),
    "rebuild stages": Format({"project": put_rebuilt}, damage_rebuilt, writes=("out", "work"), keeps=("work",)),
    "payloads": Format(
        {"payload": put_payload, "person": put_person},
        one_of(
            [
                ["apply-bones", "face.usda", "--info", "pose.fpb"],
                ["apply-bones", "face.usda", "pose.fpb", "-o", "out.usda"],
            ],
            damaged_payload,
            "pose.fpb",
        ),
    ),
    "onnx": Format({"models": put_models}, damage_model),
    "gltf": Format(
        {
            "full": lambda: Path("face.glb").write_bytes(gltf_builder.full_document().glb()),
            "glb": put_gltf(".glb"),
            "gltf": put_gltf(".gltf"),
            "quantised": put_gltf(".glb", "--quantize"),
            **{f"draco, {name}": put_draco(name) for name in draco_files.FILES},
        },
        damage_gltf,
    ),
    "fbx": Format(
        {
            "deflated": put_binary,
            "plain": lambda: put_binary(deflate=False),
            "ascii": put_ascii,
            **{f"nodes {number}": put_binary for number in range(4)},
        },
        damage_fbx,
    ),
    "files of others": Format({"gltf": put_foreign_gltf, "usda": put_foreign_stage}, damage_foreign),
    "vrm": Format(
        {
            "vrm": put_gltf(".vrm", "--stub-body", *TERMS),
            "avatar": put_avatar(vrm_files.avatar),
            "former": put_avatar(lambda seed: vrm_files.former_avatar(seed)[0]),
            "kept": put_kept,
        },
        damage_avatar,
    ),
    "obj": Format({"shapes": put_obj}, damage_obj),
    "ply": Format(
        {
            **{form: put_ply(form=form) for form in ("ascii", "binary_little_endian", "binary_big_endian")},
            "uneven": put_ply(form="binary_little_endian", faces=[[0, 1, 3], *SIDES[1:]], count="int", color="float"),
            "strips": put_ply(b"tristrips", form="ascii", position="double", color="ushort"),
        },
        damage_scan,
    ),
    "stl": Format({kind: put_box("scan.stl", kind) for kind in ("stl", "stl_ascii")}, damage_scan),
    "off": Format({"off": put_box("scan.off", "off")}, damage_scan),
    "slider networks": Format(
        {"network": put_network},
        one_of(
            [["sliders", "face.usda", "--from-network", "net.npz", "-o", "out.usda"]], damage.damaged_npz, "net.npz"
        ),
    ),
    "records of Blender": Format({"record": put_record}, damage_record, stages=True),
    "maps": Format({"map": put_map}, damage_map),
    "photos": Format(
        {"png": put_photo("PNG"), "jpeg": put_photo("JPEG"), "tiff": put_photo("TIFF"), "webp": put_photo("WEBP")},
        damage_photo,
    ),
    "textures": Format({"face": put_textured}, damage_texture),
    "cameras": Format({"rig": put_cameras}, damage_cameras),
    "joints": Format(
        {"joints": put_skinnable},
        one_of(
            [["skin", "face.usda", "--joints", "joints.json", "-o", "out.usda"]], damage.damaged_json, "joints.json"
        ),
    ),
    "slider tables": Format({"tables": put_tables}, damage_table),
    "rename tables": Format({"tables": put_renames}, damage_renames),
    "landmarks": Format(
        {"landmarks": put_text("points.json", LANDMARKS)},
        one_of(
            [["landmarks", "face.usda", "--from", "points.json", "-o", "out.usda"]], damage.damaged_json, "points.json"
        ),
    ),
    "clips": Format({"clips": put_clips}, damage_clip),
    "settings": Format({"settings": put_settings}, damage_settings),
}
FORMATS |= FARM | REMAINS
if importlib.util.find_spec("torch"):
    FORMATS["trainings"] = Format({"training": put_training}, damage_training, writes=("head.training",))
if (SHARED / PACKED).is_file():
    FORMATS["makehuman"] = Format(
        {"head": put_makehuman},
        one_of([["import", "makehuman", "head.npz", "out.usda"]], damage.damaged_npz, "head.npz"),
    )
    FORMATS["ict"] = Format(
        {"head": put_ict}, one_of([["import", "ict", "head.npz", "out.usda"]], damage.damaged_npz, "head.npz")
    )
