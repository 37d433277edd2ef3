"""Small files that ask for much: each is built, and its command run, in one process whose memory is measured.

`python tests/support/bombs.py GROUP` prints a JSON list: of each bomb its name, the exit code, standard error, the
seconds it took and the peak of the whole process's memory in bytes, by then.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import resource
import struct
import sys
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from gltf_builder import glb
from photo_files import chunk, encoded, packed_png, png
from PIL import Image

Words = list[str] | Callable[[], object]
_OVER = 1 << 32  # bytes that the process may take beyond what it starts with; USD fails badly at a tight limit


def npy(kind: str, shape: tuple[int, ...]) -> bytes:
    """The header of an array."""
    text = repr({"descr": kind, "fortran_order": False, "shape": shape}).replace("}", ", }")
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def zeros(size: int) -> Iterable[bytes]:
    """`size` bytes, in pieces."""
    yield from (bytes(min(1 << 20, size - start)) for start in range(0, size, 1 << 20))


def npz(path: Path, arrays: dict[str, tuple[str, tuple[int, ...]]], method: int = zipfile.ZIP_DEFLATED) -> None:
    """An archive of zeros."""
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, (kind, shape) in arrays.items():
            with archive.open(f"{name}.npy", "w") as stream:
                stream.write(npy(kind, shape))
                size = int(np.prod(shape, dtype=object)) * np.dtype(kind).itemsize
                for data in zeros(size):
                    stream.write(data)


def ict(**arrays: tuple[str, tuple[int, ...]]) -> Callable[[Path], Words]:
    """An ICT-FaceKit archive with some `arrays` of other sizes."""
    usual = {
        "neutral": ("<f4", (26719, 3)),
        "face_vertex_counts": ("<i4", (26384,)),
        "face_vertex_indices": ("<i4", (105_416,)),
        "uv": ("<f4", (3, 2)),
        "face_uv_indices": ("<i4", (105_416,)),
        "face_material": ("<i4", (26384,)),
        "material_names": ("<U8", (1,)),
    }

    def build(folder: Path) -> Words:
        npz(folder / "a.npz", usual | arrays)
        return ["import", "ict", "a.npz", "-o", "out.usda"]

    return build


def many_members(folder: Path) -> Words:
    """A directory of 60,000 names."""
    with zipfile.ZipFile(folder / "a.npz", "w") as archive:
        for number in range(60_000):
            archive.writestr(f"{number}.npy", b"")
    return ["import", "ict", "a.npz", "-o", "out.usda"]


def region_map(data: Callable[[], bytes]) -> Callable[[Path], Words]:
    """A map of regions, as the command line reads it."""

    def build(folder: Path) -> Words:
        from facepipe.core.images import read_png

        (folder / "map.png").write_bytes(data())
        return lambda: read_png(folder / "map.png")

    return build


def photo(data: Callable[[], bytes]) -> Callable[[Path], Words]:
    """A photo to fit."""

    def build(folder: Path) -> Words:
        from facepipe.photo.fit import read_photo

        (folder / "photo").write_bytes(data())
        return lambda: read_photo(folder / "photo")

    return build


def texture(data: Callable[[], bytes]) -> Callable[[Path], Words]:
    """A texture of a face that is drawn."""

    def build(folder: Path) -> Words:
        from facepipe.parts import Texture
        from facepipe.pictures.scene import decode

        return lambda: decode(Texture(name="skin.png", data=data()), 512)

    return build


def flat_png(side: int, bits: int, color: int, channels: int) -> bytes:
    """A square of one colour."""
    return packed_png(side, side, bits, color, deflated(side * (side * channels * bits // 8 + 1)))


def deflated(size: int) -> bytes:
    """`size` zeros, compressed without ever being there."""
    packer = zlib.compressobj()
    return b"".join(map(packer.compress, zeros(size))) + packer.flush()


def with_chunks(kind: bytes, data: bytes, count: int) -> bytes:
    """A small PNG with more in it."""
    plain = png(64, 64, 8, 2, bytes(64 * (64 * 3 + 1)))
    return plain[:33] + chunk(kind, data) * count + plain[33:]


def scans(count: int) -> bytes:
    """A progressive JPEG of which one scan comes again and again."""
    plain = encoded(Image.new("RGB", (4096, 4096), (200, 30, 20)), "JPEG", progressive=True)
    last = plain[plain.rindex(b"\xff\xda") : -2]
    return plain[:-2] + last * count + b"\xff\xd9"


def segments(count: int) -> bytes:
    """A small JPEG with empty segments before its pixels."""
    plain = encoded(Image.new("RGB", (64, 64)), "JPEG")
    return plain[:2] + b"\xff\xef\x00\x02" * count + plain[2:]


def promising(kind: str, side: int) -> bytes:
    """A small picture whose header has a larger side."""
    data = bytearray(encoded(Image.new("RGB", (64, 64)), kind))
    if kind == "BMP":
        data[18:26] = side.to_bytes(4, "little") * 2
        return bytes(data)
    start = int.from_bytes(data[4:8], "little")
    for at in range(start + 2, start + 2 + 12 * int.from_bytes(data[start : start + 2], "little"), 12):
        if int.from_bytes(data[at : at + 2], "little") in (256, 257):
            data[at + 2 : at + 12] = b"\4\0\1\0\0\0" + side.to_bytes(4, "little")
    return bytes(data)


PIPES = {  # how a command is given a file, by its suffix
    ".usda": ("inspect", "validate", "cook", "export -o out.glb", "render -o out.png"),
    ".usdz": ("inspect",),
    ".glb": ("import gltf -o out.usda", "validate", "view --no-browser", "scan-landmarks -o out.json"),
    ".obj": ("import obj -o out.usda",),
    ".ply": ("scan-landmarks -o out.json",),
    ".npz": ("import ict -o out.usda", "import makehuman -o out.usda", "sliders face.usda -o out.usda --from-network"),
    ".onnx": ("eval -o out.npz", "validate"),
    ".fpb": ("apply-bones face.usda --info",),
    ".fpdb": ("database info",),
    ".fpstage": ("neural-rig apply face.usda -o out.usda",),
    ".csv": ("animate face.usda -o out.usda", "sliders face.usda -o out.usda --from"),
    ".toml": ("sliders face.usda -o out.usda --from", "rebuild -o out.usda"),
    ".json": ("landmarks face.usda -o out.usda --from", "skin face.usda -o out.usda --joints"),
    ".png": ("regions face.usda --legend legend.json -o out.usda --map", "fit-photo face.usda -o out.usda"),
}


def pipe(command: str, suffix: str, kind: str) -> Callable[[Path], Words]:
    """A command given a pipe, a device, or a link to one."""

    def build(folder: Path) -> Words:
        file, target = folder / f"{kind}{suffix}", {"link": f"pipe{suffix}", "zero": "/dev/zero"}.get(kind)
        if not file.is_symlink() and not file.exists():
            os.mkfifo(file) if target is None else file.symlink_to(target)
        return [*command.split(), file.name]

    return build


def naming_pipe(words: str, file: str, text: str) -> Callable[[Path], Words]:
    """A command given a file of this text, which names `pipe`."""

    def build(folder: Path) -> Words:
        if not (folder / "pipe").exists():
            os.mkfifo(folder / "pipe")
        (folder / file).write_text(text)
        return words.split()

    return build


def reading(reader: str, file: str) -> Callable[[Path], Words]:
    """A reader of a file, as a host calls it."""

    def build(folder: Path) -> Words:
        from facepipe_gltf.raw import RawDocument

        from facepipe.core.reading import digest
        from facepipe.importers.npz import array_names
        from facepipe.importers.obj import read_landmarks

        path = folder / file
        if not path.exists():
            os.mkfifo(path)
        readers: dict[str, Callable[[Path], object]] = {
            "landmarks": lambda path: read_landmarks(path, 5),
            "digest": lambda path: digest([path]),
            "GLB": RawDocument,
            "npz": array_names,
        }
        return lambda: readers[reader](path)

    return build


def deformer(first: str, doublings: int, nodes: int = 0) -> Callable[[Path], Words]:
    """A graph of a small face in which a value (``weights``, or whole numbers) is put to itself again and again."""

    def build(folder: Path) -> Words:
        import onnx
        from faces import tiny_face

        from facepipe.cli import main as command
        from facepipe.stage import save_parts

        save_parts(tiny_face(), folder / "tiny.usda")
        with contextlib.redirect_stdout(io.StringIO()):
            command(["export", "tiny.usda", "-o", "a.onnx", "--force"])
        model = onnx.load(folder / "a.onnx")
        model.graph.initializer.append(onnx.numpy_helper.from_array(np.ones(1000, np.int64), "whole"))
        last = first
        for number in range(doublings):
            axis = 1 if first == "weights" else 0
            model.graph.node.append(onnx.helper.make_node("Concat", [last, last], [f"bomb{number}"], axis=axis))
            last = f"bomb{number}"
        for number in range(nodes):
            model.graph.node.append(onnx.helper.make_node("Add", [first, first], [f"more{number}"]))
        onnx.save_model(model, folder / "a.onnx")
        return ["eval", "a.onnx", "-o", "out.npz"]

    return build


def written(words: str, file: str, text: Callable[[], bytes]) -> Callable[[Path], Words]:
    """A command given a file of this content."""

    def build(folder: Path) -> Words:
        (folder / file).write_bytes(text())
        return words.split()

    return build


def gltf(accessor: str, view: str = "", size: int = 4) -> bytes:
    """A document of one primitive whose points are an accessor, as a GLB with a buffer of zeros."""
    text = (
        '{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],'
        '"meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}],'
        f'"accessors":[{{"type":"VEC3","componentType":5126,{accessor}}}],"bufferViews":[{view}],'
        f'"buffers":[{{"byteLength":{size}}}]}}'
    ).encode()
    return glb(text, bytes(size))


def payload(folder: Path) -> Words:
    """A payload of one joint of many that moves."""
    from facepipe.payload import read_header

    body = struct.pack("<4sHHIIIf8s", b"FPBC", 1, 2 + 8, 1000, 14_000, 1, 1.0, b"")
    body += bytes(18 * 14_000) + b"\1" + bytes(124)
    return lambda: read_header(body + struct.pack("<I", zlib.crc32(body)), "a.fpb")


def options_of_a_recipe() -> bytes:
    """A face with a recipe of many values."""
    return (
        b'#usda 1.0\n(\n    defaultPrim = "F"\n)\ndef SkelRoot "F" (prepend apiSchemas = ["FacepipeFaceAPI"])\n{\n'
        b'    uniform token facepipe:recipe:verb = "blend"\n'
        b'    uniform string facepipe:recipe:options = "[' + b"{}," * 3_000_000 + b'0]"\n}\n'
    )


def array_header(text: bytes) -> bytes:
    """A file of arrays that has none."""
    return struct.pack("<Q", len(text)) + text


def table(data: bytes) -> Callable[[Path], Words]:
    """A table of weights or sliders."""

    def build(folder: Path) -> Words:
        from facepipe.core.reading import read_csv

        (folder / "a.csv").write_bytes(data)
        return lambda: read_csv(folder / "a.csv", 1 << 29)

    return build


def objects(folder: Path) -> Words:
    """JSON of many values."""
    from facepipe.importers.obj import read_landmarks

    (folder / "a.json").write_bytes(b"[" + b"{}," * 3_000_000 + b"0]")
    return lambda: read_landmarks(folder / "a.json", 5)


def packed_view(count: int) -> str:
    """A compressed view that promises `count` elements of 256 bytes."""
    return (
        f'{{"buffer":0,"byteLength":{256 * count},"byteStride":256,"extensions":{{"EXT_meshopt_compression":'
        f'{{"buffer":0,"byteOffset":0,"byteLength":4096,"count":{count},"byteStride":256,"mode":"ATTRIBUTES"}}}}}}'
    )


POINTS = 60_000  # of a document whose data is named again and again: 720 kB


def repeated(change: Callable[[dict[str, Any]], None], words: str = "import gltf a.gltf -o out.usda") -> Any:
    """A command given a document of one mesh of many points, changed; its buffer is a file of points and zeros."""

    def build(folder: Path) -> Words:
        points = np.random.default_rng(0).random((POINTS, 3), dtype=np.float32)
        (folder / "one.bin").write_bytes(
            points.tobytes() + np.arange(POINTS, dtype="<u4").tobytes() + bytes(12 * POINTS)
        )
        parts = ((0, 12 * POINTS), (12 * POINTS, 4 * POINTS), (16 * POINTS, 12 * POINTS))
        document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scenes": [{}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "accessors": [{"type": "VEC3", "componentType": 5126, "count": POINTS, "bufferView": 0}],
            "bufferViews": [{"buffer": 0, "byteOffset": start, "byteLength": size} for start, size in parts],
            "buffers": [{"uri": "one.bin", "byteLength": 28 * POINTS}],
        }
        change(document)
        document["scenes"][0]["nodes"] = list(range(len(document["nodes"])))
        (folder / "a.gltf").write_text(json.dumps(document))
        return words.split()

    return build


def many_buffers(name: str) -> Callable[[dict[str, Any]], None]:
    """Each primitive has a buffer of its own, of a file that all of them name."""

    def change(document: dict[str, Any]) -> None:
        count = 5000
        if name != "one.bin":
            for number in range(count):
                Path(name.format(number)).hardlink_to("one.bin")
        document["buffers"] = [{"uri": name.format(i), "byteLength": 12 * POINTS + i} for i in range(count)]
        document["bufferViews"] = [{"buffer": i, "byteLength": 12 * POINTS} for i in range(count)]
        document["accessors"] = [document["accessors"][0] | {"bufferView": i} for i in range(count)]
        document["meshes"][0]["primitives"] = [{"attributes": {"POSITION": i}} for i in range(count)]

    return change


def many_nodes(count: int) -> Callable[[dict[str, Any]], None]:
    """One mesh that many nodes show."""
    return lambda document: document.update(nodes=[{"mesh": 0}] * count)


def many_targets(count: int, **target: int) -> Callable[[dict[str, Any]], None]:
    """A mesh of many morph targets that move nothing, by sparse data that they share."""

    def change(document: dict[str, Any]) -> None:
        sparse = {"indices": {"bufferView": 1, "componentType": 5125}, "values": {"bufferView": 2}, "count": POINTS}
        document["accessors"].append({"type": "VEC3", "componentType": 5126, "count": POINTS, "sparse": sparse})
        document["meshes"][0]["primitives"][0]["targets"] = [target] * count

    return change


def stage(words: str, repeat: Callable[[Any, int], None], count: int = 3000) -> Callable[[Path], Words]:
    """A command given a face stage in which a prim or an array of 720 kB comes again and again."""

    def build(folder: Path) -> Words:
        from pxr import Sdf, Usd, UsdGeom, UsdSkel, Vt

        (folder / "a.usdc").unlink(missing_ok=True)
        made = Usd.Stage.CreateNew("a.usdc")
        face = UsdSkel.Root.Define(made, "/F").GetPrim()
        made.SetDefaultPrim(face)
        UsdGeom.SetStageUpAxis(made, UsdGeom.Tokens.y)
        face.SetMetadata("apiSchemas", Sdf.TokenListOp.Create(prependedItems=["FacepipeFaceAPI"]))
        UsdSkel.Skeleton.Define(made, "/F/Skeleton")
        points = Vt.Vec3fArray.FromNumpy(np.random.default_rng(0).random((POINTS, 3), dtype=np.float32))
        source = UsdGeom.Mesh.Define(made, "/Source/Mesh")
        source.CreatePointsAttr(points)
        source.CreateFaceVertexCountsAttr([3])
        source.CreateFaceVertexIndicesAttr([0, 1, 2])
        shape = UsdSkel.BlendShape.Define(made, "/Source/Shape")
        shape.CreateOffsetsAttr(points)
        shape.CreatePointIndicesAttr(list(range(POINTS)))
        for number in range(count):
            repeat(made, number)
        made.Save()
        return words.split()

    return build


def refer(path: str, instanceable: bool = False) -> Callable[[Any, int], None]:
    """A prim of the face refers to another."""

    def repeat(made: Any, number: int) -> None:
        prim = made.DefinePrim(f"/F/p{number}")
        prim.GetReferences().AddInternalReference(path)
        prim.SetInstanceable(instanceable)

    return repeat


def same_points(made: Any, number: int) -> None:
    """A mesh of the face has points that another has: the file holds them once."""
    from pxr import UsdGeom

    source, mesh = made.GetPrimAtPath("/Source/Mesh"), UsdGeom.Mesh.Define(made, f"/F/p{number}")
    for name in ("points", "faceVertexCounts", "faceVertexIndices"):
        mesh.GetPrim().GetAttribute(name).Set(source.GetAttribute(name).Get())


def many_packed_views(document: dict[str, Any]) -> None:
    """Primitives whose indices are all packed in the same bytes."""
    count, packed = 40, 300_000
    Path("one.bin").write_bytes(Path("one.bin").read_bytes() + b"\xd1" + bytes(packed + 4))
    document["buffers"][0]["byteLength"] += packed + 5
    where = {"buffer": 0, "byteOffset": 28 * POINTS, "byteLength": packed + 5}
    extension = where | {"count": packed, "byteStride": 2, "mode": "INDICES"}
    view = {"buffer": 0, "byteLength": 2 * packed, "extensions": {"EXT_meshopt_compression": extension}}
    document["bufferViews"] += [view] * count
    indices = {"type": "SCALAR", "componentType": 5123, "count": packed}
    document["accessors"] += [indices | {"bufferView": 3 + i} for i in range(count)]
    document["meshes"][0]["primitives"] = [{"attributes": {"POSITION": 0}, "indices": 1 + i} for i in range(count)]


def many_accessors(document: dict[str, Any]) -> None:
    """Accessors of the same bytes."""
    document["accessors"] *= 20_000


IMPORT = "import gltf a.glb -o out.usda"
GROUPS: dict[str, dict[str, tuple[Callable[[Path], Words], str]]] = {
    "npz": {
        "one array": (ict(uv=("<f4", (50_000_000, 2))), "a.npz: arrays of 40"),
        "many arrays": (
            ict(uv=("<f8", (3_000_000, 2)), material_names=("<U800", (10_000,))),
            "a.npz: arrays of 8",
        ),
        "names": (ict(material_names=("<U1", (5_000_000,))), "5000000 texts, expected at most 100000"),
        "members": (many_members, "directory of"),
    },
    "pipes": {
        f"{command}: {kind}{suffix}": (pipe(command, suffix, kind), f"{kind}{suffix}: is not a regular file")
        for suffix, commands in PIPES.items()
        for command in commands
        for kind in ("pipe", "link", "zero")
    }
    | {
        "a buffer": (
            naming_pipe(
                "import gltf a.gltf -o out.usda",
                "a.gltf",
                '{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],'
                '"meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}],'
                '"accessors":[{"type":"VEC3","componentType":5126,"count":3,"bufferView":0}],'
                '"bufferViews":[{"buffer":0,"byteLength":36}],"buffers":[{"byteLength":36,"uri":"pipe"}]}',
            ),
            "is not a regular file",
        ),
        "/proc": (reading("landmarks", "/proc/self/pagemap"), "is not JSON"),
        "a name with NUL": (lambda folder: ["inspect", "a\0.usda"], "no such file"),
    }
    | {f"{name} of a pipe": (reading(name, "pipe"), "regular file") for name in ("landmarks", "digest", "GLB", "npz")},
    "onnx": {
        "numbers": (deformer("weights", 26), "numbers in an evaluation, expected at most 6"),
        "whole numbers": (deformer("whole", 14), "whole numbers in an evaluation"),
        "nodes": (deformer("weights", 0, 50_000), "nodes, expected at most 10000"),
    },
    "texts": {
        "zeros of an accessor": (
            written(IMPORT, "a.glb", lambda: gltf('"count":100000000')),
            "more data than it holds",
        ),
        "a sparse accessor": (
            written(
                IMPORT,
                "a.glb",
                lambda: gltf(
                    '"count":2147483648,"sparse":{"count":1,"indices":{"bufferView":0,"componentType":5121},'
                    '"values":{"bufferView":0}}',
                    '{"buffer":0,"byteLength":12}',
                    12,
                ),
            ),
            "more data than it holds",
        ),
        "a compressed view": (
            written(IMPORT, "a.glb", lambda: gltf('"count":3,"bufferView":0', packed_view(1 << 24), 4096)),
            "more data than it holds",
        ),
        "objects of a document": (
            written(IMPORT, "a.glb", lambda: gltf('"count":3,"extras":[' + "{}," * 3_000_000 + "0]")),
            "more than 3000000 values",
        ),
        "depth of a document": (
            written(IMPORT, "a.glb", lambda: gltf('"count":3,"extras":' + "[" * 100_000)),
            "nested too deeply",
        ),
        "the options of a recipe": (
            written("cook a.usda", "a.usda", options_of_a_recipe),
            "more than 3000000 values",
        ),
        "objects": (objects, "more than 3000000 values"),
        "the header of a database": (
            written("database info a.fpdb", "a.fpdb", lambda: array_header(b'{"a":[' + b"{}," * 3_000_000 + b"0]}")),
            "more than 3000000 values",
        ),
        "a long key": (
            written("rebuild a.toml -o out.usda", "a.toml", lambda: b"a." * 50_000 + b"a = 1"),
            "more than 100 dotted keys",
        ),
        "a long key of numbers": (
            written("rebuild a.toml -o out.usda", "a.toml", lambda: b"x = 1\n" + b"1 . " * 50_000 + b"1 = 1"),
            "more than 100 dotted keys",
        ),
        "depth of a table": (
            written("rebuild a.toml -o out.usda", "a.toml", lambda: b"a = " + b"[" * 100_000),
            "is not TOML",
        ),
        "a payload": (payload, "14000 frames of 1000 joints, expected 1"),
    },
    "repeated": {
        "buffers of one file": (repeated(many_buffers("one.bin")), "more data than it holds"),
        "links to one file": (repeated(many_buffers("{}.bin")), "more data than it holds"),
        "instances": (repeated(many_nodes(3000)), "more data than it holds"),
        "meshes": (repeated(many_nodes(5000)), "5000 prims of type Mesh, expected at most 4096"),
        "targets": (repeated(many_targets(20_000)), "20000 prims of type BlendShape, expected at most 10000"),
        "sparse targets": (repeated(many_targets(2000, POSITION=1)), "more data than it holds"),
        "packed views": (repeated(many_packed_views), "more data than it holds"),
        "accessors to check": (repeated(many_accessors, "validate a.gltf"), "more numbers to check"),
    },
    "stages": {
        "references to a mesh": (stage("inspect a.usdc", refer("/Source/Mesh")), "more data than it holds"),
        "instances of a mesh": (stage("import usd a.usdc -o out.usda", refer("/Source", True)), "more data than it"),
        "references to a shape": (stage("validate a.usdc", refer("/Source/Shape")), "more data than it holds"),
        "equal points": (stage("export a.usdc -o out.glb", same_points, 1000), "more data than it holds"),
        "meshes": (stage("inspect a.usdc", refer("/Source/Mesh"), 4097), "4097 prims of type Mesh"),
    },
    "tables": {
        "columns": (table(b"a," * 5000 + b"a\n" + b"0," * 5000 + b"0\n"), "line 1: more than 4096 columns"),
        "rows": (table(b"a\n" * (1 << 21)), "line 1048577: over 1048576 rows"),
    },
    "pictures": {
        "gigapixels": (photo(lambda: png(60_000, 60_000, 8, 2, bytes(99))), "exceeds limit"),
        "a PNG of zeros": (photo(lambda: flat_png(6000, 8, 6, 4)), "x 6000 pixels in"),
        "a map of zeros": (region_map(lambda: flat_png(6000, 16, 0, 1)), "x 6000 pixels in"),
        "a texture of zeros": (texture(lambda: flat_png(6000, 8, 2, 3)), "x 6000 pixels in"),
        "BMP": (texture(lambda: promising("BMP", 13_000)), "x 13000 pixels in"),
        "TIFF": (photo(lambda: promising("TIFF", 13_000)), "x 13000 pixels in"),
        "texts": (photo(lambda: with_chunks(b"tEXt", b"a\0b", 200_000)), "more than 1000 chunks"),
        "profile": (photo(lambda: with_chunks(b"iCCP", b"a\0\0" + deflated(1 << 28), 1)), "too large"),
        "scans": (photo(lambda: scans(1000)), "more than 100 scans"),
        "segments": (texture(lambda: segments(1_000_000)), "more than 1000 segments"),
    },
}
GROUPS |= {"one of each": {name: next(iter(bombs.values())) for name, bombs in GROUPS.items()}}


def run(words: Words) -> int:
    """The exit code of a command, or of a reader as a command would have it."""
    from facepipe.cli import main as command
    from facepipe.core.errors import FacepipeError

    if not callable(words):
        return command(words)
    try:
        words()
    except FacepipeError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _peak() -> int:
    """Bytes that this process has held at most: of its own, where getrusage counts those of its parent before exec."""
    (line,) = re.findall(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return int(line) * 1024


def main(group: str) -> None:
    """Run the bombs of a group."""
    results: list[dict[str, Any]] = []
    started = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (started + _OVER, started + _OVER))
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        for bomb, (build, expected) in GROUPS[group].items():
            words = build(Path(name))
            err, begun = io.StringIO(), time.perf_counter()
            with contextlib.redirect_stderr(err), contextlib.redirect_stdout(io.StringIO()):
                code = run(words)
            results.append(
                {
                    "bomb": bomb,
                    "code": code,
                    "error": err.getvalue(),
                    "expected": expected,
                    "seconds": round(time.perf_counter() - begun, 2),
                    "peak": _peak(),
                }
            )
    print(json.dumps(results))


if __name__ == "__main__":
    main(sys.argv[1])
