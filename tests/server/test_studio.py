"""The studio in headless Chromium, on a real server: what is clicked together there is what the command makes."""

from __future__ import annotations

import base64
import dataclasses
import json
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import browser
import numpy as np
import pytest
from browser import Step, browse
from command_line import exit_code
from faces import tiny_face
from import_data import shared
from PIL import Image
from served import Serve, Served, ended, kept, saved
from slider_faces import sample_with_sliders

import facepipe
from facepipe.importers import read_face
from facepipe.parts import Slider

pytestmark = [pytest.mark.gate, pytest.mark.slow]


def when(condition: str, seconds: int = 240) -> Step:
    """A step that waits for JavaScript to be true, and gives what it then is; `bench` has the picture."""
    look = f"() => {{ const bench = globalThis.facepipe?.studio.bench; return {condition}; }}"
    poll = f"for (let i = 0; i < {20 * seconds} && !(found = look()); i++)"
    wait = "await new Promise((done) => setTimeout(done, 50));"
    said = json.dumps(f"did not come: {condition}: ")
    told = f"if (!found) throw new Error({said} + document.body.innerText.slice(-300));"
    return {"run": f"(async () => {{ const look = {look}; let found; {poll} {wait} {told} return found; }})()"}


READY = when("document.body.dataset.state === 'ready'")


def slide(selector: str, value: float) -> Step:
    """A step that moves a slider and lets it go."""
    find = f"const range = document.querySelector({json.dumps(selector)}); range.value = {value};"
    events = "for (const one of ['input', 'change']) range.dispatchEvent(new Event(one));"
    return {"run": f"(() => {{ {find} {events} }})()"}


def click_on(region: str) -> Step:
    """A step that clicks a place of the picture whose region this is."""
    return {
        "run": f"""(async () => {{
          const bench = facepipe.studio.bench, {{ canvas }} = bench.picture;
          const {{ left, top, width, height }} = canvas.getBoundingClientRect();
          for (let y = 0.1; y < 0.95; y += 0.05) for (let x = 0.2; x < 0.8; x += 0.05) {{
            const at = {{ clientX: left + x * width, clientY: top + y * height, pointerId: 1, bubbles: true }};
            if (bench.regionAt(at.clientX, at.clientY) !== {json.dumps(region)}) continue;
            for (const one of ["pointerdown", "pointerup"]) canvas.dispatchEvent(new PointerEvent(one, at));
            return document.querySelector("details[data-region][open]").dataset.region;
          }}
          return null;
        }})()"""
    }


def to_blend(name: str) -> list[Step]:
    card = f".card:has-text('{name}')"
    return [{"click": "#parts a:has-text('Library')"}, {"wait": card}, {"click": card}, {"click": "text=Add to blend"}]


def extracted(server: Served, folder: Path) -> Path:
    """All faces that are kept, as they lie in the export."""
    with zipfile.ZipFile(BytesIO(server.client.get("/api/v1/me/export").content)) as export:
        export.extractall(folder)
    return folder / "faces"


def test_two_heads_are_blended_by_clicks_and_cook_makes_the_same_bytes(shared_server: Served, tmp_path: Path) -> None:
    """What the page shows as its last state has the points of what is saved."""
    browser.chromium()
    heads = [saved(sample_with_sliders(), tmp_path / "one.usdc")]
    parts = sample_with_sliders()
    rng = np.random.default_rng(1)
    meshes = [
        dataclasses.replace(mesh, points=mesh.points + rng.normal(0, 0.002, 3) * (1 + mesh.points))
        for mesh in parts.meshes
    ]
    heads.append(saved(dataclasses.replace(parts, meshes=tuple(meshes)), tmp_path / "two.usdc"))
    ids = [kept(shared_server.client, head, f"Studio {name}") for head, name in zip(heads, ("one", "two"), strict=True)]
    region = "mouth"
    points = "bench.face.face.meshes.map((one) => [one.name, [...bench.face.face.points(one.name)]])"
    results, problems = browse(
        f"{shared_server.url}studio.html",
        READY,
        *to_blend("Studio one"),
        when("bench.face !== null"),
        *to_blend("Studio two"),
        when("document.body.dataset.live === 'settled'"),
        click_on(region),
        {"run": "delete document.body.dataset.live"},
        slide("details[data-region][open] input[type=range]", 0.9),
        when("document.body.dataset.live === 'settled'"),
        {"run": "delete document.body.dataset.live"},
        slide("details[data-region=default] input[type=range]", 0.25),
        when("document.body.dataset.live === 'settled'"),
        {"click": "text=Undo"},
        {"click": "text=Redo"},
        {"run": "new Promise((done) => setTimeout(done, 1000))"},
        when("document.body.dataset.live === 'settled'"),
        {"run": f"(() => {{ const bench = facepipe.studio.bench; return {points}; }})()"},
        {"fill": ["input[aria-label='Name of the blend']", "Child"]},
        {"click": "section[aria-label=Save] button"},
        when("document.body.dataset.saved"),
    )
    assert problems == []
    assert region in results
    shown: list[Any] = next(one for one in reversed(results) if isinstance(one, list))
    face, version = results[-1].split("/")
    folder = extracted(shared_server, tmp_path / "export")
    stage = folder / face / version / "face.usdc"
    recipe = facepipe.open(stage).parts().recipe
    assert recipe is not None
    weights = dict(recipe.options)["weights"]
    assert weights["default"] == pytest.approx([0.75, 0.25])
    assert weights["regions"][region] == pytest.approx([0.1, 0.9])
    assert {
        one["face"] for one in shared_server.client.get(f"/api/v1/faces/{face}").json()["versions"][0]["sources"]
    } == {*ids}
    content = stage.read_bytes()
    assert exit_code("cook", stage, "--force", "--root", folder.parent) == 0
    assert stage.read_bytes() == content
    child = facepipe.open(stage)
    whole = child.evaluate(pose="set") @ child.parts().gltf_axes[:3, :3].T
    by_name = dict(
        zip(
            [mesh.name for mesh in child.parts().meshes],
            np.split(whole, np.cumsum([len(mesh.points) for mesh in child.parts().meshes])[:-1]),
            strict=True,
        )
    )
    height = child.head_height * child.meters_per_unit
    for name, values in shown:
        off = np.abs(np.array(values).reshape(-1, 3) - by_name[name]).max()
        assert off < 1e-3 * height, name


def test_sliders_are_saved_as_a_version_whose_values_they_are(shared_server: Served, tmp_path: Path) -> None:
    """Mirrored to the other side, undone and done again."""
    browser.chromium()
    parts = sample_with_sliders()
    pair = [
        Slider(name=f"pinch{side}", shapes=((f"mouthSmile{side}", 0.5),), mirror=f"pinch{other}")
        for side, other in (("Left", "Right"), ("Right", "Left"))
    ]
    parts = dataclasses.replace(parts, sliders=(*parts.sliders, *pair))
    face = kept(shared_server.client, saved(parts, tmp_path / "sample.usdc"), "Studio sliders")
    row = ".row[data-name=pinchLeft] input[type=range]"
    results, problems = browse(
        f"{shared_server.url}studio.html#sliders/{face}",
        READY,
        {"wait": row},
        slide(row, 0.5),
        slide(".row[data-name=curved] input[type=range]", -0.75),
        {"press": "Control+z"},
        {"press": "Control+y"},
        {"click": "text=Save as a version"},
        when("document.body.dataset.saved"),
    )
    assert problems == []
    assert results[-1] == f"{face}/2"
    stage = extracted(shared_server, tmp_path / "export") / face / "2" / "face.usdc"
    values = {one.name: one.setting for one in facepipe.open(stage).sliders}
    assert values["pinchLeft"] == values["pinchRight"] == pytest.approx(0.5)
    assert values["curved"] == pytest.approx(-0.75)
    assert {name for name, value in values.items() if value} == {"pinchLeft", "pinchRight", "curved"}


def test_a_clip_is_dropped_on_a_face_and_played_over_its_sliders(shared_server: Served, tmp_path: Path) -> None:
    """Any moment has the points of the stage's own rig, with a slider moved too; without a clip those before."""
    browser.chromium()
    face = kept(shared_server.client, saved(sample_with_sliders(), tmp_path / "sample.usdc"), "Studio clip")
    clip = tmp_path / "a take 1.csv"
    rows = [f"{frame / 30:.4f},{0.02 * frame},{0.01 * frame},{0.005 * frame}" for frame in range(31)]
    clip.write_text("\n".join(["Time,JawOpen,MouthSmileLeft,EyeLookInLeft", *rows]) + "\n", encoding="utf-8")
    points = "bench.face.face.meshes.map((one) => [one.name, [...bench.face.face.points(one.name)]])"
    now = {"run": f"(() => {{ const bench = facepipe.studio.bench; return {points}; }})()"}
    seek = slide(".clips .row input[type=range]", 0.5)
    slow = {"run": "new Promise((done) => setTimeout(done, 1500))"}
    results, problems = browse(
        f"{shared_server.url}studio.html#sliders/{face}",
        READY,
        {"wait": ".row[data-name=curved]"},
        slow,
        now,
        {"upload": ["section[aria-label=Clips] input[type=file]", str(clip)]},
        when("document.body.dataset.clip"),
        {"wait": ".clips button[aria-pressed=true]"},
        {"run": "new Promise((done) => setTimeout(done, 2500))"},  # over and over
        {"wait": ".clips button[aria-pressed=true]"},
        seek,
        slow,
        {"wait": ".clips button[aria-pressed=false]"},
        now,
        slide(".row[data-name=curved] input[type=range]", 0.8),
        slow,
        now,
        {"run": "facepipe.studio.sliders.player.choose('talk')"},
        seek,
        slow,
        now,
        {"run": "facepipe.studio.sliders.player.choose('')"},
        slide(".row[data-name=curved] input[type=range]", 0.0),
        slow,
        now,
    )
    assert problems == []
    before, half, slid, talking, after = (dict(one) for one in results if isinstance(one, list))
    played = facepipe.open(extracted(shared_server, tmp_path / "export") / face / "2" / "face.usdc")
    height = played.head_height * played.meters_per_unit
    for shown, clip_name, value in ((half, "a_take_1", 0.0), (slid, "a_take_1", 0.8), (talking, "talk", 0.8)):
        off = np.abs(points_of(shown, played) - moment(played, clip_name, 0.5, {"curved": value})).max()
        assert off < 1e-4 * height, (clip_name, value)
    assert np.abs(points_of(half, played) - points_of(before, played)).max() > 1e-2 * height
    np.testing.assert_allclose(points_of(after, played), points_of(before, played), atol=1e-6)


def points_of(shown: dict[str, list[float]], face: facepipe.Face) -> np.ndarray:
    """(n, 3) what the page has, in the order of the stage."""
    return np.concatenate([np.array(shown[mesh.name]).reshape(-1, 3) for mesh in face.parts().meshes])


def moment(face: facepipe.Face, clip: str, seconds: float, sliders: dict[str, float]) -> np.ndarray:
    """(n, 3) points in metres, Y up, at a key of an animation."""
    parts = face.parts()
    moving = next(one for one in parts.animations if one.name == clip)
    assert moving.times is not None
    key = int(np.argmin(np.abs(np.asarray(moving.times) - seconds)))
    weights = {} if moving.shape_weights is None else dict(zip(moving.shapes, moving.shape_weights[key], strict=True))
    coefficients = np.tile([0.0] * 6 + [1.0] * 3, (len(parts.skeleton.joints), 1))
    for number, joint in enumerate(moving.joints):
        assert moving.coefficients is not None
        coefficients[parts.skeleton.joints.index(joint)] = moving.coefficients[key, number]
    points = face.evaluate(weights, coefficients=coefficients, sliders=sliders)
    return np.asarray(points @ parts.gltf_axes[:3, :3].T)


def test_regions_are_written_painted_and_read_back(shared_server: Served, tmp_path: Path) -> None:
    """Each point is in the region that it was in most; one that was painted over is another's then."""
    browser.chromium()
    head = saved(sample_with_sliders(), tmp_path / "sample.usdc")
    face = kept(shared_server.client, head, "Studio regions")
    record = "globalThis.saved = []; const make = URL.createObjectURL; "
    record += "URL.createObjectURL = (blob) => (saved.push(blob), make(blob))"
    text = "(blob) => new Promise((done) => Object.assign(new FileReader(), "
    text += "{ onload: (event) => done(event.target.result.split(',')[1]) }).readAsDataURL(blob))"
    results, problems = browse(
        f"{shared_server.url}studio.html",
        READY,
        *to_blend("Studio regions"),
        when("bench.face !== null"),
        {"run": record},
        {"click": "text=Write map and legend"},
        when("globalThis.saved.filter((one) => one.type !== 'image/webp').length >= 2"),
        {"run": f"Promise.all(saved.slice(-2).map({text}))"},
    )
    assert problems == []
    files = [tmp_path / "map.png", tmp_path / "legend.json"]
    for file, content in zip(files, results[-1], strict=True):
        file.write_bytes(base64.b64decode(content))
    with Image.open(files[0]) as image:
        pixels = np.array(image)
    legend = json.loads(files[1].read_text())["regions"]
    nose = [*bytes.fromhex(legend.pop("nose")[1:])]
    pixels[(pixels[..., :3] == nose).all(axis=-1) & (pixels[..., 3] == 255)] = (255, 255, 255, 255)
    Image.fromarray(pixels).save(files[0])
    files[1].write_text(json.dumps({"regions": {**legend, "snout": "#ffffff"}}))
    results, problems = browse(
        f"{shared_server.url}studio.html",
        READY,
        *to_blend("Studio regions"),
        when("bench.face !== null"),
        {"upload": ["section[aria-label=Regions] input[type=file]", [str(file) for file in files]]},
        when("document.body.dataset.regions"),
    )
    assert problems == []
    assert results[-1] == f"{face}/2"
    folder = extracted(shared_server, tmp_path / "export") / face
    before, after = (facepipe.open(folder / number / "face.usdc").meshes[0].regions for number in ("1", "2"))
    assert {*after} == {*before} - {"nose"} | {"snout"}
    names = [*before]
    shares = np.stack([before[name] for name in names])
    sure = shares.max(axis=0) > 0.6
    found = np.stack([after["snout" if name == "nose" else name] for name in names]).argmax(axis=0)
    assert sure.mean() > 0.5
    assert (found == shares.argmax(axis=0))[sure].mean() > 0.99


# answers about photos that were sent come when the page is told so
HELD_PHOTOS = """
  const plain = window.fetch;
  let release;
  window.held = new Promise((done) => (release = done));
  Object.assign(window, { release, sent: [], gone: [] });
  window.fetch = async (input, init = {}) => {
    const answer = await plain(input, init), photo = /photos\\/?(\\w*)$/.exec(String(input));
    if (photo && init.method === "POST") window.sent.push((await answer.clone().json()).artefact), await window.held;
    if (photo && init.method === "DELETE") window.gone.push(photo[1]);
    return answer;
  };
"""
# pictures of faces are asked for once one is gone, as where it is deleted while they are drawn
LATE_PICTURES = """
  const plain = window.fetch;
  window.deleted = new Promise((done) => { window.fetch = async (input, init = {}) => {
    if (String(input).includes("thumbnail")) await window.deleted;
    const answer = await plain(input, init);
    if (init.method === "DELETE") done();
    return answer;
  }; });
  window.late = () => window.deleted.then(() => new Promise((done) => setTimeout(done, 300)));
"""


def test_a_dropped_file_is_in_the_library_and_can_be_deleted(shared_server: Served, tmp_path: Path) -> None:
    """Nothing is asked of a face that is gone, its picture too."""
    browser.chromium()
    head = saved(tiny_face(2), tmp_path / "Dropped head.usdc")
    card = ".card:has-text('Dropped head')"
    results, problems = browse(
        f"{shared_server.url}studio.html",
        READY,
        {"upload": [".library input[type=file]", str(head)]},
        {"wait": card},
        {"run": f"document.querySelector({json.dumps(card.split(':')[0])}).dataset.face"},
        {"fill": ["input[aria-label=Name]", "Renamed"]},
        {"press": "Tab"},
        {"wait": ".card:has-text('Renamed')"},
        {"run": "window.confirm = () => true"},
        {"click": "text=Delete this face"},
        {"run": "window.late()"},
        when("![...document.querySelectorAll('.card')].some((one) => one.textContent.includes('Renamed'))"),
        before=LATE_PICTURES,
    )
    assert problems == []
    assert results[-1] is True
    assert shared_server.client.get(f"/api/v1/faces/{results[3]}").status_code == 404


@pytest.mark.needs_torch
def test_a_photo_that_another_takes_the_place_of_is_deleted(serve: Serve, tmp_path: Path) -> None:
    """Also one that was still on its way, and it is the new one whose face is looked for."""
    browser.chromium()
    served = serve("--processes", "1")
    photos = [tmp_path / f"{number}.png" for number in range(3)]
    with Image.open(shared("photos/astronaut.png")) as picture:
        for number, path in enumerate(photos):
            picture.convert("RGB").resize((400 + number, 400)).save(path)
    choose = "#panel input[type=file] >> nth=1"
    results, problems = browse(
        f"{served.url}studio.html#photo",
        READY,
        {"upload": [choose, str(photos[0])]},
        {"click": "#agreed"},
        {"click": "text=Find the face"},
        when("window.sent.length === 1"),
        {"upload": [choose, str(photos[1])]},
        {"click": "text=Find the face"},
        when("window.sent.length === 2"),
        {"run": "window.release()"},
        when("document.body.dataset.landmarks"),
        {"upload": [choose, str(photos[2])]},
        when("window.gone.length === 2"),
        {"run": "[window.sent, window.gone]"},
        before=HELD_PHOTOS,
    )
    assert problems == []
    sent, gone = results[-1]
    assert sent == gone
    assert not list((served.folder / "uploads").glob("*/photo*"))


@pytest.mark.needs_torch
def test_a_photo_becomes_a_person_that_is_edited_and_exported(shared_server: Served, tmp_path: Path) -> None:
    """Nothing of the photo stays, and the GLB is the person with the slider that was moved."""
    browser.chromium()
    photo = shared("photos/astronaut.png")
    results, problems = browse(
        f"{shared_server.url}studio.html#photo",
        READY,
        {"upload": ["#panel input[type=file] >> nth=1", str(photo)]},
        {"click": "#agreed"},
        {"click": "text=Find the face"},
        when("document.body.dataset.landmarks"),
        {"run": "document.querySelector('[data-mark=\"30\"]').focus()"},
        *[{"press": key} for key in ("ArrowRight", "ArrowRight", "ArrowUp", "Control+z")],
        {"run": "[30, 31].map((one) => document.querySelector(`[data-mark=\"${one}\"]`).getAttribute('cx'))"},
        {"click": "text=Make the face"},
        when("document.body.dataset.preview", 800),
        when("document.body.dataset.saved", 800),
        {"run": "const saved = document.body.dataset.saved; delete document.body.dataset.saved; saved"},
        {"click": "text=Edit sliders"},
        {"wait": ".row[data-name=noseWidth]"},
        slide(".row[data-name=noseWidth] input[type=range]", 1.0),
        {"click": "text=Save as a version"},
        when("document.body.dataset.saved"),
    )
    assert problems == []
    face, number = results[-1].split("/")
    assert int(number) == 2
    before, after = (
        shared_server.client.get(f"/api/v1/faces/{face}/versions/{one}/face.glb").content for one in (1, 2)
    )
    points = []
    for number_, content in enumerate((before, after)):
        (tmp_path / f"{number_}.glb").write_bytes(content)
        head = read_face(tmp_path / f"{number_}.glb").parts()
        points.append(head.meshes[0].points * head.meters_per_unit)
    assert 1e-3 < np.abs(points[0] - points[1]).max() < 0.05  # metres
    assert (
        ended(shared_server.client, shared_server.client.get("/api/v1/jobs").json()["jobs"][0]["id"])["state"] == "done"
    )
