"""Folders that bring what is not theirs into results: by recipes, projects, what lies beside, and links for outputs."""

from __future__ import annotations

import re
from collections.abc import Callable

from cook_cases import CASES
from hostile_folders import COOK, KEY, REBUILD, Hostile, World, both, file, linked, noise, recipe
from pxr import Sdf, Usd

from facepipe.cli import main

OUTSIDE, URL = "outside the roots", "is a URL"
ESCAPES = {  # -> how a file is named that lies in the victim's folder, and what is said of it
    "above": ("../private/{}", OUTSIDE),
    "absolute": ("{top}/private/{}", OUTSIDE),
    "link": ("./{}", OUTSIDE),
    "linked folder": ("./lib/{}", OUTSIDE),
    "file URL": ("file://{top}/private/{}", URL),
}
Make = Callable[[World], object]


def _moved(name: str, escape: str) -> Make:
    """A file goes to the victim's folder, with a link to it where its name leads through one."""

    def make(world: World) -> None:
        (world.sent / name).rename(world.private / name)
        if escape == "link":
            linked(name, f"../private/{name}")(world)
        elif escape == "linked folder":
            linked("lib", "../private")(world)

    return make


def _named(name: str, escape: str, world: World) -> str:
    return ESCAPES[escape][0].replace("{top}", str(world.top)).replace("{}", name)


def _cooked(case: str, name: str, escape: str) -> Hostile:
    """mix.usda is made of a file, by its own command; then its recipe names one of the victim's, of the same bytes."""
    words = CASES[case].line

    def make(world: World) -> None:
        CASES[case].put(world.sent)
        (world.sent / "mix.usda").unlink()
        assert main([*words, "-o", "mix.usda", "-q"]) == 0
        _moved(name, escape)(world)
        path = world.sent / "mix.usda"
        text = path.read_text()
        assert f'"./{name}"' in text
        path.write_text(text.replace(f"./{name}", _named(name, escape, world)))

    lines = (*COOK[:2], (*CASES[case].command, "--edit", "mix.usda", "--force"))
    return Hostile(f"recipe of {case}, {name}: {escape}", make, lines, said=ESCAPES[escape][1])


_FILES = {  # command -> files of its recipe that are no stages
    "animate": ("take.csv",),
    "apply-bones": ("pose.fpb",),
    "landmarks": ("points.json",),
    "regions": ("map.png", "legend.json"),
    "skin": ("joints.json",),
    "sliders from a table": ("table.toml",),
    "sliders from a network": ("net.npz",),
    "neural-rig": ("rig.fpnr",),
}
_PHOTO = "../private/photo.png"
_PHOTOS = {
    "bake-photo": ("./a.usda", _PHOTO),
    "fit-photo": ("./a.usda", _PHOTO),
    "fit-neutral": ("./a.usda", "../private/scan.ply"),
    "refine-neutral": ("./a.usda", "../private/scan.ply"),
    "register-scan": ("./a.usda", "../private/scan.ply"),
    "rebuild": ("../private/project.toml", "./a.usda"),
}
RECIPES = (
    *(_cooked(case, name, escape) for case, names in _FILES.items() for name in names for escape in ESCAPES),
    *(
        Hostile(f"recipe of {verb}, source: above", recipe(verb, named), COOK[:2], said=OUTSIDE)
        for verb, named in _PHOTOS.items()
    ),
    Hostile(
        "recipe of bake-photo, photo called a stage: link",
        both(recipe("bake-photo", ("./a.usda", "./p.usda")), linked("p.usda", _PHOTO)),
        COOK[:2],
        said=OUTSIDE,
    ),
    Hostile(
        "recipe of fit-neutral, photo in a folder: link",
        both(linked("photos/p.png", "../../private/photo.png"), recipe("fit-neutral", ("./a.usda", "./photos"))),
        COOK[:2],
        said=OUTSIDE,
    ),
)


def _chosen(text: str, line: str, name: str, content: str, escape: str) -> Hostile:
    """A project file chooses a file."""

    def make(world: World) -> None:
        file(name, content)(world)
        _moved(name, escape)(world)
        (world.sent / "facepipe.toml").write_text(text.replace("{}", _named(name, escape, world)))

    return Hostile(
        f"project file, {re.sub(r'[^a-z]+', ' ', text).strip()}: {escape}",
        make,
        (tuple(line.split()),),
        said=ESCAPES[escape][1],
    )


_NAMES = ("names.json", '{"jawOpen": "OPEN"}')
_EXPORT = "export face.usda -o out.glb --force"
_CHOSEN = {  # what a project says -> the line that it is said of, and the file
    "[names]\nstudio = '{}'": (f"{_EXPORT} --rename studio", *_NAMES),
    "[defaults.export]\nrename = '{}'": (_EXPORT, *_NAMES),
    "[defaults.import]\nrename = '{}'": ("import usd face.usda copy.usda --force", *_NAMES),
    "[defaults.blend]\nweights = '{}'": (
        "blend a.usda b.usda -o out.usda --force",
        "weights.json",
        '{"default": [1, 0]}',
    ),
}
PROJECTS = tuple(_chosen(text, *rest, escape) for text, rest in _CHOSEN.items() for escape in ESCAPES)


def _rebuild(key: str, escape: str) -> Hostile:
    files = dict.fromkeys(("template", "database", "scan", "landmarks"), "a.usda") | {"work": "work"}

    def make(world: World) -> None:
        (world.private / "x.usda").write_bytes((world.sent / "a.usda").read_bytes())
        linked("lib", "../private")(world) if escape == "linked folder" else None
        linked("x.usda", "../private/x.usda")(world) if escape == "link" else None
        named = {**files, key: _named("x.usda", escape, world)}
        first, second = (
            "\n".join(f"{one} = '{named[one]}'" for one in keys)
            for keys in (("template", "database", "work"), ("scan", "landmarks"))
        )
        (world.sent / "project.toml").write_text(f"{first}\n[neutral]\n{second}\n")

    return Hostile(f"rebuild project, {key}: {escape}", make, REBUILD, said=ESCAPES[escape][1])


REBUILDS = (
    *(_rebuild(key, escape) for key in ("template", "database", "scan", "landmarks") for escape in ESCAPES),
    _rebuild("work", "file URL"),
)

# what lies in a folder or beside a file
_TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
_SHAPES = both(file("shapes/neutral.obj", _TRIANGLE), file("shapes/jawOpen.obj", _TRIANGLE.replace("1 0 0", "2 0 0")))
_OBJ = (("import", "obj", "shapes", "copy.usda", "--force"),)


def _lent(name: str, content: str = "") -> Make:
    """A file of the folder is one of the victim's, by a link."""

    def make(world: World) -> None:
        path = world.sent / name
        private = world.private / path.name
        private.write_text(content or path.read_text())
        linked(name, str(private))(world)

    return make


def _tiny_network(world: World) -> None:
    """net.onnx with its sidecar."""
    assert main(["export", "face.usda", "-o", "net.onnx", "-q"]) == 0


def _photos(world: World) -> None:
    for number in range(6):
        file(f"photos/{number}.png", noise(80))(world)
        file(f"masks/{number}.png", noise(80))(world)


def _linked_rig(world: World) -> None:
    """face.usda links a neural rig of the victim's."""
    CASES["neural-rig"].put(world.sent)
    assert main([*CASES["neural-rig"].line, "-o", "rigged.usda", "-q"]) == 0
    (world.sent / "rig.fpnr").rename(world.private / "rig.fpnr")
    stage = Usd.Stage.Open(str(world.sent / "rigged.usda"))
    link = stage.GetDefaultPrim().GetAttribute("facepipe:neuralRig:file")
    link.Set(Sdf.AssetPath(f"{world.private}/rig.fpnr"))
    stage.Save()


_SCAN = ("scan", "photos", "-o", "scan.ply")
FOUND = (
    Hostile("obj folder, shape: link", both(_SHAPES, _lent("shapes/jawOpen.obj")), _OBJ, said=OUTSIDE),
    Hostile("obj folder, neutral: link", both(_SHAPES, _lent("shapes/neutral.obj")), _OBJ, said=OUTSIDE),
    Hostile(
        "obj folder, landmarks: link",
        both(_SHAPES, _lent("shapes/landmarks.json", '{"chin": [0]}')),
        _OBJ,
        said=OUTSIDE,
    ),
    Hostile(
        "ict folder, neutral: link",
        both(file("shapes/generic_neutral_mesh.obj", _TRIANGLE), _lent("shapes/generic_neutral_mesh.obj")),
        (("import", "ict", "shapes", "copy.usda", "--force"),),
        said=OUTSIDE,
    ),
    Hostile(
        "ict folder, model: linked folder",
        linked("shapes/FaceXModel", "../../private"),
        (("import", "ict", "shapes", "copy.usda", "--force"),),
        said=OUTSIDE,
    ),
    Hostile(
        "onnx, sidecar: link",
        both(_tiny_network, _lent("net.onnx.json")),
        (("validate", "net.onnx"),),
        said=OUTSIDE,
    ),
    Hostile(
        "photos of a scan, photo: link",
        both(_photos, linked("photos/0.png", "{top}/private/photo.png")),
        (_SCAN,),
        said=OUTSIDE,
    ),
    Hostile(
        "scan, landmarks beside it: link",
        both(file("scan.obj", _TRIANGLE), _lent("scan.landmarks.json", "{}")),
        (("fit-neutral", "scan.obj", "-o", "out.usda"),),
        said=OUTSIDE,
    ),
    Hostile(
        "usd, neural rig: absolute",
        _linked_rig,
        (("validate", "rigged.usda"), ("inspect", "rigged.usda")),
        said=OUTSIDE,
    ),
)

# where results go
_LIB = linked("lib", "../private")
_INTO = {
    "blend, stage": "blend a.usda b.usda -o lib/out.usda",
    "blend, flat stage": "blend a.usda b.usda -o lib/out.usda --flatten",
    "sample, stage": "sample -o lib/out.usda",
    "demo, folder itself": "demo lib",
    "export, folder between": "export face.usda -o lib/deep/out.glb",
    "export, folder up": "export face.usda -o lib/deep/../out.glb",
}


def _deep(world: World) -> None:
    (world.private / "deep").mkdir()


OUTPUTS = (
    *(
        Hostile(f"{name}: linked folder", both(_deep, _LIB), (tuple(line.split()),), said=OUTSIDE)
        for name, line in _INTO.items()
    ),
    Hostile(
        "export, folder with remains of a killed run: linked folder",
        both(file(f"../private/{KEY}/.facepipe-lock", ""), file(f"../private/{KEY}/x", "x"), _LIB),
        (("export", "face.usda", "-o", "lib/out.glb"), ("demo", "lib")),
        said=OUTSIDE,
    ),
    Hostile(
        "export, folder: chain of links",
        both(_deep, linked("x/one", "../../private"), linked("lib", "x/one")),
        (("export", "face.usda", "-o", "lib/out.glb"),),
        said=OUTSIDE,
    ),
    Hostile(
        "render, picture: link",
        linked("out.png", "../private/photo.png"),
        (("render", "face.usda", "-o", "out.png", "--force"),),
        said=OUTSIDE,
    ),
    Hostile(
        "regions, texture: link",
        linked("flat_textures/skin.png", "../../private/notes.txt"),
        (("regions", "face.usda", "--map", "map.png", "--legend", "legend.json", "-o", "flat.usda", "--flatten"),),
        said=OUTSIDE,
    ),
)
SOURCES = (*RECIPES, *PROJECTS, *REBUILDS, *FOUND, *OUTPUTS)
