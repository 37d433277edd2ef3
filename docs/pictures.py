"""Draws the pictures of the docs: `python docs/pictures.py [NAME ...]`, all of them without names; `--list` lists them.

Those of scans and photos need ../shared/data, those of browsers node and chromium (and `npm ci` in tests/support/js),
that of Blender FACEPIPE_BLENDER_PYTHON, a Python with bpy, some the extras `train` and `lod`. People are of
`facepipe sample`.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import runpy
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import facepipe_web
import numpy as np
from facepipe_web import build
from PIL import Image, ImageChops

import facepipe
from facepipe.cli import main
from facepipe.geometry.similarity import robust_similarity
from facepipe.heads import make
from facepipe.heads.assembly import make_head
from facepipe.heads.people import BEARDS, HAIR, MODES, STYLES, Look
from facepipe.heads.surfaces import dressed
from facepipe.importers import ict, load
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_landmarks import read_scan_landmarks
from facepipe.parts import FaceParts, Material, Mesh
from facepipe.photo.pictures import wireframe
from facepipe.pictures import HeatMap, PictureOptions, contact_sheet, picture
from facepipe.pictures.camera import LENS, MARGIN, Camera, View, portrait
from facepipe.pictures.face_picture import poses
from facepipe.rig.trs import rotation_matrices
from facepipe.scanning.database import create_database, save_database
from facepipe.scanning.transfer.pictures import shown_faces
from facepipe.scanning.transfer.transfer import TransferReport
from facepipe.stage import Face, save_parts
from facepipe.verbs.blend import BlendOptions, BlendSession, Weights
from facepipe.verbs.blend.graph import mix
from facepipe.verbs.person_basis import head_basis
from facepipe.verbs.person_layers import encode_points
from facepipe.verbs.whole_faces import whole_face, whole_parts

HERE = Path(__file__).resolve().parent
DATA = HERE.parents[1] / "shared" / "data"
SCAN, PHOTO = DATA / "scans" / "LeePerrySmith.glb", DATA / "photos" / "astronaut.png"
ICT = DATA / "ict_facekit" / "ict_facekit.npz"
HEADS, SAMPLES = DATA / "heads", HERE.parent / "samples"
BODY = HEADS / "makehuman_base_body.obj"
SCRIPTS = HERE.parent / "tests" / "support" / "js"

Drawing = Callable[[Path], Image.Image]
PICTURES: dict[str, Drawing] = {}


def of_docs(draw: Drawing) -> Drawing:
    """Draws docs/NAME.png in a folder for what it needs on the way."""
    PICTURES[draw.__name__] = draw
    return draw


@of_docs
def demo(folder: Path) -> Image.Image:
    """The sample head and some of its shapes, by `facepipe demo`."""
    run("demo", folder / "demo")
    return Image.open(folder / "demo" / "sheet.png")


@of_docs
def people(folder: Path) -> Image.Image:
    """Twenty-four people of `facepipe sample`."""
    views: tuple[View, ...] = ("front", "three-quarter")
    faces = {seed: make(seed, textures=1024) for seed in range(1, 25)}
    drawn = [
        (f"seed {seed}", picture(parts, None, close(Face.from_parts(parts), 230, views[seed % 2])))
        for seed, parts in faces.items()
    ]
    return contact_sheet(drawn, columns=8)


@of_docs
def years(folder: Path) -> Image.Image:
    """A woman and a man at three ages."""
    drawn = []
    for seed, feminine in ((5, 1.0), (20, 0.0)):
        for age in (25.0, 45.0, 70.0):
            parts = make(seed, textures=2048, age=age, feminine=feminine)
            caption = f"--seed {seed} --age {age:g} --feminine {feminine:g}"
            drawn.append((caption, picture(parts, None, close(Face.from_parts(parts), 360))))
    return contact_sheet(drawn, columns=6)


@of_docs
def looks(folder: Path) -> Image.Image:
    """The average head in every style of hair and beard, from front, side and back."""
    bald = make_head(np.zeros(MODES))
    views: tuple[View, ...] = ("front", "side", (np.pi, 0.0))
    drawn: list[tuple[str, Image.Image]] = []
    for number, style in enumerate(STYLES):
        hair = ("black", "dark")[number % 2] if STYLES[style][1] == "coils.png" else tuple(HAIR)[number % len(HAIR)]
        tone = {"black": 8, "dark": 6, "brown": 4, "light": 3, "blond": 2, "red": 1}[hair]
        look = Look(tone=tone, style=style, hair=hair, eyes="dark" if tone > 5 else "blue")
        made = dressed(bald, look, 1024)
        drawn += [(style if view == "front" else "", picture(made, None, options(220, view))) for view in views]
    for beard in list(BEARDS)[1:]:
        made = dressed(bald, Look(tone=4, style="crop", hair="dark", whiskers=beard, beard=0.5), 1024)
        drawn += [(beard if view == "front" else "", picture(made, None, options(220, view))) for view in views]
    return contact_sheet(drawn, columns=6)


@of_docs
def sliders(folder: Path) -> Image.Image:
    """A person, and some of the sliders."""
    face = facepipe.open(person(folder, 3))
    settings = [
        *({}, {"noseWidth": 1.0, "noseLength": 1.0}, {"jawWidth": 1.0, "strongJaw": 1.0}),
        *({"age": 1.0, "eyeTilt": -1.0}, {"smile": 1.0, "lookLeft": 1.0}),
    ]
    seen, parts = close(face, 330, "three-quarter"), face.parts()
    names = [", ".join(f"{name} {value:g}" for name, value in values.items()) or "as drawn" for values in settings]
    drawn = [picture(parts, face.evaluate(sliders=values), seen) for values in settings]
    return contact_sheet(list(zip(names, drawn, strict=True)), columns=5)


@of_docs
def blend(folder: Path) -> Image.Image:
    """Two people, the second moved by 5 mm and turned by 3 degrees; eyes, brows and mouth of the second on the first.

    Averaged point by point, and blended in the gradient domain, with the same weights.
    """
    first, second = (bare(make(seed, textures=1024)) for seed in (10, 5))  # of one hair style, so of one topology
    axis, half = np.array([0.3, 1.0, 0.2]), np.radians(3.0) / 2
    turn = rotation_matrices(np.array([*(np.sin(half) * axis / np.linalg.norm(axis)), np.cos(half)]))
    moved = [replace(mesh, points=mesh.points @ turn.T + (0.3, 0.3, 0.265)) for mesh in second.meshes]
    faces = [Face.from_parts(first), Face.from_parts(replace(second, meshes=tuple(moved)))]
    session = BlendSession(faces, BlendOptions(align="none"))
    others = dict.fromkeys(("eyes", "eyebrows", "mouth"), (0.0, 1.0))
    result = session.neutral(Weights(regions=others, default=(1.0, 0.0)))
    given = session.sources.points
    seen = close(Face.from_parts(first), 400, "three-quarter")
    drawn = [
        ("A", picture(first, given[0], seen)),
        ("B, 5 mm and 3° off", picture(second, given[1], seen)),
        ("points averaged by region", picture(first, mix(result.shares, given), seen)),
        ("facepipe blend", picture(first, result.points, seen)),
    ]
    return contact_sheet(drawn, columns=4)


@of_docs
def person_bytes(folder: Path) -> Image.Image:
    """A blend by region as payloads of more and more bytes make it of the average head, and how far off they are."""
    head, sources = make(0, textures=1024), [bare(make(seed, textures=1024)) for seed in (10, 5)]
    session = BlendSession([Face.from_parts(one) for one in sources], BlendOptions())
    others = dict.fromkeys(("eyes", "mouth", "cheek"), (0.0, 1.0))
    basis, size = head_basis(), 300
    blended = 10 * session.neutral(Weights(regions=others, default=(1.0, 0.0))).points[: len(basis.mean)]
    body = basis.known(head, "head")
    seen = close(Face.from_parts(whole_parts(body, blended)), size, "three-quarter")
    drawn, heats = [("blend", picture(whole_parts(body, blended), None, seen))], []
    for most in (310, 830, 1300, 10_000):
        data, layers = encode_points(basis, blended, most=most)
        points, off = layers[-1].points, np.linalg.norm(layers[-1].points - blended, axis=1)
        parts = whole_parts(body, points)
        drawn.append((f"{len(data):,} bytes", picture(parts, None, seen)))
        heat = replace(seen, heatmap=HeatMap(values=off, label="distance", range=(0.0, 2.0)))
        heats.append((f"mean {off[basis.fitted].mean():.2f} mm", picture(parts, None, heat)))
    blank = Image.new("RGB", (size, size), "white")
    return contact_sheet([*drawn, ("", blank), *heats], columns=5)


@of_docs
def person_look(folder: Path) -> Image.Image:
    """Drawn people, and the standard head on which their payloads with looks are put."""
    save_parts(make(0, textures=1024), folder / "head.usdc")
    drawn = []
    for seed in (7, 13):
        own, sent, back = folder / f"{seed}.usdc", folder / f"{seed}.fpb", folder / f"{seed}_back.usdc"
        save_parts(make(seed, textures=1024), own)
        report = facepipe.person(own, out=sent, look=True, within=50.0)
        facepipe.apply_bones(folder / "head.usdc", sent, out=back)
        for path, label in ((own, f"seed {seed}"), (back, f"{report.bytes} bytes")):
            face = facepipe.open(path)
            drawn.append((label, picture(face.parts(), None, close(face, 300, "three-quarter"))))
    return contact_sheet(drawn, columns=4)


@of_docs
def person_page(folder: Path) -> Image.Image:
    """The page of samples/device in a phone's window: the standard head, the person of that portrait, and smiling."""
    make_page = runpy.run_path(str(HERE.parent / "samples" / "device" / "make_page.py"))
    if make_page["main"]([str(PHOTO), str(folder / "page")]):
        raise SystemExit("samples/device/make_page.py failed")
    names = ("head", "person", "smile")
    smile = "smile.value = 0.8, smile.dispatchEvent(new Event('input')), new Promise((done) => setTimeout(done, 1000))"
    presses = ({"click": "#head"}, {"click": "#person"}, {"run": smile})
    steps: list[dict[str, str]] = [{"wait": "body[data-state=ready]"}]
    for name, press in zip(names, presses, strict=True):
        steps += [press, {"picture": str(folder / f"{name}.png")}]
    with served(folder / "page") as url:
        browse(url, (390, 844), steps)
    whole = Image.new("RGB", (3 * 390 + 2 * 12, 844), "white")
    for number, name in enumerate(names):
        whole.paste(Image.open(folder / f"{name}.png"), (402 * number, 0))
    return whole


@of_docs
def bones(folder: Path) -> Image.Image:
    """Two shapes of a person: rest, target, what bones reach of it, what they leave, and what the residual adds."""
    names, head = ("jawOpen", "mouthSmileLeft"), person(folder, 10)
    facepipe.fit_bones(head, targets=names, residual=True, out=folder / "fitted.usdc")
    shaped, face, drawn = facepipe.open(head), facepipe.open(folder / "fitted.usdc"), []
    parts, plain, rest = face.parts(), close(face, 264, (0.3, 0.0), neck=2.0), face.evaluate()
    for name in names:
        local, weights = face.sample(name)
        target = shaped.evaluate({name: 1.0})
        reached, whole = (face.evaluate(given, joint_transforms=local) for given in ({}, weights))
        off, left = (np.linalg.norm(one - target, axis=1) * face.mm_per_unit for one in (reached, whole))
        heat = replace(plain, heatmap=HeatMap(values=off, range=(0.0, 5.0)))
        drawn += [
            ("rest", picture(parts, rest, plain)),
            (name, picture(parts, target, plain)),
            (f"bones: RMS {np.sqrt((off**2).mean()):.2f} mm", picture(parts, reached, plain)),
            (f"what they miss: {off.max():.1f} mm at most", picture(parts, reached, heat)),
            (f"bones + residual: {left.max():.1f} mm at most", picture(parts, whole, plain)),
        ]
    return contact_sheet(drawn, columns=5)


@of_docs
def lod(folder: Path) -> Image.Image:
    """A person and the levels of detail in an expression, shaded and as wire frames."""
    posed = {"jawOpen": 0.35, "mouthSmileLeft": 0.8, "mouthSmileRight": 0.5, "eyeBlinkLeft": 0.4, "browInnerUp": 0.6}
    report = facepipe.lod(person(folder, 3), out=folder / "lods.usdc", triangles=(20000, 8000, 2500))
    worst = [max(shape.mean_mm for shape in level.errors.shapes.values()) for level in report.levels]
    said = ["the face itself", *(f"{mm:.2f} mm off in the worst shape" for mm in worst)]
    full, above, below = facepipe.open(folder / "lods.usdc"), [], []
    camera = portrait(full.evaluate(), (0.35, 0.05), 330, 330)
    for number, words in enumerate(said):
        level = full.at_level(number)
        parts, points = level.parts(), level.evaluate(posed)
        image = picture(parts, points, PictureOptions(size=330, camera=camera))
        count = sum(int(mesh.face_vertex_counts.sum()) - 2 * len(mesh.face_vertex_counts) for mesh in level.meshes)
        above.append((f"lod{number}: {count:,} triangles", image))
        screen = camera.project(points)
        screen = np.concatenate([screen[:, :2] / screen[:, 3:], screen[:, 3:]], axis=1)
        wired = image.convert("RGB")
        wired.paste((24, 44, 96), (0, 0), wireframe(parts, screen, wired.size))
        below.append((words, wired))
    return contact_sheet([*above, *below], columns=len(said))


@of_docs
def photo(folder: Path) -> Image.Image:
    """The report page of a fit to a portrait of Eileen Collins (NASA, public domain) with its landmarks."""
    head, marks, shot = person(folder, 0), PHOTO.with_suffix(".landmarks.json"), folder / "shot.png"
    run("fit-photo", PHOTO, head, "--landmarks", marks, "-o", folder / "out.usda", "--report", folder / "report")
    page, size = folder / "report" / "report.html", (1240, 4000)  # more than it is high
    browse(page.as_uri(), size, [{"wait": "body"}, {"picture": str(shot)}])
    image = Image.open(shot).convert("RGB")
    used = ImageChops.difference(image, Image.new("RGB", image.size, "white")).getbbox() or (0, 0, 0, 0)
    return image.crop((0, 0, image.width, used[3] + 36))


@of_docs
def photo_face(folder: Path) -> Image.Image:
    """That portrait, and the face that `fit-photo` and `bake-photo` make of it, with nothing else given."""
    fitted, out = folder / "fitted.usdc", folder / "person.usdc"
    facepipe.fit_photo(person(folder, 0), photos=[PHOTO], out=fitted)
    facepipe.bake_photo(fitted, photos=[PHOTO], out=out)
    face = facepipe.open(out)
    parts, neutral = face.parts(), face.evaluate(pose="set")
    views: tuple[View, ...] = ("front", "three-quarter", "side")
    drawn = [("the photo", Image.open(PHOTO).convert("RGB").crop((140, 0, 320, 180)).resize((300, 300), 1))]
    drawn += [(str(view), picture(parts, neutral, close(face, 300, view))) for view in views]
    smiling = neutral + face.evaluate(both(0.7, "mouthSmile", "cheekSquint", "mouthUpperUp")) - face.evaluate()
    return contact_sheet([*drawn, ("smiling", picture(parts, smiling, close(face, 300)))], columns=5)


@of_docs
def scan_face(folder: Path) -> Image.Image:
    """A scan, and the face that `facepipe fit-neutral` makes of it, with nothing else given.

    "Infinite, 3D Head Scan" by Lee Perry-Smith (CC-BY 3.0, based on a work at www.triplegangers.com; www.ir-ltd.net).
    """
    marks, out = folder / "marks.json", folder / "face.usda"
    run("scan-landmarks", SCAN, "-o", marks)
    run("fit-neutral", SCAN, "--landmarks", marks, "-o", out)
    face, scan = facepipe.open(out), read_scan(SCAN)
    head = face.meshes[0]
    place = robust_similarity(read_scan_landmarks(marks).points, head.points[head.landmarks["multipie68"].indices])
    mesh = Mesh(
        name="Scan",
        points=place.apply(scan.points),
        face_vertex_counts=np.full(len(scan.triangles), 3, np.int32),
        face_vertex_indices=scan.triangles.ravel(),
        material="Clay",
    )
    clay = Material(name="Clay", diffuse_color=(0.5, 0.48, 0.46), roughness=0.7)
    given = FaceParts(name="Scan", meters_per_unit=face.meters_per_unit, meshes=(mesh,), materials=(clay,))
    front, turned, side = (close(face, 300, view, neck=3.0) for view in ("front", "three-quarter", "side"))
    parts, rest, drawn = face.parts(), face.evaluate(), []
    for seen in (front, turned):
        drawn += [("the scan", picture(given, None, seen)), ("the face", picture(parts, rest, seen))]
    drawn.append(("from the side", picture(parts, rest, side)))
    poses = {
        "jawOpen": {"jawOpen": 0.7},
        "smile": both(0.8, "mouthSmile", "cheekSquint"),
        "blink": both(1.0, "eyeBlink"),
    }
    for name, weights in poses.items():
        seen = turned if name == "smile" else front
        drawn.append((name, picture(parts, face.evaluate(weights), seen)))
    return contact_sheet(drawn, columns=4)


@of_docs
def own_head(folder: Path) -> Image.Image:
    """Heads of others on their own meshes, with shapes that `facepipe transfer` gave them.

    The scan: "Infinite, 3D Head Scan" by Lee Perry-Smith (CC-BY 3.0, www.triplegangers.com, www.ir-ltd.net).
    """
    runpy.run_path(str(SAMPLES / "foreign_head.py"))["main"]([str(folder / "hero.glb")])
    given = {
        "a person, remeshed": folder / "hero.glb",
        "ICT-FaceKit, warped": HEADS / "ict_stylised.obj",
        "a scan": SCAN,
    }
    drawn = []
    for name, head in given.items():
        out = folder / f"{head.stem}.usdc"
        report = facepipe.transfer(head, out=out)
        drawn += expressions(name, facepipe.open(out).parts(), report)
    sheet = contact_sheet(drawn, columns=len(drawn) // len(given)).convert("RGB")
    return sheet.quantize(palette=sheet.quantize(256))  # half the file


@of_docs
def rebuild_scan(folder: Path) -> Image.Image:
    """The same scan, and ICT-FaceKit (MIT license) fitted to it, with 60 people of that as database.

    20 landmarks are placed by hand (docs/rebuild_landmarks.json). The scan has closed eyes; the last picture is the
    neutral, with open ones.
    """

    def member(seed: int) -> Any:
        return whole_face(bare(load("ict", ICT, ict.Options(identity_seed=seed)).parts), f"person{seed}")

    head, faces, sheet = folder / "ict.usdc", folder / "faces.fpdb", folder / "sheet.png"
    save_database(create_database([functools.partial(member, seed) for seed in range(60)]).database, faces)
    run("import", "ict", ICT, head)
    given = ("--template", head, "--database", faces, "--landmarks", HERE / "rebuild_landmarks.json")
    closed = ("--weights", "eyeBlink_L=1", "eyeBlink_R=1")
    run("fit-neutral", SCAN, *given, *closed, "-o", folder / "person.usdc", "--picture", sheet)
    image = Image.open(sheet).convert("RGB")
    return image.resize((900, round(image.height * 900 / image.width)), Image.Resampling.LANCZOS)


@of_docs
def three(folder: Path) -> Image.Image:
    """GLBs of two people in three.js beside facepipe's own pictures, by the same cameras."""
    drawn = []
    for seed, shapes in ((4, {}), (9, both(0.8, "mouthSmile") | {"jawOpen": 0.25})):
        file, glb = person(folder, seed, f"person{seed}"), folder / f"{seed}.glb"
        facepipe.export(file, glb)
        face = facepipe.open(file)
        camera = portrait(face.evaluate(), "three-quarter", 480, 480)
        cell = {"file": glb.name, "shapes": shapes, **in_three(camera, face.meters_per_unit)}
        own = picture(face.parts(), face.evaluate(shapes), options(480, camera=camera))
        drawn += [
            (f"seed {seed}, three.js", in_browser(folder, [cell], 480)[0]),
            (f"seed {seed}, facepipe render", own),
        ]
    return contact_sheet(drawn, columns=4)


@of_docs
def shading(folder: Path) -> Image.Image:
    """An eye in three.js as loaded and with its highlights added, in Babylon.js, and in facepipe's picture."""
    file = person(folder, 0)
    facepipe.export(file, folder / "eye.glb")
    face = facepipe.open(file)
    parts = face.parts()
    eye = next(mesh for mesh in parts.meshes if mesh.name == "EyeballLeft")
    camera = portrait(np.asarray(eye.points), "front", 320, 320)
    cell = {"file": "eye.glb", **in_three(camera, face.meters_per_unit)}
    drawn = [
        *zip(("three.js", "three.js, added"), in_browser(folder, [cell, cell | {"added": True}], 320), strict=True),
        ("Babylon.js", in_browser(folder, [cell], 320, BABYLON)[0]),
        ("facepipe", picture(parts, None, options(320, camera=camera))),
    ]
    return contact_sheet(drawn, columns=4)


@of_docs
def hair(folder: Path) -> Image.Image:
    """Hair from the front, the side and behind, in facepipe's pictures, in three.js and in Babylon.js."""
    bald, drawn = bare(make_head(np.zeros(MODES))), []
    views: tuple[View, ...] = ("front", "side", (np.pi, 0.0))
    for style, colour, tone in (("crop", "brown", 3), ("bob", "red", 1), ("long", "dark", 5), ("afro", "black", 8)):
        parts = replace(dressed(bald, Look(tone=tone, style=style, hair=colour), 1024), animations=(), sliders=())
        face, glb = Face.from_parts(parts), f"{style}.glb"
        facepipe.export(face, folder / glb)
        cameras = [close_camera(face, 220, view, 4.0) for view in views]
        cells = [{"file": glb, **in_three(camera, face.meters_per_unit)} for camera in cameras]
        own = [picture(parts, None, options(220, camera=camera)) for camera in cameras]
        for program, pictures in (
            ("facepipe", own),
            ("three.js", in_browser(folder, cells, 220)),
            ("Babylon.js", in_browser(folder, cells, 220, BABYLON)),
        ):
            drawn += zip((f"{style}, {program}", "", ""), pictures, strict=True)
    return contact_sheet(drawn, columns=9)


@of_docs
def wrinkles(folder: Path) -> Image.Image:
    """Expressions without and with wrinkles, in facepipe's pictures and in three.js, which the viewer's page runs."""
    moods = {
        "smile": both(1.0, "mouthSmile") | both(0.7, "cheekSquint"),
        "sneer": both(1.0, "noseSneer") | both(0.8, "browDown"),
        "brows up": {"browInnerUp": 1.0} | both(1.0, "browOuterUp"),
    }
    file = person(folder, WRINKLED)
    face = facepipe.open(file)
    camera, parts = close_camera(face, 400, "front", 1.0), face.parts()
    view = {**in_three(camera, face.meters_per_unit), "size": 400, "moods": list(moods.values())}
    drawn = []
    for shapes in moods.values():
        points, plain = face.evaluate(shapes), options(400, camera=camera)
        drawn += [picture(parts, points, plain), picture(parts, points, replace(plain, weights=shapes))]
    page = viewed(folder, file, WITH_AND_WITHOUT.replace("VIEW", json.dumps(view)), width=2400)
    drawn += [page.crop((400 * i, 0, 400 * i + 400, 400)) for i in range(2 * len(moods))]
    names = [f"{name}{what}" for name in moods for what in ("", ", wrinkled")]
    return contact_sheet([*zip(names + [f"three.js: {name}" for name in names], drawn, strict=True)], columns=6)


# pictures of moods, each without and with wrinkles, in place of the viewer's page
WITH_AND_WITHOUT = """(async () => {
  const { eye, at, angle, size, moods } = VIEW, face = facepipe.face(), { renderer, scene, camera } = facepipe.picture;
  const sheet = Object.assign(document.createElement("canvas"), { width: 2 * size * moods.length, height: size });
  const pen = sheet.getContext("2d"), drawn = new Map();
  for (const { primitives } of face.meshes) for (const one of primitives) drawn.set(one, one.onBeforeRender);
  renderer.setPixelRatio(1), renderer.setSize(2 * size, 2 * size), renderer.setScissorTest(false);
  Object.assign(camera, { fov: angle, aspect: 1, near: 0.01, far: 5 }), camera.updateProjectionMatrix();
  camera.position.set(...eye), camera.lookAt(...at), camera.updateMatrixWorld(true);
  scene.background.set(0xc4c9d2);
  let column = 0;
  for (const mood of moods) {
    for (const wrinkled of [false, true]) {
      await face.reset();
      if (wrinkled) for (const [one, own] of drawn) one.onBeforeRender = own;
      else renderer.render(scene, camera), drawn.forEach((_, one) => (one.onBeforeRender = () => {}));
      await face.setShapes(mood);
      renderer.render(scene, camera);
      pen.drawImage(renderer.domElement, size * column++, 0, size, size);
    }
  }
  sheet.style = "position:fixed;inset:0;z-index:9";
  document.body.append(sheet);
})()"""
WRINKLED = 24  # seed of who is drawn


@of_docs
def vrm(folder: Path) -> Image.Image:
    """VRM's presets, single expressions, looks and a turned head as three-vrm shows a person."""
    names = (
        *("neutral", "happy", "angry", "sad", "relaxed", "surprised", "blink", "blinkLeft", "blinkRight"),
        *("aa", "ih", "ou", "ee", "oh", "look up", "look down", "look left", "head turned"),
    )
    ways = {"look up": (0, 0.4, 1), "look down": (0, -0.45, 1), "look left": (0.5, 0, 1)}
    file, terms = folder / "person.vrm", ("--authors", "facepipe", "--license-url", "https://vrm.dev/licenses/1.0/")
    run("export", person(folder, 5), "-o", file, "--stub-body", *terms)
    face = facepipe.read(file, "gltf")
    view = in_three(close_camera(face, 210, (0.12, 0.0), 2.0), face.meters_per_unit)
    cells = [{"file": file.name, "name": name, "way": ways.get(name), **view} for name in names]
    return contact_sheet(list(zip(names, in_browser(folder, cells, 210), strict=True)), columns=6)


@of_docs
def web(folder: Path) -> Image.Image:
    """The viewer's page: a person, posed and coloured by distance, and the neutral."""
    posed = """(() => {
      const wanted = { smile: 0.9, mouthOpen: 0.3 };
      for (const [name, value] of Object.entries(wanted)) {
        const number = document.querySelector(`.row[data-name="${name}"] input[type="number"]`);
        number.value = value;
        number.dispatchEvent(new Event("change"));
      }
      for (const one of document.querySelectorAll("details")) one.open = /^expression/.test(one.textContent);
    })()"""
    return viewed(folder, person(folder, 3), posed, "distance", "split")


@of_docs
def web_blend(folder: Path) -> Image.Image:
    """The viewer's page with a blend of two people."""
    sources, child = (person(folder, 3), person(folder, 8, "bea")), folder / "child.usdc"
    run("blend", *sources, "-o", child, "--set", "eyes=0.2,0.8", "--set", "mouth=0,1", "--default", "0.6,0.4")
    unfolded = """(() => {
      const folds = document.querySelectorAll("section[aria-label=Blend] details");
      for (const one of folds) one.open = /^(all|eyes|mouth|nose)/.test(one.textContent);
    })()"""
    return viewed(folder, child, unfolded, "regions")


@of_docs
def studio(folder: Path) -> Image.Image:
    """The studio's page with a blend of two people, the mouth the second one's."""
    drag = """(async () => {
      const until = async (look) => { while (!look()) await new Promise((done) => setTimeout(done, 100)); };
      const { studio } = facepipe;
      const { faces } = await (await fetch("api/v1/faces")).json();
      await studio.addToBlend(faces[0]);
      await until(() => studio.bench.face);
      await studio.addToBlend(faces[1]);
      await studio.route();
      await until(() => document.body.dataset.live);
      studio.bench.picked("mouth");
      const range = document.querySelector("details[data-region=mouth] input[type=range]");
      range.value = 1;
      for (const one of ["input", "change"]) range.dispatchEvent(new Event(one));
      delete document.body.dataset.live;
      await until(() => document.body.dataset.live === "settled");
      await until(() => [...document.querySelectorAll(".sources img")].every((one) => one.src && one.complete));
    })()"""
    return in_studio(folder, {"run": drag})


@of_docs
def studio_sliders(folder: Path) -> Image.Image:
    """The studio's page with sliders of the nose."""
    search = """(async () => {
      const { studio } = facepipe;
      const { faces } = await (await fetch("api/v1/faces")).json();
      await studio.editSliders(faces[0]);
      while (!document.querySelector("[data-name=noseWidth]")) await new Promise((done) => setTimeout(done, 100));
      const search = document.querySelector("input[type=search]");
      search.value = "nose";
      search.dispatchEvent(new Event("input"));
      for (const [name, value] of [["noseWidth", 1], ["noseLength", 0.7]]) {
        const range = document.querySelector(`[data-name=${name}] input[type=range]`);
        range.value = value;
        for (const one of ["input", "change"]) range.dispatchEvent(new Event(one));
      }
    })()"""
    return in_studio(folder, {"run": search})


@of_docs
def studio_library(folder: Path) -> Image.Image:
    """The studio's page with faces that are kept."""
    show = """(async () => {
      await facepipe.studio.route();
      const pictures = () => [...document.querySelectorAll(".card > img")];
      const drawn = () => pictures().length && pictures().every((one) => one.src && one.complete);
      while (!drawn()) await new Promise((done) => setTimeout(done, 100));
    })()"""
    return in_studio(folder, {"run": show}, seeds=(1, 3, 4, 7))


@of_docs
def studio_photo(folder: Path) -> Image.Image:
    """The studio's page with the landmarks that were found on a photo."""
    photo = ["#panel input[type=file] >> nth=1", str(PHOTO)]
    go = {"run": "location.hash = '#photo'"}
    agree = {"click": "#agreed"}
    find = {"click": "text=Find the face"}
    found = {"wait": "body[data-landmarks]"}
    return in_studio(folder, go, {"upload": photo}, agree, find, found, seeds=())


def in_studio(folder: Path, *steps: dict[str, Any], seeds: tuple[int, ...] = (1, 4)) -> Image.Image:
    """The studio of a server with sample heads, after some steps."""
    if not build.is_built():
        build.build()
    line = [sys.executable, "-m", "facepipe", "serve", str(folder / "faces"), "--port", "0"]
    quiet: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with subprocess.Popen(line, **quiet) as server:
        assert server.stdout is not None
        url = server.stdout.readline().split()[0]
        try:
            samples = """(async () => {
              const headers = { "Content-Type": "application/json" };
              for (const seed of SEEDS) {
                const fields = { seed, textures: 1024 };
                const body = JSON.stringify({ action: "sample", name: `Sample ${seed}`, fields });
                let job = await (await fetch("api/v1/jobs", { method: "POST", headers, body })).json();
                while (job.state !== "done") {
                  await new Promise((done) => setTimeout(done, 500));
                  job = await (await fetch(`api/v1/jobs/${job.id}`)).json();
                }
              }
            })()""".replace("SEEDS", str([*seeds]))
            ready = {"wait": "body[data-state=ready]"}
            still = {"run": "new Promise((done) => setTimeout(done, 3000)).then(() => document.activeElement.blur())"}
            picture = {"picture": str(folder / "page.png")}
            browse(f"{url}studio.html", (1280, 800), [ready, {"run": samples}, *steps, still, picture])
        finally:
            server.terminate()
    return Image.open(folder / "page.png")


def expressions(name: str, parts: FaceParts, report: TransferReport) -> list[tuple[str, Image.Image]]:
    """The mesh of a head as a wire frame, and some of the shapes that it got, in pictures of the face."""
    weights: dict[str, dict[str, float]] = {
        name: {},
        "jawOpen": {"jawOpen": 0.8},
        "mouthSmile": both(1.0, "mouthSmile", "cheekSquint"),
        "mouthPucker": {"mouthPucker": 1.0},
        "eyeBlinkLeft, browDown": {"eyeBlinkLeft": 1.0} | both(1.0, "browDown"),
    }
    whole = whole_face(parts, name)
    posed = []
    for pose in weights.values():
        moved = (one * whole.deltas[shape] for shape, one in pose.items() if shape in whole.deltas)
        posed.append(report.place.apply(sum(moved, whole.points)))
    placed = shown_faces(whole_parts(parts, posed[0]), report.shown)
    chin = report.framing - (0.0, 0.2 * np.ptp(report.framing[:, 1]), 0.0)  # as far down as jaws open
    camera = portrait(np.concatenate([report.framing, chin]), (0.5, 0.05), 190, 190)
    plain = replace(options(190, camera=camera), background=(0.9, 0.91, 0.93))
    images = [image.convert("RGB") for image in poses(placed, posed, plain)]
    screen = camera.project(posed[0])
    screen = np.concatenate([screen[:, :2] / screen[:, 3:], screen[:, 3:]], axis=1)
    images[0].paste((24, 44, 96), (0, 0), wireframe(placed, screen, images[0].size))
    return list(zip(weights, images, strict=True))


@of_docs
def blender(folder: Path) -> Image.Image:
    """MakeHuman's body in Blender: as it came, and with shapes that the button added, drawn by Cycles."""
    marks = folder / "body.landmarks.json"
    facepipe.scan_landmarks(BODY, out=marks)
    poses: dict[str, dict[str, float]] = {
        "as it came": {},
        "jawOpen": {"jawOpen": 0.8},
        "mouthSmile, cheekSquint": both(1.0, "mouthSmile") | both(0.7, "cheekSquint"),
        "eyeBlink, mouthPucker": both(1.0, "eyeBlink") | {"mouthPucker": 1.0},
    }
    root, scripts = HERE.parent, SCRIPTS.parent / "blender"
    paths = map(str, (root, root / "schemas", root / "exporters", scripts))
    words = [json.dumps(one) for one in (str(BODY), str(marks), [*poses.values()], str(folder))]
    subprocess.run(
        [os.environ["FACEPIPE_BLENDER_PYTHON"], scripts / "draw_head.py", *words],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        check=True,
    )
    drawn = [(name, Image.open(folder / f"{number}.png").convert("RGB")) for number, name in enumerate(poses)]
    return contact_sheet(drawn, columns=4)


def person(folder: Path, seed: int, name: str = "anna") -> Path:
    """A person of the sample, saved."""
    path = folder / f"{name}.usdc"
    facepipe.sample(path, seed=seed, textures=1024)
    return path


def both(weight: float, *shapes: str) -> dict[str, float]:
    """Shapes on both sides."""
    return {f"{name}{side}": weight for name in shapes for side in ("Left", "Right")}


def bare(parts: FaceParts) -> FaceParts:
    """A head without expressions, where they would only take time."""
    return replace(parts, meshes=tuple(replace(mesh, blendshapes=()) for mesh in parts.meshes))


def run(*words: object) -> None:
    """A facepipe command; 1 says that something could be better."""
    if main([str(word) for word in words]) > 1:
        raise SystemExit(f"facepipe {words[0]} failed")


def options(size: int, view: View = "front", camera: Camera | None = None) -> PictureOptions:
    """A picture."""
    return PictureOptions(size=size, view=view, camera=camera)


def close(face: Face, size: int, view: View = "front", neck: float = 6.0) -> PictureOptions:
    """A picture of the head alone, down to `neck` cm below the chin."""
    return options(size, camera=close_camera(face, size, view, neck))


def close_camera(face: Face, size: int, view: View, neck: float) -> Camera:
    """Its camera."""
    points, (mesh, marks) = face.evaluate(pose="set"), face.landmarks()
    chin = face.split(points)[mesh.name][marks.indices[8], 1]
    return portrait(points[points[:, 1] > chin - neck / (100 * face.meters_per_unit)], view, size, size)


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a folder's files while the block lasts."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()


def browse(url: str, size: tuple[int, int], steps: list[dict[str, Any]]) -> None:
    """A page in Chromium, and what is done there."""
    node, chromium = shutil.which("node"), shutil.which("chromium") or shutil.which("google-chrome")
    if node is None or chromium is None:
        raise SystemExit("needs node and chromium on the PATH")
    if not build.is_built():
        build.build()
    words: list[str | Path] = [
        node,
        SCRIPTS / "browse.mjs",
        build.HERE / "node_modules" / "playwright-core" / "index.mjs",
        chromium,
    ]
    request = json.dumps({"url": url, "viewport": size, "steps": steps})
    done = subprocess.run(words, input=request, text=True, check=False, capture_output=True)
    problems = done.stderr if done.returncode else "\n".join(json.loads(done.stdout)["problems"])
    if problems:
        raise SystemExit(problems)


def viewed(folder: Path, face: Path, script: str, *buttons: str, width: int = 1280) -> Image.Image:
    """The page of `facepipe view` after a script and some buttons."""
    if not build.is_built():
        build.build()
    press = [{"click": f'button[data-value="{value}"]'} for value in buttons]
    settled = {"run": "new Promise((done) => setTimeout(done, 3000)).then(() => document.activeElement.blur())"}
    steps = [
        {"wait": "body[data-state=ready]"},
        {"run": script},
        *press,
        settled,
        {"picture": str(folder / "page.png")},
    ]
    with facepipe_web.view([face], facepipe_web.Options()) as page:
        thread = threading.Thread(target=page.serve)
        thread.start()
        try:
            browse(page.url, (width, 720), steps)
        finally:
            page.close()
            thread.join()
    return Image.open(folder / "page.png")


def in_three(camera: Camera, meters: float) -> dict[str, Any]:
    """A camera of a square picture, as the page below has it."""
    eye, angle = camera.eye * meters, np.degrees(2 * np.arctan(LENS / (1 - 2 * MARGIN)))
    return {"eye": eye.tolist(), "at": (eye - camera.axes[2]).tolist(), "angle": float(angle)}


def in_browser(folder: Path, cells: list[dict[str, Any]], size: int, page: str = "") -> list[Image.Image]:
    """Square pictures of GLBs and VRMs in the folder, as three.js and three-vrm, or another page, draw them."""
    given, size = size, 2 * size  # hair with an alpha test is ragged at one sample a pixel
    columns, shot = min(len(cells), 6), folder / "shot.png"
    rows = -(-len(cells) // columns)
    if not (folder / "node_modules").exists():
        (folder / "node_modules").symlink_to(SCRIPTS / "node_modules")
    request = json.dumps({"cells": cells, "size": size, "columns": columns, "rows": rows})
    (folder / "index.html").write_text((page or PAGE).replace("REQUEST", request))
    with served(folder) as url:
        browse(url, (size * columns, size * rows), [{"wait": "body[data-state]"}, {"picture": str(shot)}])
    image, corners = Image.open(shot), (divmod(number, columns) for number in range(len(cells)))
    drawn = (image.crop((x * size, y * size, (x + 1) * size, (y + 1) * size)) for y, x in corners)
    return [one.convert("RGB").resize((given, given), Image.Resampling.BOX) for one in drawn]


PAGE = """<!doctype html><link rel="icon" href="data:,"><style>body{margin:0;overflow:hidden}</style>
<script type="importmap">{"imports": {"three": "./node_modules/three/build/three.module.js",
"three/addons/": "./node_modules/three/examples/jsm/",
"@pixiv/three-vrm": "./node_modules/@pixiv/three-vrm/lib/three-vrm.module.min.js"}}</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { RoomEnvironment } from "three/addons/environments/RoomEnvironment.js";
import { VRMLoaderPlugin } from "@pixiv/three-vrm";
const { cells, size, columns, rows } = REQUEST;
const renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
renderer.setSize(size * columns, size * rows);
renderer.toneMapping = THREE.ACESFilmicToneMapping;
document.body.append(renderer.domElement);
const scene = new THREE.Scene();
scene.background = new THREE.Color(0xc4c9d2);
scene.environment = new THREE.PMREMGenerator(renderer).fromScene(new RoomEnvironment(), 0.04).texture;
scene.environmentIntensity = 0.7;
const key = new THREE.DirectionalLight(0xffffff, 1.2);
key.position.set(-1, 1.5, 2);
scene.add(key);
renderer.setScissorTest(true);
const loader = new GLTFLoader().register((parser) => new VRMLoaderPlugin(parser));
const loaded = {};
for (const [i, cell] of cells.entries()) {
  const { scene: head, userData: { vrm } } = (loaded[cell.file] ??= await loader.loadAsync(cell.file));
  scene.add(head);
  head.traverse((one) => {
    one.frustumCulled = false;
    for (const [name, value] of Object.entries(cell.shapes ?? {})) {
      const index = one.morphTargetDictionary?.[name];
      if (index !== undefined) one.morphTargetInfluences[index] = value;
    }
  });
  const corneas = [];
  head.traverse((one) => cell.added && one.material?.name === "Cornea" && corneas.push(one));
  for (const cornea of corneas) {
    const gloss = cornea.clone();
    gloss.material = cornea.material.clone();
    Object.assign(gloss.material, { blending: THREE.AdditiveBlending, map: null, opacity: 1 });
    gloss.material.color.set(0);
    cornea.parent.add(gloss);
  }
  if (vrm) {
    vrm.humanoid.resetNormalizedPose();
    vrm.expressionManager.resetValues();
    vrm.lookAt.reset();
    vrm.update(0);
    if (vrm.expressionManager.getExpression(cell.name)) vrm.expressionManager.setValue(cell.name, 1);
    const eyes = vrm.lookAt.getLookAtWorldPosition(new THREE.Vector3());
    if (cell.way) vrm.lookAt.lookAt(eyes.add(new THREE.Vector3(...cell.way)));
    if (cell.name === "head turned") vrm.humanoid.getNormalizedBoneNode("head").rotation.set(0.1, 0.5, 0.1);
    vrm.update(0);
  }
  const camera = new THREE.PerspectiveCamera(cell.angle, 1, 0.01, 20);
  camera.position.set(...cell.eye);
  camera.lookAt(...cell.at);
  const place = [(i % columns) * size, (rows - 1 - Math.floor(i / columns)) * size, size, size];
  renderer.setViewport(...place);
  renderer.setScissor(...place);
  renderer.render(scene, camera);
}
document.body.dataset.state = "ready";
</script>"""

BABYLON = """<!doctype html><link rel="icon" href="data:,"><style>body{margin:0;overflow:hidden}</style>
<script type="importmap">{"imports": {"@babylonjs/core/": "./node_modules/@babylonjs/core/",
"@babylonjs/loaders/": "./node_modules/@babylonjs/loaders/"}}</script>
<script type="module">
import { FreeCamera } from "@babylonjs/core/Cameras/freeCamera.js";
import { Engine } from "@babylonjs/core/Engines/engine.js";
import { DirectionalLight } from "@babylonjs/core/Lights/directionalLight.js";
import { HemisphericLight } from "@babylonjs/core/Lights/hemisphericLight.js";
import { LoadAssetContainerAsync } from "@babylonjs/core/Loading/sceneLoader.js";
import { Color3, Color4 } from "@babylonjs/core/Maths/math.color.js";
import { Viewport } from "@babylonjs/core/Maths/math.viewport.js";
import { Vector3 } from "@babylonjs/core/Maths/math.vector.js";
import { Scene } from "@babylonjs/core/scene.js";
import "@babylonjs/core/Materials/Textures/Loaders/index.js";
import "@babylonjs/loaders/glTF/2.0/index.js";
const { cells, size, columns, rows } = REQUEST;
const canvas = Object.assign(document.createElement("canvas"), { width: size * columns, height: size * rows });
document.body.append(canvas);
const engine = new Engine(canvas, true, { preserveDrawingBuffer: true });
const scene = new Scene(engine);
scene.useRightHandedSystem = true;
scene.autoClear = false;
scene.imageProcessingConfiguration.toneMappingEnabled = true;
scene.imageProcessingConfiguration.toneMappingType = 1; // ACES
const sky = new HemisphericLight("sky", new Vector3(0, 1, 0.3), scene);
sky.intensity = 1.6;
sky.groundColor = new Color3(0.5, 0.48, 0.45);
new DirectionalLight("key", new Vector3(1, -1.5, -2), scene).intensity = 2.5;
const loaded = {};
engine.clear(new Color4(0.77, 0.79, 0.82, 1), true, true);
for (const [i, cell] of cells.entries()) {
  loaded[cell.file] ??= await LoadAssetContainerAsync(cell.file, scene);
  loaded[cell.file].addAllToScene();
  const camera = new FreeCamera(`camera${i}`, new Vector3(...cell.eye), scene);
  camera.setTarget(new Vector3(...cell.at));
  camera.fov = (cell.angle * Math.PI) / 180;
  [camera.minZ, camera.maxZ] = [0.01, 20];
  const row = rows - 1 - Math.floor(i / columns);
  camera.viewport = new Viewport((i % columns) / columns, row / rows, 1 / columns, 1 / rows);
  scene.activeCamera = camera;
  await scene.whenReadyAsync();
  scene.render();
  loaded[cell.file].removeAllFromScene();
}
document.body.dataset.state = "ready";
</script>"""


def draw(names: list[str]) -> None:
    """Draw and save."""
    for name in names or PICTURES:
        with tempfile.TemporaryDirectory() as folder:
            image = PICTURES[name](Path(folder))
            image = image if image.mode == "P" else image.convert("RGB")
            image.save(HERE / f"{name}.png", optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--list", action="store_true")
    given = parser.parse_args()
    if unknown := {*given.names} - {*PICTURES}:
        parser.error(f"no such picture: {', '.join(sorted(unknown))}")
    if given.list:
        sys.stdout.writelines(f"{name}: {(one.__doc__ or '').splitlines()[0]}\n" for name, one in PICTURES.items())
    else:
        draw(given.names)
