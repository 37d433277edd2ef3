"""Every command that writes, on inputs that are small: what tests/support/kills.py kills."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from import_data import SHARED

import facepipe
from facepipe.cli import main

NEURAL = ("--spread", "40", "--sweep", "4", "--together", "10", "--width", "8", "--steps", "120")
NEURAL += ("--points", "16", "--encoder-steps", "110")


def nothing() -> None:
    """No part of the command is another."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """A command line in a folder with copies of files of the material."""

    words: tuple[str, ...]
    uses: tuple[str, ...]  # globs of what is copied from the material
    outputs: tuple[str, ...] = ()  # that older ones are put in the place of, where the command writes over something
    old: tuple[tuple[str, ...], ...] = ()  # commands that make these older outputs; else they are a few bytes
    each: tuple[str, ...] = ()  # globs of files that are whole each for itself
    early: bool = False  # it looks at older outputs before its first step, and knows them again
    code: int = 0  # of another run, where nothing is left to do
    stub: Callable[[], None] = nothing  # puts a quick answer in the place of long computing

    def run(self) -> int:
        """The exit code, in the working folder."""
        return line(*self.words)


def line(*words: object) -> int:
    """The exit code of a command."""
    try:
        return main([str(word) for word in words])
    except SystemExit as end:
        return int(end.code or 0)


@dataclass(frozen=True, kw_only=True)
class Call(Line):
    """A function of the public interface that writes and has no command."""

    call: Callable[[], object]
    words: tuple[str, ...] = ()

    def run(self) -> int:
        self.call()
        return 0


@functools.cache
def quicken() -> None:
    """What takes long and writes nothing is done once: sample heads; pixels of rendered faces are black."""
    import facepipe.heads
    import facepipe.pictures.face_picture
    import facepipe.pictures.surface_view

    facepipe.heads.make = functools.cache(facepipe.heads.make)
    facepipe.heads.make(0)
    facepipe.pictures.face_picture.draw = lambda shader, size, *_: np.zeros((size, size, 3), np.uint8)
    facepipe.pictures.surface_view.draw_surface = lambda look, view: (
        np.zeros((view.size, view.size, 3)),
        np.zeros((view.size, view.size)),
    )


def _deliver() -> None:
    from facepipe.hosting.deliver import deliver

    deliver(Path("a.usda"), Path(), "out", overwrite=True)


def _save(name: str) -> Callable[[], None]:
    return lambda: facepipe.open("head.usdc").save(name)


def _no_wheels() -> None:
    """The add-on without libraries of others."""
    from facepipe_blender import addon

    addon._download = lambda folder, options: None


def _one_scan() -> None:
    """Photos give the dome, cameras and landmarks at once."""
    import scan_domes
    from photo_booth import camera_at

    from facepipe.scanning import photos as scan_photos
    from facepipe.scanning.photos import Cameras, PhotoScan, ScanPhotosReport

    scan, landmarks = scan_domes.scan(9)
    cameras = Cameras(cameras={"a.jpg": camera_at(np.array([120.0, 60.0, 700.0]), 0.4)}, unit="cm")
    made = PhotoScan(scan=scan, cameras=cameras, landmarks=landmarks, report=ScanPhotosReport())
    scan_photos.ScanPhotos.__call__ = lambda self, photos, step: made


def _one_look() -> None:
    """A face that turns in two frames, and nothing to say against it."""
    from facepipe.photo.frames import search
    from facepipe.photo.frames.search import Look

    known = {"pitch": 0.0, "sharpness": 1.0, "lids": 0.1, "lips": 0.0, "error": 1.0}
    looks = tuple(Look(number=i, time=0.1 * i, yaw=0.5 * i, **known) for i in range(2))
    seen = search.Looks(looks=looks, tried=2, frames=2, seconds=0.1)
    search.looks_in = lambda clip, done: seen
    search.read_photo = search.own_landmarks = lambda photo: photo


def _one_transfer() -> None:
    """Transfers make one shape: a fit takes half a minute."""
    from facepipe.geometry.similarity import Similarity
    from facepipe.scanning.transfer import transfer as module
    from facepipe.verbs.author_neutral import AuthorNeutral
    from facepipe.verbs.whole_faces import whole_points

    def transfer(face: Any, recipe: Any, step: Any, **options: Any) -> Any:
        points = whole_points(face.parts())
        AuthorNeutral(shapes={"tongueOut": np.ones_like(points)})(face, points, recipe=recipe)
        return module.TransferReport(
            landmarks="the head's own",
            fit_mean_mm=0.1,
            fit_p95_mm=0.2,
            fit_coverage=1.0,
            beyond_mm=0.0,
            shapes={"tongueOut": {"verdict": "made"}},
            not_made={},
            shown=np.ones(len(points), bool),
            place=Similarity(rotation=np.eye(3), translation=np.zeros(3)),
            framing=points,
        )

    module.transfer = transfer  # type: ignore[assignment]


def _one_face() -> None:
    """The landmarks of a scan are those of the dome."""
    import scan_domes

    from facepipe.geometry.coarse_surface import surface_look
    from facepipe.scanning.landmarks import find
    from facepipe.scanning.landmarks.search import face_frame

    scan, landmarks = scan_domes.scan(9)
    frame = face_frame(landmarks.points)
    assert frame is not None
    report = find.ScanLandmarksReport(found=68, presence=1.0, spread=0.0, searched=1)
    look = surface_look(scan.points, scan.triangles, scan.colors)
    all_of_it = np.ones(len(scan.points), bool)
    found = find.FoundScanLandmarks(landmarks=landmarks, frame=frame, look=look, carrier=all_of_it, report=report)
    find.FindScanLandmarks.__call__ = lambda self, scan: found


def _out(*words: str, uses: tuple[str, ...], more: tuple[str, ...] = (), **settings: Any) -> Line:
    """A line whose outputs are what -o says, and `more`."""
    outputs = (words[words.index("-o") + 1], *more)
    return Line(words=(*words, "--force"), uses=uses, outputs=outputs, **settings)


_DOME = ("dome.usda", "faces.fpdb", "neutral.*", "open.*")
_HEAD = ("head.usdc", "head_textures")
_ACTOR = ("actor",)
_TRAIN = ("neural-rig", "train", "turning.usda", *NEURAL, "-o", "out.fpnr")
_GLTF = {"each": ("out*.bin", "out*.png", "out*.jpg")}  # buffers have new names: replacing the .gltf switches over
_TEXTURES = {"each": ("*_textures/*",)}  # never written over

LINES: dict[str, Line] = {
    "sample": Line(
        words=("sample", "out.usda", "--force"),
        uses=(),
        outputs=("out.usda", "out_arrays.usdc"),
        old=(("sample", "out.usda", "--seed", "1"),),
        **_TEXTURES,
    ),
    "sample usdz": Line(words=("sample", "out.usdz", "--force"), uses=(), outputs=("out.usdz",)),
    "demo": Line(
        words=("demo", "demo", "--force"),
        uses=(),
        **_TEXTURES,
        outputs=tuple(f"demo/{one}" for one in ("head.usdc", "head.glb", "head.onnx", "points.npz", "sheet.png")),
    ),
    "import ict": _out("import", "ict", str(SHARED / "ict_facekit/ict_facekit.npz"), "-o", "out.usdc", uses=()),
    "import makehuman": _out(
        "import", "makehuman", str(SHARED / "makehuman/makehuman_head.npz"), "-o", "out.usdc", uses=()
    ),
    "import obj": _out("import", "obj", "shapes", "-o", "out.usda", uses=("shapes",), **_TEXTURES),
    "import gltf": _out("import", "gltf", "head.glb", "-o", "out.usda", uses=("head.glb",), **_TEXTURES),
    "import gltf usdz": _out("import", "gltf", "head.glb", "-o", "out.usdz", uses=("head.glb",)),
    "import usd": _out("import", "usd", "a.usda", "-o", "out.usda", uses=("a.usda",)),
    "scan": _out(
        *("scan", "photos", "-o", "out.ply", "--save-cameras", "rig.json"),
        uses=("photos",),
        more=("out.landmarks.json", "rig.json"),
        stub=_one_scan,
    ),
    "scan-landmarks": _out(
        *("scan-landmarks", "neutral.ply", "-o", "out.json", "--picture", "out.png"),
        uses=("neutral.ply",),
        more=("out.png",),
        stub=_one_face,
    ),
    "export glb": _out("export", "a.usda", "-o", "out.glb", uses=("a.usda",)),
    "export glb three": _out("export", "a.usda", "--engine", "three", "--quantize", "-o", "out.glb", uses=("a.usda",)),
    "export gltf": _out(
        *("export", "textured.usdz", "-o", "out.gltf"),
        uses=("textured.usdz", "a.usda"),
        old=(("export", "a.usda", "-o", "out.gltf"),),
        **_GLTF,
    ),
    "export onnx": _out("export", "a.usda", "-o", "out.onnx", uses=("a.usda",), more=("out.onnx.json",)),
    "export onnx sliders": _out(
        *("export", "slid.usda", "--sliders", "-o", "out.onnx"), uses=("slid.usda",), more=("out.onnx.json",)
    ),
    "export onnx neural": _out(
        *("export", "turning.usda", "--neural", "head.fpnr", "-o", "out.onnx"),
        uses=("turning.usda", "head.fpnr"),
        more=("out.onnx.json",),
    ),
    "export onnx encoder": _out(
        *("export", "turning.usda", "--neural", "head.fpnr", "--encoder", "-o", "out.onnx"),
        uses=("turning.usda", "head.fpnr"),
        more=("out.onnx.json",),
    ),
    "export glb neural": _out(
        *("export", "turning.usda", "--neural", "head.fpnr", "-o", "out.glb"), uses=("turning.usda", "head.fpnr")
    ),
    "export vrm": _out(
        *("export", "head.usdc", "--stub-body", "--authors", "me"),
        *("--license-url", "https://vrm.dev/licenses/1.0/", "-o", "out.vrm"),
        uses=_HEAD,
    ),
    "eval": _out("eval", "a.onnx", "--set", "jawOpen=0.5", "-o", "out.npz", uses=("a.onnx",)),
    "fit-bones": _out(
        *("fit-bones", "rig.usda", "--target", "talk", "-o", "out.usda", "--coefficients", "out.fpb"),
        *("--heatmap", "out.png", "--rounds", "0", "--limits", "limits.json", "--threshold-mm", "50"),
        uses=("rig.usda", "limits.json"),
        more=("out.fpb", "out.png"),
    ),
    "fit-bones edit": Line(
        words=("fit-bones", "--edit", "fitted.usda", "--threshold-mm", "40", "--force"),
        uses=("rig.usda", "limits.json", "fitted.usda"),
    ),
    "fit-photo": _out(
        *("fit-photo", "front.png", "head.usdc", "--landmarks", "front.json", "-o", "out.usda", "--report", "report"),
        *("--iterations", "0", "--size", "64", "--content", "0", "--identity", "0", "--attributes", "0"),
        *("--expression", "jawOpen"),
        uses=("front.*", *_HEAD),
        more=("report/report.json", "report/report.html", "report/old.render.png"),
        early=True,
    ),
    "bake-photo": _out(
        *("bake-photo", "photo/fitted.usda", "photo/front.png", "--size", "64", "-o", "out.usda"),
        uses=("photo",),
        **_TEXTURES,
    ),
    "train-photo": _out(
        *("train-photo", "head.usdc", "--people", "0", "--renders", "8", "--epochs", "0", "--steps", "1"),
        *("-o", "out.onnx"),
        uses=_HEAD,
    ),
    "choose-frames": Line(
        words=("choose-frames", "clip.mp4", "-o", "frames", "--force"),
        uses=("clip.mp4",),
        outputs=("frames/report.json", "frames/frame_00000_0.00s.png", "frames/frame_00001_0.10s.png"),
        early=True,
        stub=_one_look,
    ),
    "animate": _out("animate", "a.usda", "take.csv", "-o", "out.usda", uses=("a.usda", "take.csv")),
    "apply-bones": _out("apply-bones", "rig.usda", "clip.fpb", "-o", "out.usda", uses=("rig.usda", "clip.fpb")),
    "apply-bones npz": _out("apply-bones", "rig.usda", "clip.fpb", "-o", "out.npz", uses=("rig.usda", "clip.fpb")),
    "basis": _out("basis", "--template", "a.usda", "-o", "out.fpbasis", uses=("a.usda",)),
    "person": _out("person", "b.usda", "--template", "a.usda", "-o", "out.fpb", uses=("a.usda", "b.usda")),
    "render": _out("render", "a.usda", "--size", "64", "-o", "out.png", uses=("a.usda",)),
    "landmarks": _out("landmarks", "a.usda", "--from", "points.json", "-o", "out.usda", uses=("a.usda", "points.json")),
    "landmarks flat": _out(
        *("landmarks", "textured.usdz", "--from", "points.json", "--flatten", "-o", "out.usda"),
        uses=("textured.usdz", "points.json"),
        **_TEXTURES,
    ),
    "regions": _out(
        *("regions", "a.usda", "--map", "map.png", "--legend", "legend.json", "-o", "out.usda", "--picture", "out.png"),
        uses=("a.usda", "map.png", "legend.json"),
        more=("out.png",),
    ),
    "lod": _out("lod", "a.usda", "--triangles", "20,10", "-o", "out.usda", uses=("a.usda",)),
    "blend": _out(
        *("blend", "a.usda", "b.usda", "-o", "out.usda", "--heatmap", "out.png"),
        uses=("a.usda", "b.usda"),
        more=("out.png",),
    ),
    "blend edit": Line(
        words=("blend", "--edit", "mix.usda", "--default", "0.1,0.9", "--force"), uses=("a.usda", "b.usda", "mix.usda")
    ),
    "database create": _out("database", "create", "p0.usda", "p1.usda", "-o", "out.fpdb", uses=("p?.usda",)),
    "database add": _out(
        "database", "add", "people.fpdb", "p3.usda", "-o", "out.fpdb", uses=("people.fpdb", "p3.usda")
    ),
    "database add in place": Line(
        words=("database", "add", "people.fpdb", "p3.usda"), uses=("people.fpdb", "p3.usda"), code=2
    ),
    "database remove": Line(words=("database", "remove", "people.fpdb", "p1"), uses=("people.fpdb",), code=2),
    "fit-neutral": _out(
        *("fit-neutral", "neutral.ply", "--template", "dome.usda", "--database", "faces.fpdb", "--unit", "cm"),
        *("-o", "out.usda", "--picture", "out.png"),
        uses=_DOME,
        more=("out.png",),
    ),
    "conform": _out(
        *("conform", "neutral.ply", "--template", "dome.usda", "--database", "faces.fpdb", "--unit", "cm"),
        *("-o", "out.usda", "--picture", "out.png"),
        uses=_DOME,
        more=("out.png",),
    ),
    "transfer": _out(
        *("transfer", "dome.usda", "-o", "out.usda", "--picture", "out.png"),
        uses=_DOME,
        more=("out.png",),
        stub=_one_transfer,
    ),
    "refine-neutral": _out(
        *("refine-neutral", "fitted_neutral.usda", "neutral.ply", "-o", "out.usda", "--picture", "out.png"),
        uses=(*_DOME, "fitted_neutral.usda"),
        more=("out.png",),
    ),
    "personal-template": _out(
        "personal-template", "actor/anna.usda", "--template", "actor/head.usda", "-o", "out.usda", uses=_ACTOR
    ),
    "register-scan": _out(
        *(
            "register-scan",
            "actor/open.ply",
            "--personal",
            "actor/personal.usda",
            "-o",
            "out.usda",
            "--picture",
            "out.png",
        ),
        *("--weights", "jawOpen=0.8"),
        uses=_ACTOR,
        more=("out.png",),
    ),
    "split-shapes": _out(
        *("split-shapes", "actor/open.usda", "actor/both.usda", "--personal", "actor/personal.usda", "-o", "out.usda"),
        uses=_ACTOR,
    ),
    "rebuild": _out(
        *("rebuild", "project/anna.toml", "-o", "project/out.usda", "--report", "project/report"),
        uses=("project",),
        more=("project/report/report.json", "project/report/neutral.png", "project/report/expressions/old.png"),
        each=("project/anna/*", "project/anna/expressions/*"),
        early=True,
    ),
    "neural-rig train": Line(
        words=(*_TRAIN, "--checkpoint", "out.training", "--force"),
        uses=("turning.usda",),
        outputs=("out.fpnr",),
        each=("out.training",),
    ),
    "neural-rig train plot": Line(
        words=(*_TRAIN, "--plot", "out.svg", "--force"), uses=("turning.usda",), outputs=("out.fpnr", "out.svg")
    ),
    "neural-rig apply": _out(
        "neural-rig", "apply", "turning.usda", "head.fpnr", "-o", "out.usda", uses=("turning.usda", "head.fpnr")
    ),
    "neural-rig invert": _out(
        "neural-rig", "invert", "head.fpnr", "few.usdc", "-o", "out.usda", uses=("few.usdc", "head.fpnr")
    ),
    "neural-rig retarget": _out(
        *("neural-rig", "retarget", "head.fpnr", "turning.usda", "--frames", "frames.usdc", "-o", "out.fpnr"),
        uses=("turning.usda", "head.fpnr", "frames.usdc"),
    ),
    "bake": _out(
        *("bake", "turning.usda", "--spread", "5", "--sweep", "3", "--together", "2", "-o", "out.usdc"),
        uses=("turning.usda",),
    ),
    "skin": _out(
        *("skin", "bare.usda", "--joints", "joints.json", "-o", "out.usda", "--picture", "out.png"),
        uses=("bare.usda", "joints.json"),
        more=("out.png",),
    ),
    "skin learnt": _out(
        *("skin", "bare.usda", "--learn-from", "faces.fpdb", "--count", "3", "-o", "out.usda"),
        uses=("bare.usda", "faces.fpdb"),
    ),
    "sliders from": _out("sliders", "a.usda", "--from", "table.toml", "-o", "out.usda", uses=("a.usda", "table.toml")),
    "sliders set": _out("sliders", "slid.usda", "--set", "open=0.5", "-o", "out.usda", uses=("slid.usda", "a.usda")),
    "sliders from network": _out(
        "sliders", "netted.usda", "--from-network", "net.npz", "-o", "out.usda", uses=("netted.usda", "net.npz")
    ),
    "cook": Line(
        words=("cook", "chain/posed.usda", "chain/side.usda"),
        uses=("chain",),
        each=("chain/*",),
    ),
    "blender-addon": _out("blender-addon", "-o", "out.zip", uses=(), stub=_no_wheels),
    "deliver": Call(
        call=_deliver,
        uses=("a.usda",),
        outputs=("out.glb", "out.onnx", "out.onnx.json", "out.report.json"),
    ),
    "save": Call(call=_save("out.usda"), uses=_HEAD, outputs=("out.usda",), **_TEXTURES),
    "save usdz": Call(call=_save("out.usdz"), uses=_HEAD, outputs=("out.usdz",)),
}
LONG = {"demo", "fit-photo", "neural-rig train", "neural-rig train plot", "rebuild", "refine-neutral", "train-photo"}
READERS = {"completion", "inspect", "validate", "view", "schema-path"}  # commands that write nothing


def make_material(folder: Path) -> None:
    """Write all inputs; the working folder is `folder` meanwhile."""
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()):
        for make in (_small_faces, _heads, _domes, _actor, _neural, _chain):
            make()


def _done(*words: object, code: int = 0) -> None:
    assert line(*words) == code, words


def _small_faces() -> None:
    import live_link
    from bone_faces import save_sources
    from cook_chain import TABLE
    from database_faces import person
    from network_faces import network, networked, save_network
    from obj_files import MTL, NEUTRAL, PNG
    from PIL import Image
    from small_sources import made

    from facepipe.stage import save_parts

    for seed, name in enumerate(("a", "b", "other")):
        save_parts(made(seed), f"{name}.usda")
    Path("points.json").write_text("[1, 2]")
    Path("table.toml").write_text(TABLE)
    _done("sliders", "a.usda", "--from", "table.toml", "--flatten", "-o", "slid.usda")
    _done("export", "a.usda", "-o", "a.onnx")
    _done("blend", "a.usda", "b.usda", "-o", "mix.usda")
    live_link.write(Path("take.csv"), live_link.performance(5))
    for seed in range(4):
        save_parts(person(seed), f"p{seed}.usda")
    _done("database", "create", "p0.usda", "p1.usda", "p2.usda", "-o", "people.fpdb")
    save_sources(Path())
    fit = ("fit-bones", "rig.usda", "--target", "talk", "--rounds", "0", "--limits", "limits.json")
    _done(*fit, "--threshold-mm", "50", "-o", "fitted.usda", "--coefficients", "clip.fpb")
    save_parts(networked(None), "netted.usda")
    save_network(Path("net.npz"), network())
    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[:, :8, 0], pixels[:, 8:, 1] = 255, 255
    Image.fromarray(pixels).save("map.png")
    Path("legend.json").write_text('{"#ff0000": "left", "#00ff00": "right"}')
    shapes = Path("shapes")
    (shapes / "maps").mkdir(parents=True)
    (shapes / "neutral.obj").write_text(NEUTRAL)
    (shapes / "jawOpen.obj").write_text(NEUTRAL.replace("v 1 1 0", "v 1 1 0.5"))
    (shapes / "face.mtl").write_text(MTL)
    (shapes / "maps" / "eye 1.png").write_bytes(PNG)
    Path("photos").mkdir()


def _heads() -> None:
    from baked_face import put_fitted
    from photographed_face import write_photos
    from small_head import make
    from turning_clip import write_video

    from facepipe.stage import save_parts

    write_video(Path("clip.mp4"), [np.full((64, 64, 3), 90, np.uint8)] * 2)
    parts = make(0)
    save_parts(parts, "head.usdc")
    write_photos(parts, Path())
    Path("photo").mkdir()
    painted = make(0, textures=16)
    put_fitted(painted, painted, Path("photo"), size=64, front=0.0)
    save_parts(parts, "textured.usdz")
    _done("export", "head.usdc", "-o", "head.glb")


def _domes() -> None:
    import scan_domes
    from rebuild_project import GAIN, PERSON, PROJECT, motion, put
    from skin_joints import without_joints

    from facepipe.scanning.database import save_database
    from facepipe.scans import ScanLandmarks
    from facepipe.stage import save_parts

    assert GAIN
    save_parts(scan_domes.face(), "dome.usda")
    save_parts(without_joints(scan_domes.face()), "bare.usda")
    joints = {"head": {"position": [0, 0, -20]}, "head/chin": {"position": [0, -30, 20]}}
    Path("joints.json").write_text(json.dumps({"unit": "mm", "joints": joints}))
    save_database(scan_domes.database(), Path("faces.fpdb"))
    scan, landmarks = scan_domes.scan(PERSON)
    put(Path(), "neutral", scan, landmarks)
    opened = scan_domes.POSE.scale * motion(scan_domes.grid(61)[0]) @ scan_domes.POSE.rotation.T
    own = scan_domes.grid(31)[0][scan_domes.face().meshes[0].landmarks["multipie68"].indices]
    marks = scan_domes.POSE.scale * motion(own) @ scan_domes.POSE.rotation.T
    put(Path(), "open", replace(scan, points=scan.points + opened), ScanLandmarks(points=landmarks.points + marks))
    fit = ("fit-neutral", "neutral.ply", "--template", "dome.usda", "--database", "faces.fpdb", "--unit", "cm")
    _done(*fit, "-o", "fitted_neutral.usda")
    project = Path("project")
    project.mkdir()
    for name in ("faces.fpdb", "neutral.ply", "neutral.landmarks.json", "open.ply", "open.landmarks.json"):
        shutil.copy(name, project)
    shutil.copy("dome.usda", project / "head.usda")
    (project / "anna.toml").write_text(PROJECT)


def _actor() -> None:
    from rebuild_stages import put_scans

    Path("actor").mkdir()
    files = put_scans(Path("actor"))
    _done(*(files["personal.usda"] if one == files["p.usda"] else one for one in files.personal()))
    for command in (files.register("open"), files.register("both")):
        _done(*command)


def _neural() -> None:
    from neural_training import turning_face

    from facepipe.stage import save_parts

    save_parts(turning_face(), "turning.usda")
    _done("neural-rig", "train", "turning.usda", *NEURAL, "-o", "head.fpnr")
    bake = ("bake", "turning.usda", "--sweep", "0", "--together", "0")
    _done(*bake, "--spread", "20", "-o", "frames.usdc")
    _done(*bake, "--spread", "4", "-o", "few.usdc")


def _chain() -> None:
    import cook_chain

    chain = Path("chain")
    chain.mkdir()
    for name in ("a.usda", "b.usda", "other.usda"):
        shutil.copy(name, chain)
    with contextlib.chdir(chain):
        Path("table.toml").write_text(cook_chain.TABLE)
        for words in cook_chain.LINES:
            _done(*words)
        cook_chain.change("a.usda")
