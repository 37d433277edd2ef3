"""Folders as somebody sends them who wants to read, write or run what is not theirs; and what a victim does there."""

from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
import shutil
import stat
import struct
import zipfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import fbx_files
import numpy as np
from command_line import exit_code
from PIL import Image
from pxr import Sdf, Usd
from trespass import trespassing

from facepipe.cli import main
from facepipe.core import __version__
from facepipe.parts import FaceParts, Recipe
from facepipe.stage import save_parts

KEY = ".facepipe-0123456789abcdef"  # a name of the folders that are settled
OWN = "@./face_textures/skin.png@"

# what victims do with a stage
SHOW = (("inspect", "face.usda"), ("validate", "face.usda"))
EXPORT = (("export", "face.usda", "-o", "out.glb", "--force"), ("export", "face.usda", "-o", "out.onnx", "--force"))
FLAT = tuple(
    ("regions", "face.usda", "--map", "map.png", "--legend", "legend.json", "-o", out, "--flatten", "--force")
    for out in ("flat.usda", "flat.usdz")
)
COPY = (("import", "usd", "face.usda", "copy.usda", "--force"), ("sliders", "face.usda"))
COOK = (("cook", "mix.usda"), ("cook", "mix.usda", "--force"), ("blend", "--edit", "mix.usda", "--force"))
BATCH = (("batch", "show.toml", "--processes", "1", "--thumbnails", "0", "-q"),)
REBUILD = (("rebuild", "project.toml", "-o", "actor.usda", "--force"),)


class Payload:
    """A pickle that writes a file as it is loaded."""

    def __init__(self, file: Path) -> None:
        self._file = str(file)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self._file,)


@dataclass(frozen=True)
class World:
    """Where it happens: the victim's own files, the folder that was sent, and a file that is there once code ran."""

    top: Path

    @property
    def private(self) -> Path:
        """Of the victim."""
        return self.top / "private"

    @property
    def sent(self) -> Path:
        """The hostile folder, in which the victim works."""
        return self.top / "sent"

    @property
    def ran(self) -> Path:
        """There once a payload ran."""
        return self.top / "ran"

    @property
    def pickled(self) -> bytes:
        """A payload as a pickle."""
        return pickle.dumps(Payload(self.ran))

    def settle(self, stock: Path) -> None:
        """Make it, with the good files of `make_stock`."""
        shutil.copytree(stock, self.sent)
        self.private.mkdir()
        (self.private / "photo.png").write_bytes(noise())
        (self.private / "notes.txt").write_text("{private: notes}\n")
        (self.private / "points.bin").write_bytes(np.random.default_rng(3).bytes(64))

    @property
    def archive(self) -> bytes:
        """A payload as torch and numpy keep them: archives of pickles."""
        data = io.BytesIO()
        with zipfile.ZipFile(data, "w") as archive:
            for name in ("archive/data.pkl", "data.pkl", "archive/data/weights/model.pt"):
                archive.writestr(name, self.pickled)
            archive.writestr("archive/version", "3")
            archive.writestr("values.npy", _object_array(self.pickled))
        return data.getvalue()

    def outside(self) -> dict[str, str]:
        """The state of all that is not in the folder that was sent."""
        return {
            str(path.relative_to(self.top)): _digest(path) for path in _below(self.top) if self.sent not in path.parents
        }

    def brought(self) -> list[str]:
        """Files in the folder that was sent with something of the victim's."""
        secrets = [pixels_of(noise()), b"private: notes", (self.private / "points.bin").read_bytes()[:36]]
        plain = [one for one in _below(self.sent) if one.is_file() and not one.is_symlink()]
        return [one.name for one in plain if any(secret in one.read_bytes() for secret in secrets)]


def _below(folder: Path) -> Iterator[Path]:
    for parent, folders, names in os.walk(folder):
        yield from (Path(parent, name) for name in (*folders, *names))


def _digest(path: Path) -> str:
    state = path.lstat()
    content = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() and not path.is_symlink() else ""
    return f"{state.st_mode} {content}"


@dataclass(frozen=True)
class Hostile:
    """One folder."""

    name: str  # what reads, which field of it: how that leads out
    make: Callable[[World], object]
    lines: tuple[tuple[str, ...], ...]
    refused: bool = True  # by the first line at least; else it may be of no harm
    said: str = ""  # by the first line
    reads: bool = False  # what is elsewhere, as USD composes it, or as the victim names it by a link


def harm(hostile: Hostile, world: World, more: tuple[str, ...]) -> list[str]:
    """What its lines do that they should not; the world has the folder in it, and is where they run.

    :param more: words that are added to each line
    """
    before, found = world.outside(), []
    closed = (world.private, *map(Path, ("/etc/passwd", "/etc/x", "/etc/hostname", "/dev/zero")))
    for number, line in enumerate(hostile.lines):
        errors, printed = io.StringIO(), io.StringIO()
        with trespassing(*closed) as done, redirect_stderr(errors), redirect_stdout(printed):
            code = exit_code(*line, *more)
        said = [one for one in errors.getvalue().splitlines() if not one.startswith("facepipe: warning: ")]
        wrong = {
            "code ran": world.ran.exists() or Path("ran").exists(),
            "changed outside": world.outside() != before,
            f"brought {world.brought()}": bool(world.brought()),
            f"did {done}": bool(done) and not hostile.reads,
            f"not said: {hostile.said}": number == 0 and hostile.said not in printed.getvalue() + errors.getvalue(),
            f"exit code {code}": code not in (_refusals(line) if hostile.refused and number == 0 else (0, 1, 2)),
            f"said {said}": len(said) != (code == 2) or not all(map(str.isprintable, said)),
        }
        found += [f"{' '.join(line)}: {what}" for what, is_so in wrong.items() if is_so]
    return found


def _refusals(line: tuple[str, ...]) -> tuple[int, ...]:
    return (2,) if line[0] == "batch" else (1, 2)  # a batch ends with 1 where a task alone is refused


def noise(size: int = 16) -> bytes:
    """A PNG that its pixels identify."""
    data = io.BytesIO()
    Image.fromarray(np.random.default_rng(7).integers(0, 256, (size, size, 3), np.uint8)).save(data, "PNG")
    return data.getvalue()


def pixels_of(png: bytes) -> bytes:
    """A part of it that copies hold too."""
    return png[png.index(b"IDAT") + 16 : png.index(b"IDAT") + 80]


def make_stock(folder: Path, parts: FaceParts, faces: tuple[FaceParts, FaceParts]) -> None:
    """Good files that hostile ones are made of, in `folder`: face.usda, and mix.usda of a.usda and b.usda."""
    save_parts(parts, folder / "face.usda")
    for name, face in zip("ab", faces, strict=True):
        save_parts(face, folder / f"{name}.usda")
    assert main(["blend", str(folder / "a.usda"), str(folder / "b.usda"), "-o", str(folder / "mix.usda")]) == 0
    Image.new("RGB", (4, 4), (255, 0, 0)).save(folder / "map.png")
    (folder / "legend.json").write_text('{"#ff0000": "lips"}')


# what is changed


def textured(image: str) -> Callable[[World], object]:
    """The face's texture is `image`; {top} stands for the folder around."""
    return lambda world: _replace(world.sent / "face.usda", OWN, f"@{image.format(top=world.top)}@")


def over(text: str) -> Callable[[World], object]:
    """face.usda is a layer of its own with `text` as its metadata and prims."""
    return lambda world: (world.sent / "face.usda").write_text(f"#usda 1.0\n{text.replace('{top}', str(world.top))}\n")


def linked(name: str, target: str) -> Callable[[World], object]:
    """`name` is a link to `target`."""

    def make(world: World) -> None:
        path = world.sent / name
        path.parent.mkdir(exist_ok=True)
        path.unlink(missing_ok=True)
        path.symlink_to(target.format(top=world.top))

    return make


def both(*makes: Callable[[World], object]) -> Callable[[World], object]:
    """One after another."""

    def make(world: World) -> None:
        for one in makes:
            one(world)

    return make


def file(name: str, content: str | bytes) -> Callable[[World], object]:
    """A file; {top} in texts as in `textured`."""

    def make(world: World) -> None:
        path = world.sent / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.replace("{top}", str(world.top)).encode())

    return make


def stale(world: World) -> None:
    """What mix.usda is made of has changed."""
    shutil.copy(world.sent / "b.usda", world.sent / "a.usda")


def recipe(verb: str = "blend", sources: tuple[str, ...] = (), **options: Any) -> Callable[[World], object]:
    """mix.usda has another recipe."""

    def make(world: World) -> None:
        named = tuple(source.format(top=world.top) for source in sources)
        digests = ("sha256:0",) * len(named)
        made = Recipe(verb=verb, sources=named, digests=digests, options=options, version=__version__)
        path = world.sent / "mix.usda"
        from facepipe.stage import open_face

        save_parts(replace(open_face(world.sent / "a.usda").parts(), recipe=made), path)

    return make


def fitted(model: str) -> Callable[[World], object]:
    """mix.usda is a photo fit with a model."""
    files = {"photos": ["./map.png"], "landmarks": [None], "files": {"identity_model": model}}
    options = {"faces": [None], "expressions": None, "landmark_threshold": 8.0, "fit": {}}
    return recipe("fit-photo", ("./a.usda", "./map.png", model), **files, options=options)


def archive(name: str) -> Callable[[World], object]:
    """A file with a payload."""
    return lambda world: (world.sent / name).write_bytes(world.archive)


def journal(folders: list[str], moves: list[Any]) -> Callable[[World], object]:
    """A folder as one that was killed leaves it, with files to be put in place."""
    text = json.dumps({"folders": folders, "moves": moves})
    return both(
        stale,
        file(f"{KEY}/.facepipe-journal", text),
        file(f"{KEY}/notes.txt", "mine"),
        file(f"{KEY}/.facepipe-lock", ""),
    )


def gltf(buffer: str = "", image: str = "") -> Callable[[World], object]:
    """face.gltf, of one triangle."""
    points = np.eye(3, dtype=np.float32).tobytes()

    def make(world: World) -> None:
        (world.sent / "own.bin").write_bytes(points)
        uri = buffer.format(top=world.top) or "own.bin"
        material: dict[str, Any] = {
            "images": [{"uri": image.format(top=world.top)}],
            "textures": [{"source": 0}],
            "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        }
        document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "buffers": [{"byteLength": 36, "uri": uri}],
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
            "accessors": [
                {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]}
            ],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, **({"material": 0} if image else {})}]}],
            "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}],
            "scene": 0,
        } | (material if image else {})
        (world.sent / "face.gltf").write_text(json.dumps(document))

    return make


def obj(library: str, texture: str = "own.png") -> Callable[[World], object]:
    """neutral.obj with a material."""
    text = f"mtllib {library}\nusemtl skin\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    return both(
        file("shapes/neutral.obj", text),
        file("shapes/face.mtl", f"newmtl skin\nmap_Kd {texture}\n"),
        file("shapes/own.png", noise(2)),
    )


def fbx(picture: str) -> Callable[[World], object]:
    """face.fbx with a picture elsewhere."""

    def make(world: World) -> None:
        scene = fbx_files.Scene()
        model = scene.model("Head", of="Mesh")
        scene.mesh(model, np.eye(3), [[0, 1, 2]])
        scene.texture(scene.material(model, "skin"), "DiffuseColor", picture.format(top=world.top))
        (world.sent / "face.fbx").write_bytes(scene.binary())

    return make


def onnx(location: str, *, node: bool = False) -> Callable[[World], object]:
    """net.onnx with its data in another file."""

    def make(world: World) -> None:
        import onnx as library

        helper, kinds = library.helper, library.TensorProto
        tensor = helper.make_tensor("w", kinds.FLOAT, [4], [0.0] * 4)
        tensor.ClearField("float_data")
        tensor.data_location = kinds.EXTERNAL
        entry = tensor.external_data.add()
        entry.key, entry.value = "location", location.format(top=world.top)
        nodes = [helper.make_node("Add", ["x", "w"], ["y"])]
        nodes = [helper.make_node("Constant", [], ["w"], value=tensor), *nodes] if node else nodes
        x, y = (helper.make_tensor_value_info(name, kinds.FLOAT, [4]) for name in "xy")
        graph = helper.make_graph(nodes, "g", [x], [y], [] if node else [tensor])
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 15)])
        (world.sent / "net.onnx").write_bytes(model.SerializeToString())

    return make


def plan(faces: str, run: str = "export {face}", out: str = "built") -> Callable[[World], object]:
    """show.toml, of one step."""
    text = f'out = "{out}"\n[faces]\n{faces}\n[steps.game]\nrun = "{run}"\nout = "{{name}}.glb"\n'
    return file("show.toml", text)


def ledger(**said: Any) -> Callable[[World], object]:
    """A plan for a.usda, and what its ledger says of the task: that it is done."""

    def make(world: World) -> None:
        plan('glob = "a.usda"')(world)
        file("built/a.glb", "planted")(world)
        states = {name: (world.sent / name).stat() for name in ("a.usda", "built/a.glb")}
        source, result = ([one.st_size, one.st_mtime_ns] for one in states.values())
        record = {"task": "game/a", "status": "made", "version": __version__, "key": "0", "seconds": 1.0}
        record["words"] = ["export", "a.usda", "-o", "built/a.glb"]
        record["reads"] = {"a.usda": source, **said.get("reads", {})}
        record["writes"] = {"built/a.glb": [result, "sha256:0"], **said.get("writes", {})}
        record |= {key: value for key, value in said.items() if key not in ("reads", "writes")}
        file("show_batch/tasks.jsonl", f"{json.dumps(record)}\n")(world)

    return make


def package(*names: str, link: bool = False) -> Callable[[World], object]:
    """face.usdz with entries of odd names, or one that unpacks to a link."""

    def make(world: World) -> None:
        Sdf.Layer.FindOrOpen(str(world.sent / "face.usda")).Export(str(world.top / "root.usdc"))
        with Sdf.ZipFileWriter.CreateNew(str(world.sent / "face.usdz")) as made:
            made.AddFile(str(world.top / "root.usdc"), "face.usdc")
            for name in names:
                made.AddFile(str(world.sent / "map.png"), name)
        if link:
            entry = zipfile.ZipInfo("link.png")
            entry.external_attr = (stat.S_IFLNK | 0o777) << 16
            with zipfile.ZipFile(world.sent / "face.usdz", "a") as made:
                made.writestr(entry, "../private/photo.png")
        (world.top / "root.usdc").unlink()
        (world.sent / "face.usda").unlink()

    return make


def sampled(world: World) -> None:
    """The texture is given over time."""
    samples = f"inputs:file.timeSamples = {{0: @{world.private}/photo.png@}}"
    _replace(world.sent / "face.usda", f"inputs:file = {OWN}", samples)


def interface(world: World) -> None:
    """The texture is named by the material, to which the shader is connected."""
    path = world.sent / "face.usda"
    stage = Usd.Stage.Open(str(path))
    shader = next(one for one in stage.Traverse() if one.GetAttribute("inputs:file"))
    material = shader.GetParent()
    material.CreateAttribute("inputs:map", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(f"{world.private}/photo.png"))
    shader.GetAttribute("inputs:file").AddConnection(material.GetPath().AppendProperty("inputs:map"))
    stage.Save()


def packed_beside(world: World) -> None:
    """A package whose layer names files around it."""
    textured("{top}/private/photo.png")(world)
    package()(world)


def hard_link(world: World) -> None:
    """The result is another name of a file of the victim's."""
    stale(world)
    shutil.copy(world.sent / "mix.usda", world.private / "mix.usda")
    (world.sent / "mix.usda").unlink()
    os.link(world.private / "mix.usda", world.sent / "mix.usda")


def elsewhere(make: Callable[[World], object], home: str = "private") -> Callable[[World], object]:
    """What `make` makes, with a stale result in the victim's folder below it."""

    def made(world: World) -> None:
        for name in ("a.usda", "b.usda", "mix.usda"):
            shutil.copy(world.sent / name, world.top / home / name)
        shutil.copy(world.sent / "b.usda", world.top / home / "a.usda")
        make(world)

    return made


def _replace(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def _object_array(pickled: bytes) -> bytes:
    head = b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }"
    head += b" " * (-(len(head) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + pickled
