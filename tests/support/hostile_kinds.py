"""The kinds of hostile folders: what reads, which field of it, and how that leads out, no two alike."""

from __future__ import annotations

import os
from collections.abc import Callable

from hostile_folders import (
    BATCH,
    COOK,
    COPY,
    EXPORT,
    FLAT,
    KEY,
    REBUILD,
    SHOW,
    Hostile,
    World,
    archive,
    both,
    elsewhere,
    fbx,
    file,
    fitted,
    gltf,
    hard_link,
    interface,
    journal,
    ledger,
    linked,
    obj,
    onnx,
    over,
    package,
    packed_beside,
    plan,
    recipe,
    sampled,
    stale,
    textured,
)
from hostile_sources import SOURCES

TEXTURES = (*EXPORT[:1], *FLAT, ("inspect", "face.usda"), *COPY)
PACKED = tuple(tuple("face.usdz" if word == "face.usda" else word for word in line) for line in TEXTURES)
GLTF = (("import", "gltf", "face.gltf", "copy.usda", "--force"), ("validate", "face.gltf"))
OBJ = (("import", "obj", "shapes", "copy.usda", "--force"),)
FBX = (("import", "fbx", "face.fbx", "copy.usda", "--force", "--strict"), ("export", "face.fbx", "-o", "copy.glb"))
RIG = (("neural-rig", "apply", "face.usda", "rig.fpnr", "-o", "rigged.usda"),)
NET = (("validate", "net.onnx"), ("eval", "net.onnx", "-o", "points.npz"))
PROJECT = 'template = "a.usda"\ndatabase = "mix.usda"\nwork = "{}"\n[neutral]\nscan = "b.usda"\n'
LAYER = '(\n    defaultPrim = "Tiny"\n    subLayers = [@{}@, @./b.usda@]\n)'


def _layer(name: str) -> str:
    return LAYER.replace("{}", name)


def _device(world: World) -> None:
    os.mkfifo(world.sent / "pipe")


def _state(world: World) -> None:
    (world.sent / "pipe").rename(world.sent / "show_batch/tasks.jsonl")


def _second_name(world: World) -> None:
    """A file of the victim's is the ledger, by another of its names."""
    (world.sent / "show_batch").mkdir()
    os.link(world.private / "notes.txt", world.sent / "show_batch/tasks.jsonl")


def _inside(world: World) -> None:
    (world.sent / "pipe").rename(world.sent / "shapes" / "pipe")


_SINGLE = (
    # recipes that name code
    Hostile("recipe, model: code", both(fitted("./net.pt2"), archive("net.pt2")), COOK),
    Hostile("recipe, model: code by a way round", both(fitted("../sent/net.pt2"), archive("net.pt2")), COOK),
    Hostile("recipe, model: pickle", both(fitted("./net.pkl"), archive("net.pkl")), COOK),
    Hostile(
        "recipe, model: link to code",
        both(fitted("./net.onnx"), archive("net.pt2"), linked("net.onnx", "net.pt2")),
        COOK,
    ),
    Hostile("recipe, model: code under another name", both(fitted("./net.onnx"), archive("net.onnx")), COOK),
    Hostile("recipe, verb: unknown", recipe("python -c", ("./a.usda",)), COOK),
    Hostile("recipe, verb: shell", recipe("$(touch ran)", ("./a.usda", "$(touch ran)", "| touch ran")), COOK),
    # recipes that lead elsewhere
    Hostile("recipe, source: above", recipe("blend", ("../private/notes.txt", "./b.usda")), COOK),
    Hostile("recipe, source: pipe", both(_device, recipe("blend", ("./pipe", "./b.usda"))), COOK),
    Hostile("recipe, source: device", recipe("blend", ("/dev/zero", "./b.usda")), COOK),
    Hostile("recipe, source: itself", recipe("blend", ("./mix.usda", "./mix.usda")), COOK),
    Hostile("recipe, source: two lines", recipe("blend", ("./a\nb.usda", "\x1b[31m./c.usda")), COOK),
    Hostile(
        "cook, layer with a recipe: absolute",
        elsewhere(file("mix.usda", f"#usda 1.0\n{_layer('{top}/private/mix.usda')}")),
        COOK,
        reads=True,
    ),
    Hostile(
        "cook, layer with a recipe: above",
        elsewhere(file("mix.usda", f"#usda 1.0\n{_layer('./x/../../private/mix.usda')}")),
        COOK,
        reads=True,
    ),
    Hostile(
        "cook, layer with a recipe: linked folder",
        elsewhere(both(linked("lib", "../private"), file("mix.usda", f"#usda 1.0\n{_layer('./lib/mix.usda')}"))),
        COOK,
        reads=True,
    ),
    Hostile("cook, result: link", elsewhere(both(stale, linked("mix.usda", "../private/mix.usda"))), COOK, reads=True),
    Hostile(
        "cook, result: chain of links",
        elsewhere(both(stale, linked("one.usda", "../private/mix.usda"), linked("mix.usda", "one.usda"))),
        COOK,
        reads=True,
    ),
    Hostile("cook, result: hard link", hard_link, COOK, refused=False),
    Hostile("cook, result: link to nothing", linked("mix.usda", "../private/new.usda"), COOK),
    # what helps in writing
    Hostile("lock, file: link", both(stale, linked(".mix.usda.lock", "../private/notes.txt")), COOK),
    Hostile("lock, file: link to nothing", both(stale, linked(".mix.usda.lock", "../private/new")), COOK),
    Hostile(
        "lock, file: pipe",
        both(stale, lambda world: os.mkfifo(world.sent / ".mix.usda.lock")),
        COOK,
        refused=False,
    ),
    Hostile("journal, move: above", journal(["."], [[0, "../private/notes.txt", None, "main"]]), COOK, refused=False),
    Hostile("journal, folder: above", journal(["../private"], [[0, "notes.txt", None, "main"]]), COOK, refused=False),
    Hostile("journal, folder: absolute", journal(["/etc"], [[0, "hostname", None, "stale"]]), COOK, refused=False),
    Hostile(
        "journal, folder: linked folder",
        both(journal(["lib"], [[0, "notes.txt", None, "main"]]), linked("lib", "../private")),
        COOK,
        refused=False,
    ),
    Hostile("hidden folder, itself: link", both(stale, linked(KEY, "../private")), COOK, refused=False),
    Hostile(
        "hidden folder, content: link",
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
        "hidden folder, joined to: above",
        both(stale, file(f"{KEY}/.facepipe-joined", "../private")),
        COOK,
        refused=False,
    ),
    Hostile("output, file: link", both(linked("out.glb", "../private/notes.txt")), EXPORT[:1]),
    Hostile("output, file: link to nothing", both(linked("out.glb", "../private/new.glb")), EXPORT[:1]),
    Hostile("output, sidecar: link", both(linked("out.onnx.json", "../private/notes.txt")), EXPORT[1:]),
    Hostile("output, textures: linked folder", linked("flat_textures", "../private"), FLAT[:1]),
    # projects
    Hostile("rebuild project, work: above", file("project.toml", PROJECT.format("../private")), REBUILD),
    Hostile("rebuild project, work: absolute", file("project.toml", PROJECT.format("{top}/private/new")), REBUILD),
    Hostile(
        "rebuild project, work: linked folder",
        both(linked("work", "../private"), file("project.toml", PROJECT.format("work"))),
        REBUILD,
    ),
    Hostile("rebuild project, work: two lines", file("project.toml", PROJECT.format("../pri\\nvate")), REBUILD),
    Hostile(
        "rebuild project, scan: pipe",
        both(_device, file("project.toml", PROJECT.format("work").replace("b.usda", "pipe"))),
        REBUILD,
    ),
    Hostile(
        "recipe, project's work: above",
        both(
            file("project.toml", PROJECT.format("../private")),
            recipe("rebuild", ("./project.toml", "./a.usda"), project="./project.toml", joint=False),
        ),
        COOK,
    ),
    # layers
    Hostile(
        "usd, sublayer: above",
        over(_layer("../private/notes.txt")),
        (*SHOW, *EXPORT, *FLAT),
        reads=True,
    ),
    Hostile("usd, sublayer: pipe", both(_device, over(_layer("./pipe"))), (*SHOW, *EXPORT[:1], *COOK[:1])),
    Hostile("usd, sublayer: device", over(_layer("/dev/zero")), SHOW),
    Hostile("usd, sublayer: link to a pipe", both(_device, linked("x.usda", "pipe"), over(_layer("./x.usda"))), SHOW),
    Hostile("usd, sublayer: folder", over(_layer("../private")), (*SHOW, *EXPORT, *FLAT)),
    Hostile(
        "usd, reference: circle", over('(defaultPrim = "A")\ndef "A" (references = @./face.usda@) {}'), (*SHOW, *EXPORT)
    ),
    # textures
    Hostile("usd, texture: absolute", textured("{top}/private/photo.png"), TEXTURES),
    Hostile("usd, texture: above", textured("../private/photo.png"), TEXTURES),
    Hostile("usd, texture: link", both(linked("skin.png", "../private/photo.png"), textured("./skin.png")), TEXTURES),
    Hostile(
        "usd, texture: chain of links",
        both(
            linked("a.png", "../private/photo.png"),
            linked("b.png", "a.png"),
            linked("c.png", "b.png"),
            textured("c.png"),
        ),
        TEXTURES,
    ),
    Hostile(
        "usd, texture: linked folder",
        both(linked("face_textures2", "../private"), textured("./face_textures2/photo.png")),
        TEXTURES,
    ),
    Hostile("usd, texture: file of the system", textured("/etc/passwd"), TEXTURES[:1]),
    Hostile("usd, texture: pipe", both(_device, textured("./pipe")), (*TEXTURES, ("validate", "face.usda"))),
    Hostile("usd, texture: device", textured("/dev/zero"), (*TEXTURES, ("validate", "face.usda"))),
    Hostile("usd, texture: two lines", textured("./\\n\x1b[2Ja.png"), TEXTURES[:1]),
    Hostile("usd, texture over time: absolute", sampled, TEXTURES[1:3]),
    Hostile("usd, texture of the material: absolute", interface, TEXTURES),
    Hostile("usd, texture by an expression: absolute", textured('`"{top}/private/photo.png"`'), TEXTURES[:1]),
    Hostile(
        "project file, itself: folder",
        both(file("../facepipe.toml/x", ""), textured("../private/photo.png")),
        TEXTURES,
    ),
    Hostile(
        "project file, roots: absolute",
        both(file("facepipe.toml", 'roots = ["/"]'), textured("../private/photo.png")),
        TEXTURES,
    ),
    Hostile(
        "project file, itself: link", both(linked("facepipe.toml", "/"), textured("../private/photo.png")), TEXTURES
    ),
    # packages
    Hostile("usdz, texture: absolute", packed_beside, PACKED),
    Hostile(
        "usdz, entry: above",
        package("../private/photo.png", "../../above.png", "/etc/x"),
        PACKED,
        refused=False,
    ),
    Hostile("usdz, entry: link", package(link=True), PACKED, refused=False),
    # glTF, OBJ
    Hostile("gltf, buffer: above", gltf(buffer="../private/points.bin"), GLTF),
    Hostile("gltf, buffer: above, encoded", gltf(buffer="%2e%2e/private/points.bin"), GLTF),
    Hostile("gltf, buffer: absolute", gltf(buffer="{top}/private/points.bin"), GLTF),
    Hostile("gltf, buffer: file URL", gltf(buffer="file://{top}/private/points.bin"), GLTF),
    Hostile("gltf, buffer: link", both(gltf(buffer="b.bin"), linked("b.bin", "../private/points.bin")), GLTF),
    Hostile("gltf, buffer: pipe", both(_device, gltf(buffer="pipe")), GLTF),
    Hostile("gltf, image: above", gltf(image="../private/photo.png"), GLTF[:1]),
    Hostile("gltf, image: file URL", gltf(image="file://{top}/private/photo.png"), GLTF[:1]),
    Hostile("gltf, image: link", both(gltf(image="a.png"), linked("a.png", "../private/photo.png")), GLTF[:1]),
    Hostile("fbx, picture: above", fbx("..\\private\\photo.png"), FBX),
    Hostile("fbx, picture: absolute", fbx("{top}/private/photo.png"), FBX),
    Hostile("fbx, picture: link", both(fbx("a.png"), linked("a.png", "../private/photo.png")), FBX),
    Hostile("mtl, map: above", obj("face.mtl", "../../private/photo.png"), OBJ),
    Hostile("mtl, map: absolute", obj("face.mtl", "/etc/passwd"), OBJ),
    Hostile("mtl, map: link", both(obj("face.mtl", "a.png"), linked("shapes/a.png", "../../private/photo.png")), OBJ),
    Hostile("obj, library: above", obj("../../private/notes.txt"), OBJ),
    Hostile("obj, library: pipe", both(_device, obj("pipe"), _inside), OBJ, refused=False),
    # networks and arrays
    Hostile("onnx, data of a tensor: above", onnx("../private/points.bin"), NET),
    Hostile("onnx, data of a tensor: absolute", onnx("{top}/private/points.bin"), NET),
    Hostile("onnx, data of a node: above", onnx("../private/points.bin", node=True), NET),
    Hostile("onnx, itself: code", archive("net.onnx"), NET),
    Hostile(
        "npz, coefficients: code",
        archive("pose.npz"),
        (("apply-bones", "face.usda", "pose.npz", "-o", "posed.usda"),),
    ),
    Hostile(
        "npz, slider network: code",
        archive("net.npz"),
        (("sliders", "face.usda", "--from-network", "net.npz", "-o", "out.usda"),),
    ),
    Hostile("database, itself: code", archive("faces.fpdb"), (("database", "info", "faces.fpdb"),)),
    Hostile(
        "neural rig, itself: code",
        archive("rig.fpnr"),
        RIG,
    ),
)

_ONE = [1, 1]  # a state
_HTTP = "http://127.0.0.1:9/x.glb"
_AT = {  # how a name leads out: the name
    "above": "../private/{}",
    "absolute": "{{top}}/private/{}",
    "device": "/dev/zero",
    "http URL": "http://127.0.0.1:9/{}",
    "file URL": "file://{{top}}/private/{}",
    "chained URL": "simplecache::http://127.0.0.1:9/{}",
    "S3 URL": "s3://bucket/{}",
    "memory URL": "memory://{}",
}


def _at(escape: str, name: str) -> str:
    return _AT[escape].format(name)


def _limit(key: str, value: str) -> Callable[[World], object]:
    return _more(f"{key} = {value}\n")


def _more(text: str) -> Callable[[World], object]:
    """show.toml goes on with a text."""

    def make(world: World) -> None:
        with (world.sent / "show.toml").open("a") as said:
            said.write(text)

    return make


def _steps(count: int) -> Callable[[World], object]:
    return _more("".join(f'[steps.s{number}]\nrun = "validate a.usda"\n' for number in range(count)))


_PLANS = (
    *(
        Hostile(f"plan, csv: {escape}", plan(f'csv = "{_at(escape, "notes.txt")}"'), BATCH)
        for escape in ("above", "absolute", "device", "http URL", "file URL", "chained URL", "S3 URL", "memory URL")
    ),
    Hostile("plan, csv: link", both(plan('csv = "faces.csv"'), linked("faces.csv", "../private/notes.txt")), BATCH),
    Hostile("plan, csv: pipe", both(_device, plan('csv = "pipe"')), BATCH),
    *(
        Hostile(f"plan, glob: {escape}", plan(f'glob = "{_at(escape, "*.png")}"'), BATCH)
        for escape in ("above", "absolute", "http URL", "file URL", "chained URL", "S3 URL", "memory URL")
    ),
    Hostile("plan, glob: linked folder", both(plan('glob = "lib/*.png"'), linked("lib", "../private")), BATCH),
    Hostile("plan, glob: above behind a wildcard", plan('glob = "*/../../private/*.png"'), BATCH),
    Hostile("plan, glob: the whole disk", plan('glob = "/**/x"'), BATCH),
    Hostile(
        "plan, glob: circle of links",
        both(plan('glob = "**/none.glb"'), *(linked(f"shapes/{name}", ".") for name in "abcd")),
        BATCH,
    ),
    *(
        Hostile(f"plan, out: {escape}", plan("range = { n = [1, 1] }", "export a.usda", _at(escape, "built")), BATCH)
        for escape in ("above", "absolute", "http URL", "S3 URL")
    ),
    Hostile("plan, out: linked folder", both(plan('glob = "a.usda"', out="lib"), linked("lib", "../private")), BATCH),
    Hostile(
        "plan, glob: more ways than folders",
        both(plan(f'glob = "{"**/" * 12}none.glb"'), file(f"{'deep/' * 40}x", "")),
        BATCH,
    ),
    Hostile("plan, steps: thousands", both(plan('glob = "a.usda"'), _steps(3000)), BATCH),
    Hostile(
        "plan, faces times steps: millions",
        both(plan("range = { n = [1, 100000] }", "export a.usda"), _steps(250)),
        BATCH,
    ),
    Hostile(
        "plan, text of all lines: gigabytes",
        plan("range = { n = [1, 300000] }", f"export {{n}} {'x' * 10_000}"),
        BATCH,
    ),
    *(
        Hostile(f"plan, {key}: no number", both(plan('glob = "a.usda"'), _limit(key, "nan")), BATCH)
        for key in ("seconds", "memory_mb")
    ),
    Hostile("plan, seconds: no float", both(plan('glob = "a.usda"'), _limit("seconds", f"1{'0' * 400}")), BATCH),
    Hostile("plan, range: billions", plan("range = { n = [1, 9000000000] }"), BATCH),
    Hostile("plan, range: millions", plan("range = { n = [1, 9000000] }"), BATCH),
    Hostile(
        "table, columns: thousands",
        both(plan('csv = "faces.csv"'), file("faces.csv", ",".join(f"c{n}" for n in range(5000)) + "\n")),
        BATCH,
    ),
    Hostile(
        "table, values: millions",
        both(plan('csv = "faces.csv"'), file("faces.csv", "face\n" + "a\n" * 3_100_000)),
        BATCH,
    ),
    Hostile("state folder, itself: link", both(plan('glob = "a.usda"'), linked("show_batch", "../private")), BATCH),
    *(
        Hostile(
            f"state folder, {name}: link",
            both(
                plan('glob = "none.usda"'),
                linked(f"show_batch/{file_name}", "../../private/notes.txt"),
                plan('glob = "a.usda"'),
            ),
            BATCH,
            refused=refused,
        )
        for name, file_name, refused in (
            ("ledger", "tasks.jsonl", True),
            ("lock", ".tasks.jsonl.lock", True),
            ("report", "report.html", True),
        )
    ),
    Hostile(
        "state folder, ledger: pipe",
        both(
            plan('glob = "a.usda"'),
            file("show_batch/x", ""),
            lambda world: os.mkfifo(world.sent / "show_batch/tasks.jsonl"),
        ),
        BATCH,
    ),
    Hostile(
        "state folder, ledger: device",
        both(plan('glob = "a.usda"'), linked("show_batch/tasks.jsonl", "/dev/zero")),
        BATCH,
    ),
    Hostile("state folder, ledger: hard link", both(plan('glob = "a.usda"'), _second_name), BATCH, refused=False),
    Hostile("ledger, error: none", ledger(status="failed"), BATCH, refused=False),
    Hostile("ledger, report: no float", ledger(report={"x_mm": 10**400}), BATCH, refused=False),
    *(
        Hostile(f"ledger, {field}: {escape}", ledger(**{field: {name: value}}), BATCH, refused=False)
        for field, value in (("reads", _ONE), ("writes", [_ONE, "sha256:0"]))
        for escape, name in (("http URL", _HTTP), ("S3 URL", "s3://bucket/x.glb"))
    ),
)
_FLATTEN = ("regions", "face.usda", "--map", "map.png", "--legend", "legend.json", "--flatten", "--force", "-o")
_OUTPUTS = tuple(
    Hostile(f"{what}, {field}: linked folder", linked("lib", "../private"), (line,))
    for what, field, line in (
        ("export", "glb", ("export", "face.usda", "-o", "lib/out.glb")),
        ("export", "gltf", ("export", "face.usda", "-o", "lib/out.gltf")),
        ("export", "onnx", ("export", "face.usda", "-o", "lib/out.onnx")),
        ("export", "vrm", ("export", "face.usda", "-o", "lib/out.vrm", "--stub-body", "--authors", "me")),
        ("regions", "stage", (*_FLATTEN, "lib/out.usda")),
        ("regions", "package", (*_FLATTEN, "lib/out.usdz")),
        ("regions", "picture", (*_FLATTEN, "out.usda", "--picture", "lib/out.png")),
        ("render", "picture", ("render", "face.usda", "-o", "lib/out.png", "--size", "64")),
        ("import", "stage", ("import", "usd", "face.usda", "lib/out.usda")),
        ("blend", "heatmap", ("blend", "a.usda", "b.usda", "-o", "out.usda", "--heatmap", "lib/out.png")),
        ("sliders", "stage", ("sliders", "face.usda", "--set", "open=0.5", "-o", "lib/out.usda")),
        ("apply-bones", "points", ("apply-bones", "face.usda", "pose.fpb", "-o", "lib/out.npz")),
        ("database", "file", ("database", "create", "a.usda", "b.usda", "-o", "lib/out.fpdb")),
        ("demo", "folder", ("demo", "lib/demo")),
        ("batch", "state", ("batch", "show.toml", "--state", "lib/state", "--thumbnails", "0", "-q")),
    )
)
HOSTILE = (*_SINGLE, *_PLANS, *_OUTPUTS, *SOURCES)
