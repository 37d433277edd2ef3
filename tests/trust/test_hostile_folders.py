"""Folders of others, and what people do in them: no code runs, nothing outside is written or brought along."""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import exit_code
from full_faces import full_face
from hostile_folders import (
    COOK,
    COPY,
    EXPORT,
    FLAT,
    KEY,
    REBUILD,
    SHOW,
    Hostile,
    Payload,
    World,
    archive,
    both,
    elsewhere,
    file,
    fitted,
    gltf,
    hard_link,
    interface,
    journal,
    linked,
    make_stock,
    noise,
    obj,
    onnx,
    over,
    package,
    packed_beside,
    pixels_of,
    recipe,
    sampled,
    stale,
    textured,
)
from hostile_sources import SOURCES
from small_sources import made

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="links and pipes need rights there")

Capsys = pytest.CaptureFixture[str]
TEXTURES = (*EXPORT[:1], *FLAT, ("inspect", "face.usda"), *COPY)
PACKED = tuple(tuple("face.usdz" if word == "face.usda" else word for word in line) for line in TEXTURES)
GLTF = (("import", "gltf", "face.gltf", "copy.usda", "--force"), ("validate", "face.gltf"))
OBJ = (("import", "obj", "shapes", "copy.usda", "--force"),)
RIG = (("neural-rig", "apply", "face.usda", "rig.fpnr", "-o", "rigged.usda"),)
NET = (("validate", "net.onnx"), ("eval", "net.onnx", "-o", "points.npz"))
PROJECT = 'template = "a.usda"\ndatabase = "mix.usda"\nwork = "{}"\n[neutral]\nscan = "b.usda"\n'
LAYER = '(\n    defaultPrim = "Tiny"\n    subLayers = [@{}@, @./face2.usda@]\n)'


def _layer(name: str) -> str:
    return LAYER.replace("{}", name)


def _device(world: World) -> None:
    os.mkfifo(world.sent / "pipe")


def _inside(world: World) -> None:
    (world.sent / "pipe").rename(world.sent / "shapes" / "pipe")


HOSTILE = (
    # recipes that name code
    Hostile("recipe of a model with code", both(fitted("./net.pt2"), archive("net.pt2")), COOK),
    Hostile("recipe of a model with code elsewhere", both(fitted("../sent/net.pt2"), archive("net.pt2")), COOK),
    Hostile("recipe of a pickle", both(fitted("./net.pkl"), archive("net.pkl")), COOK),
    Hostile(
        "recipe of a link to code", both(fitted("./net.onnx"), archive("net.pt2"), linked("net.onnx", "net.pt2")), COOK
    ),
    Hostile("recipe of code called ONNX", both(fitted("./net.onnx"), archive("net.onnx")), COOK),
    Hostile("recipe of an unknown verb", recipe("python -c", ("./a.usda",)), COOK),
    Hostile("recipe of a shell", recipe("$(touch ran)", ("./a.usda", "$(touch ran)", "| touch ran")), COOK),
    # recipes that lead elsewhere
    Hostile("recipe of text of the victim's", recipe("blend", ("../private/notes.txt", "./b.usda")), COOK),
    Hostile("recipe of a pipe", both(_device, recipe("blend", ("./pipe", "./b.usda"))), COOK),
    Hostile("recipe of a device", recipe("blend", ("/dev/zero", "./b.usda")), COOK),
    Hostile("recipe of itself", recipe("blend", ("./mix.usda", "./mix.usda")), COOK),
    Hostile("recipe of a name in two lines", recipe("blend", ("./a\nb.usda", "\x1b[31m./c.usda")), COOK),
    Hostile(
        "result below, elsewhere", elsewhere(file("mix.usda", f"#usda 1.0\n{_layer('{top}/private/mix.usda')}")), COOK
    ),
    Hostile(
        "result below, two up", elsewhere(file("mix.usda", f"#usda 1.0\n{_layer('./x/../../private/mix.usda')}")), COOK
    ),
    Hostile(
        "result below, by a linked folder",
        elsewhere(both(linked("lib", "../private"), file("mix.usda", f"#usda 1.0\n{_layer('./lib/mix.usda')}"))),
        COOK,
    ),
    Hostile("result that is a link", elsewhere(both(stale, linked("mix.usda", "../private/mix.usda"))), COOK),
    Hostile(
        "result that is a chain of links",
        elsewhere(both(stale, linked("one.usda", "../private/mix.usda"), linked("mix.usda", "one.usda"))),
        COOK,
    ),
    Hostile("result that is a hard link", hard_link, COOK, refused=False),
    Hostile("result that is a link to nothing", linked("mix.usda", "../private/new.usda"), COOK),
    # what helps in writing
    Hostile("lock that is a link", both(stale, linked(".mix.usda.lock", "../private/notes.txt")), COOK),
    Hostile("lock that is a link to nothing", both(stale, linked(".mix.usda.lock", "../private/new")), COOK),
    Hostile(
        "lock that is a pipe",
        both(stale, lambda world: os.mkfifo(world.sent / ".mix.usda.lock")),
        COOK,
        refused=False,
    ),
    Hostile(
        "journal that writes above", journal(["."], [[0, "../private/notes.txt", None, "main"]]), COOK, refused=False
    ),
    Hostile(
        "journal of another folder", journal(["../private"], [[0, "notes.txt", None, "main"]]), COOK, refused=False
    ),
    Hostile("journal of an absolute folder", journal(["/etc"], [[0, "hostname", None, "stale"]]), COOK, refused=False),
    Hostile(
        "journal by a linked folder",
        both(journal(["lib"], [[0, "notes.txt", None, "main"]]), linked("lib", "../private")),
        COOK,
        refused=False,
    ),
    Hostile("passing folder that is a link", both(stale, linked(KEY, "../private")), COOK, refused=False),
    Hostile(
        "passing folder full of links",
        both(
            stale,
            file(f"{KEY}/.facepipe-lock", ""),
            linked(f"{KEY}/x", "../../private"),
            linked(f"{KEY}/.facepipe-former", "../../private"),
        ),
        COOK,
        refused=False,
    ),
    Hostile(
        "passing folder joined to another",
        both(stale, file(f"{KEY}/.facepipe-joined", "../private")),
        COOK,
        refused=False,
    ),
    Hostile("output that is a link", both(linked("out.glb", "../private/notes.txt")), EXPORT[:1]),
    Hostile("output that is a link to nothing", both(linked("out.glb", "../private/new.glb")), EXPORT[:1]),
    Hostile("sidecar that is a link", both(linked("out.onnx.json", "../private/notes.txt")), EXPORT[1:]),
    Hostile("textures go to a link", linked("flat_textures", "../private"), FLAT[:1]),
    # projects
    Hostile("project that works above", file("project.toml", PROJECT.format("../private")), REBUILD),
    Hostile(
        "project that works at an absolute path", file("project.toml", PROJECT.format("{top}/private/new")), REBUILD
    ),
    Hostile(
        "project that works in a link",
        both(linked("work", "../private"), file("project.toml", PROJECT.format("work"))),
        REBUILD,
    ),
    Hostile("project that works in two lines", file("project.toml", PROJECT.format("../pri\\nvate")), REBUILD),
    Hostile(
        "project of pipes",
        both(_device, file("project.toml", PROJECT.format("work").replace("b.usda", "pipe"))),
        REBUILD,
    ),
    Hostile(
        "recipe of a project that works above",
        both(
            file("project.toml", PROJECT.format("../private")),
            recipe("rebuild", ("./project.toml", "./a.usda"), project="./project.toml", joint=False),
        ),
        COOK,
    ),
    # layers
    Hostile("sublayer that is text of the victim's", over(_layer("../private/notes.txt")), (*SHOW, *EXPORT, *FLAT)),
    Hostile("sublayer that is a pipe", both(_device, over(_layer("./pipe"))), (*SHOW, *EXPORT[:1], *COOK[:1])),
    Hostile("sublayer that is a device", over(_layer("/dev/zero")), SHOW),
    Hostile("sublayer that is a linked pipe", both(_device, linked("x.usda", "pipe"), over(_layer("./x.usda"))), SHOW),
    Hostile("sublayer that is no file", over(_layer("../private")), (*SHOW, *EXPORT, *FLAT)),
    Hostile(
        "reference in a circle", over('(defaultPrim = "A")\ndef "A" (references = @./face.usda@) {}'), (*SHOW, *EXPORT)
    ),
    # textures
    Hostile("texture of the victim's", textured("{top}/private/photo.png"), TEXTURES),
    Hostile("texture above", textured("../private/photo.png"), TEXTURES),
    Hostile(
        "texture that is a link", both(linked("skin.png", "../private/photo.png"), textured("./skin.png")), TEXTURES
    ),
    Hostile(
        "texture that is a chain of links",
        both(
            linked("a.png", "../private/photo.png"),
            linked("b.png", "a.png"),
            linked("c.png", "b.png"),
            textured("c.png"),
        ),
        TEXTURES,
    ),
    Hostile(
        "texture in a linked folder",
        both(linked("face_textures2", "../private"), textured("./face_textures2/photo.png")),
        TEXTURES,
    ),
    Hostile("texture that is a password file", textured("/etc/passwd"), TEXTURES[:1]),
    Hostile("texture that is a pipe", both(_device, textured("./pipe")), (*TEXTURES, ("validate", "face.usda"))),
    Hostile("texture that is a device", textured("/dev/zero"), (*TEXTURES, ("validate", "face.usda"))),
    Hostile("texture of a name in two lines", textured("./\\n\x1b[2Ja.png"), TEXTURES[:1]),
    Hostile("texture over time", sampled, TEXTURES[1:3]),
    Hostile("texture that the material names", interface, TEXTURES),
    Hostile("texture that an expression names", textured('`"{top}/private/photo.png"`'), TEXTURES[:1]),
    Hostile(
        "project file that is a folder",
        both(file("../facepipe.toml/x", ""), textured("../private/photo.png")),
        TEXTURES,
    ),
    Hostile(
        "project file that widens",
        both(file("facepipe.toml", 'roots = ["/"]'), textured("../private/photo.png")),
        TEXTURES,
    ),
    Hostile(
        "project file that is a link", both(linked("facepipe.toml", "/"), textured("../private/photo.png")), TEXTURES
    ),
    # packages
    Hostile("package that names what is around it", packed_beside, PACKED),
    Hostile(
        "package with entries above",
        package("../private/photo.png", "../../above.png", "/etc/x"),
        PACKED,
        refused=False,
    ),
    Hostile("package with a link", package(link=True), PACKED, refused=False),
    # glTF, OBJ
    Hostile("buffer above", gltf(buffer="../private/points.bin"), GLTF),
    Hostile("buffer above, encoded", gltf(buffer="%2e%2e/private/points.bin"), GLTF),
    Hostile("buffer at an absolute path", gltf(buffer="{top}/private/points.bin"), GLTF),
    Hostile("buffer by its URL", gltf(buffer="file://{top}/private/points.bin"), GLTF),
    Hostile("buffer that is a link", both(gltf(buffer="b.bin"), linked("b.bin", "../private/points.bin")), GLTF),
    Hostile("buffer that is a pipe", both(_device, gltf(buffer="pipe")), GLTF),
    Hostile("image above", gltf(image="../private/photo.png"), GLTF[:1]),
    Hostile("image by its URL", gltf(image="file://{top}/private/photo.png"), GLTF[:1]),
    Hostile("image that is a link", both(gltf(image="a.png"), linked("a.png", "../private/photo.png")), GLTF[:1]),
    Hostile("map above", obj("face.mtl", "../../private/photo.png"), OBJ),
    Hostile("map at an absolute path", obj("face.mtl", "/etc/passwd"), OBJ),
    Hostile(
        "map that is a link", both(obj("face.mtl", "a.png"), linked("shapes/a.png", "../../private/photo.png")), OBJ
    ),
    Hostile("library above", obj("../../private/notes.txt"), OBJ),
    Hostile("library that is a pipe", both(_device, obj("pipe"), _inside), OBJ, refused=False),
    # networks and arrays
    Hostile("network with its data above", onnx("../private/points.bin"), NET),
    Hostile("network with its data at an absolute path", onnx("{top}/private/points.bin"), NET),
    Hostile("node with its data above", onnx("../private/points.bin", node=True), NET),
    Hostile("network that is an archive of code", archive("net.onnx"), NET),
    Hostile(
        "coefficients that are an archive of code",
        archive("pose.npz"),
        (("apply-bones", "face.usda", "pose.npz", "-o", "posed.usda"),),
    ),
    Hostile(
        "sliders that are an archive of code",
        archive("net.npz"),
        (("sliders", "face.usda", "--from-network", "net.npz", "-o", "out.usda"),),
    ),
    Hostile("database that is an archive of code", archive("faces.fpdb"), (("database", "info", "faces.fpdb"),)),
    Hostile(
        "neural rig that is an archive of code",
        archive("rig.fpnr"),
        RIG,
    ),
    *SOURCES,
)
MODES = {"alone": (), "root": ("--root", "."), "roots": ()}


@pytest.fixture(scope="module")
def stock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stock")
    make_stock(folder, full_face(), (made(1), made(2)))
    return folder


@pytest.fixture
def world(stock: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> World:
    world = World(tmp_path)
    shutil.copytree(stock, world.sent)
    world.private.mkdir()
    (world.private / "photo.png").write_bytes(noise())
    (world.private / "notes.txt").write_text("{private: notes}\n")
    (world.private / "points.bin").write_bytes(np.random.default_rng(3).bytes(64))
    monkeypatch.chdir(world.sent)
    return world


def _state(world: World) -> dict[str, str]:
    """All that is not in the folder that was sent."""
    return {
        str(path.relative_to(world.top)): _digest(path) for path in _files(world.top) if world.sent not in path.parents
    }


def _files(folder: Path) -> Iterator[Path]:
    for parent, folders, names in os.walk(folder):
        yield from (Path(parent, name) for name in (*folders, *names))


def _digest(path: Path) -> str:
    state = path.lstat()
    content = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() and not path.is_symlink() else ""
    return f"{state.st_mode} {content}"


def _brought(world: World) -> list[str]:
    """Files in the folder that was sent with something of the victim's."""
    secrets = [pixels_of(noise()), b"private: notes", (world.private / "points.bin").read_bytes()[:36]]
    plain = [one for one in _files(world.sent) if one.is_file() and not one.is_symlink()]
    return [one.name for one in plain if any(secret in one.read_bytes() for secret in secrets)]


@pytest.mark.parametrize("mode", ["alone", *(pytest.param(one, marks=pytest.mark.slow) for one in ("root", "roots"))])
@pytest.mark.parametrize("hostile", HOSTILE, ids=lambda one: one.name)
def test_a_hostile_folder_is_of_no_harm(
    hostile: Hostile, mode: str, world: World, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    if mode == "roots":
        monkeypatch.setenv("FACEPIPE_ROOTS", os.pathsep.join([str(world.sent), str(world.sent / "shapes")]))
    (world.sent / "shapes").mkdir()  # a root
    hostile.make(world)
    before = _state(world)
    for number, line in enumerate(hostile.lines):
        code = exit_code(*line, *MODES[mode])
        printed, error = capsys.readouterr()
        assert number or hostile.said in printed + error, (line, printed, error)
        assert not world.ran.exists(), line
        assert not Path("ran").exists(), line
        assert _state(world) == before, line
        assert _brought(world) == [], line
        assert code in ((1, 2) if hostile.refused and number == 0 else (0, 1, 2)), (line, error)
        said = [splitline for splitline in error.splitlines() if not splitline.startswith("facepipe: warning: ")]
        assert len(said) == (code == 2), error
        assert all(map(str.isprintable, said)), error


def test_the_payload_is_real(world: World) -> None:
    pickle.loads(world.pickled)
    assert world.ran.exists()
    assert Payload(world.ran).__reduce__()[0] is os.mkdir


def test_the_layout_of_a_studio_works_without_flags(world: World, capsys: Capsys) -> None:
    """Assets in another absolute folder, with textures below and results of their own."""
    assets = world.top / "assets" / "anna"
    shutil.copytree(world.sent, assets)
    shot = Path("shot.usda")
    units = 'metersPerUnit = 0.1\n    upAxis = "Z"'
    shot.write_text(f'#usda 1.0\n(\n    defaultPrim = "Tiny"\n    {units}\n    subLayers = [@{assets}/face.usda@]\n)\n')
    for words in (["inspect", "shot.usda"], ["cook", "shot.usda"], ["cook", f"{assets}/mix.usda"]):
        assert exit_code(*words) == 0
    assert exit_code("export", "shot.usda", "-o", "shot.glb") == 0
    assert exit_code("regions", "shot.usda", "--map", "map.png", "--legend", "legend.json", "-o", "flat.usdz") == 0
    assert exit_code("import", "usd", "shot.usda", "copy.usda") == 0
    assert any(Path("copy_textures").iterdir())
    assert "outside" not in capsys.readouterr().err


def test_there_are_enough() -> None:
    assert len({one.name for one in HOSTILE}) >= 40
