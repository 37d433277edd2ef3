"""Pages of the viewer in headless Chromium: payloads, live blends, colours, comparison, and what they say."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import browser
import facepipe_gltf
import numpy as np
import pytest
from browser import DRAWN, READY, Step, browse, run, until
from command_line import exit_code
from facepipe_onnx import Options, export_parts
from faces import tiny_face
from node import HERE
from slider_faces import sample_with_sliders
from small_sources import made

import facepipe
from facepipe.parts import FaceParts, Skin, Slider
from facepipe.payload import PayloadContent, decode, encode
from facepipe.rig import build, rest_coefficients
from facepipe.stage import save_parts

pytestmark = pytest.mark.slow

CANVAS = "#view > canvas"
MESSAGES = {"run": 'document.querySelector(".messages")?.textContent ?? ""'}
NOTES = {"run": 'document.querySelector(".notes").innerText'}
POINTS = run("return face.meshes.flatMap((mesh) => Array.from(face.points(mesh.name)))")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    browser.chromium()
    return tmp_path_factory.mktemp("pages")


@pytest.fixture(scope="module")
def sample(folder: Path) -> Path:
    save_parts(sample_with_sliders(), folder / "sample.usda")
    return folder / "sample.usda"


@pytest.fixture(scope="module")
def url(sample: Path) -> Iterator[str]:
    with browser.viewing(sample) as url:
        yield url


def as_gltf(parts: FaceParts, points: np.ndarray) -> np.ndarray:
    """Points of a stage that is Y up, in metres."""
    assert parts.up_axis == "Y"
    return points * parts.meters_per_unit


def clip_of(parts: FaceParts, frames: int, precision: str = "float32") -> PayloadContent:
    rng, joints = np.random.default_rng(3), parts.skeleton.joints
    rest = rest_coefficients(len(joints))
    poses = rest + rng.normal(size=(frames, *rest.shape)) * np.repeat((0.2, 0.1, 0.05), 3)
    poses[:, 5:9] = rest[5:9]  # so that the payload has a mask
    return PayloadContent(
        joints=joints,
        coefficients=poses,
        times=np.arange(frames) / 24,
        meters_per_unit=parts.meters_per_unit,
        precision=precision,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("precision", ["float32", "float16"])
def test_a_payload(url: str, folder: Path, precision: str) -> None:
    """Every frame puts the points where the rig does; taken off, the sliders have the joints again."""
    parts = sample_with_sliders()
    clip = clip_of(parts, 3, precision)
    (folder / "clip.fpb").write_bytes(encode(clip).data)
    shown = (
        'document.querySelector("section[aria-label=Payload] p").textContent.startsWith("clip.fpb: 3 frames, 0.08 s")'
    )
    steps: list[Step] = [READY, POINTS, {"upload": ["#payload", str(folder / "clip.fpb")]}, until(shown)]
    number = '.row[data-name="frame"] input[type="number"]'
    for frame in range(3):
        steps += [{"fill": [number, str(frame)]}, {"press": "Tab"}, DRAWN, POINTS]
    off = run('[...document.querySelectorAll("button")].find((one) => one.textContent === "Take off").click()')
    results, problems = browse(url, *steps, off, DRAWN, POINTS)
    assert problems == []
    rig, height = build(parts), float(np.ptp(build(parts).evaluate()[:, 1])) * parts.meters_per_unit
    content = decode((folder / "clip.fpb").read_bytes(), parts.skeleton.joints, "clip.fpb")
    for frame, found in enumerate(results[7:16:4]):
        expected = as_gltf(parts, rig.evaluate(coefficients=content.frames[frame]))
        assert np.abs(np.reshape(found, (-1, 3)) - expected).max() < 1e-5 * height
    assert np.abs(np.subtract(results[-1], results[1])).max() < 1e-7


def test_payloads_that_are_refused(url: str, folder: Path) -> None:
    """A damaged one, one for other joints, and no payload: a line each, the face stays."""
    data = bytearray(encode(clip_of(sample_with_sliders(), 2)).data)
    data[60] ^= 1
    (folder / "damaged.fpb").write_bytes(data)
    (folder / "other.fpb").write_bytes(encode(clip_of(tiny_face(), 1)).data)
    (folder / "none.fpb").write_bytes(b"no payload at all, but long enough for a header")
    uploads = [{"upload": ["#payload", str(folder / f"{name}.fpb")]} for name in ("damaged", "other", "none")]
    said = until('document.querySelectorAll(".message").length === 3')
    results, problems = browse(url, READY, POINTS, *uploads, said, MESSAGES, POINTS)
    assert problems == []
    assert "damaged.fpb: is damaged: its CRC differs" in results[-2]
    assert "made for other joints (3, hash" in results[-2]
    assert "none.fpb: no bone coefficients" in results[-2]
    assert results[1] == results[-1]


def test_a_live_blend(folder: Path) -> None:
    """While a weight is moved its points follow; let go, the whole face is what `facepipe blend` makes."""
    for seed, name in enumerate("ab"):
        save_parts(made(seed), folder / f"{name}.usda")
    files = [str(folder / f"{name}.usda") for name in ("a", "b", "child", "expected")]
    assert exit_code("blend", *files[:2], "-o", files[2], "--set", "mouth=0.5,0.5", "--default", "0.5,0.5") == 0
    assert exit_code("blend", *files[:2], "-o", files[3], "--set", "mouth=0.5,1", "--default", "0.5,0.5") == 0
    rows = 'section[aria-label="Blend"] details:nth-of-type(2) .row:nth-of-type(2)'
    move = f"""const input = document.querySelector('{rows} input[type="range"]');
        input.value = "1"; input.dispatchEvent(new Event("{{}}"));"""
    unfold = 'document.querySelectorAll("details").forEach((one) => (one.open = true));'
    keep = 'window.before = face.points("Head").join();'
    shape = run("await face.setShapes({ jawOpen: 0.7 })")
    steps = [
        READY,
        run(unfold + keep),
        run(move.format("input")),
        until('window.before !== face.points("Head").join()'),
    ]
    steps += [POINTS, shape, run(move.format("change")), until('page.own.entry.glb !== "faces/0/face.glb"'), POINTS]
    command = {"run": 'document.querySelector("textarea").value'}
    with browser.viewing(Path(files[2])) as url:
        results, problems = browse(url, *steps, shape, POINTS, command, MESSAGES)
    assert problems == []
    assert results[-1] == ""
    face = facepipe.open(files[3])
    for found, weights in ((results[4], {}), (results[-3], {"jawOpen": 0.7})):
        expected = as_gltf(face.parts(), face.evaluate(weights))
        assert np.abs(np.reshape(found, (-1, 3)) - expected).max() < 1e-5 * face.head_height * face.meters_per_unit
    assert results[8] == results[-3]  # the shapes that were set go over to the new version
    assert results[-2].startswith("facepipe blend --edit child.usda --force --default 0.5,0.5 --set mouth=0.5,1")


def test_shapes_of_a_glb_alone(folder: Path) -> None:
    """Without ONNX: shape weights through the curves of inbetweens, as the rig has them."""
    parts = tiny_face()
    save_parts(parts, folder / "tiny.usda")
    facepipe_gltf.export(facepipe.open(folder / "tiny.usda"), folder / "tiny.glb")
    take = "await face.reset(); await face.setShapes({})"
    poses = [{"jawOpen": 0.3, "mouthSmileLeft": 0.8}, {"jawOpen": 0.75}, {"jawOpen": 1.2, "mouthSmileLeft": -0.2}]
    steps = [step for pose in poses for step in (run(take.format(json.dumps(pose))), POINTS)]
    with browser.viewing(folder / "tiny.glb") as url:
        results, problems = browse(url, READY, run("return face.shapes"), *steps)
    assert problems == []
    assert results[1] == ["jawOpen", "mouthSmileLeft"]
    for found, pose in zip(results[3::2], poses, strict=True):
        expected = as_gltf(parts, build(parts).evaluate(pose))
        assert np.abs(np.reshape(found, (-1, 3)) - expected).max() < 1e-5 * np.ptp(expected[:, 1])


def test_colours_and_comparison(url: str) -> None:
    """Every switch changes the picture, and the way back leads to the first; the scale holds the largest distance."""
    pose = run("await face.setSliders({ smile: 1, mouthOpen: 0.6 }); page.changed()")
    steps: list[Step] = [READY, pose, DRAWN, {"hash": CANVAS}]
    for selector in ("regions", "distance", "split", "toggle"):
        steps += [{"click": f'button[data-value="{selector}"]'}]
        if selector == "split":
            steps += [until('document.querySelector(".side:not([hidden])")')]
        steps += [run("await new Promise((done) => setTimeout(done, 400))"), DRAWN, {"hash": CANVAS}]
    legend = {"run": 'document.querySelector(".legend").textContent'}
    largest = run("return [page.own.look.largest().mm, page.own.look.range.value]")
    back = [{"click": 'button[data-value="off"]'}, {"click": 'button[data-value="material"]'}, DRAWN, {"hash": CANVAS}]
    keys: list[Step] = [
        {"press": "w"},
        DRAWN,
        {"hash": CANVAS},
        {"press": "w"},
        {"press": "b"},
        DRAWN,
        {"hash": CANVAS},
    ]
    results, problems = browse(url, *steps, legend, largest, *back, *keys)
    assert problems == []
    hashes = [result for result in results if isinstance(result, str) and len(result) == 64]
    first, regions, distance, split, other, again, wireframe, bones = hashes
    assert again == first
    assert len({first, regions, distance, split, other, wireframe, bones}) == 7
    mm, end = next(result for result in results if isinstance(result, list))
    assert 3 < mm <= end
    assert any(f"largest {mm:.2f} mm" in str(result) for result in results)


def test_the_search_of_shapes(url: str) -> None:
    fill = {"fill": ['input[type="search"]', "smile left"]}
    seen = 'return [...document.querySelectorAll(".list .row:not([hidden])")].map((one) => one.dataset.name)'
    results, problems = browse(url, READY, fill, run(seen))
    assert (results[-1], problems) == (["mouthSmileLeft"], [])


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("larger", "the head is 337.8 mm high in the GLB, 344.5 mm in the ONNX"),
        ("wider", "mm from where the ONNX has it"),
        ("tiny", "44 joints in the GLB, 3 in the ONNX"),
        ("none", "no JSON, expected the sidecar"),
    ],
)
def test_glb_and_onnx_of_different_faces(sample: Path, folder: Path, name: str, said: str) -> None:
    """The page says what differs, and shows the GLB without its sliders."""
    facepipe_gltf.export(facepipe.open(sample), folder / "sample.glb")
    onnx, parts = folder / f"{name}.onnx", sample_with_sliders()
    if name == "larger":
        parts = replace(parts, meters_per_unit=1.02 * parts.meters_per_unit)
    elif name == "wider":
        parts = replace(parts, meshes=tuple(replace(mesh, points=mesh.points * (1.02, 1, 1)) for mesh in parts.meshes))
    elif name == "tiny":
        parts = replace(tiny_face(), sliders=(Slider(name="bend", channels=(("root/jaw", "rx", 0.3),)),))
    export_parts(parts, onnx, Options(sliders=True))
    if name == "none":
        onnx.with_name(f"{onnx.name}.json").write_text("{ no JSON")
    with browser.viewing(folder / "sample.glb", onnx=onnx) as url:
        results, _ = browse(url, READY, MESSAGES, run("return [face.sliders.length, face.shapes.length]"))
    assert said in results[1]
    assert "sample.glb is shown without its sliders" in results[1]
    assert results[2] == [0, 52]


def test_the_same_files_are_one_face(sample: Path, folder: Path) -> None:
    """A quantised GLB too: its vertices and joints are those of the plain one."""
    face = facepipe.open(sample)
    facepipe_gltf.export(face, folder / "own.glb", facepipe_gltf.Options(quantize=True))
    export_parts(face.parts(), folder / "own.onnx", Options(sliders=True))
    with browser.viewing(folder / "own.glb", onnx=folder / "own.onnx") as url:
        results, problems = browse(url, READY, MESSAGES, run("return face.sliders.length"))
    assert (results[1:], problems) == (["", len(face.sliders)], [])


def test_a_quantised_glb_fills_the_picture(
    url: str, sample: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A compressed one too: the camera stands where it stands before the stage."""
    monkeypatch.setenv("NODE_PATH", str(HERE / "node_modules"))
    options = facepipe_gltf.Options(quantize=True, meshopt=True)
    facepipe_gltf.export(facepipe.open(sample), folder / "quantised.glb", options)
    camera = run("return facepipe.picture.camera.position.toArray()")
    expected, _ = browse(url, READY, camera)
    with browser.viewing(folder / "quantised.glb") as other:
        results, problems = browse(other, READY, camera)
    assert problems == []
    assert np.abs(np.subtract(results[1], expected[1])).max() < 1e-3


def test_notes_of_the_export(folder: Path) -> None:
    """What the GLB can't hold is read on the page: here more influences than glTF in three.js has."""
    parts = sample_with_sliders()
    rng, joints = np.random.default_rng(5), len(parts.skeleton.joints)
    meshes = []
    for mesh in parts.meshes:
        places = np.argsort(rng.random((len(mesh.points), joints)), axis=1)[:, :6]
        skin = Skin(joint_indices=places, joint_weights=np.full(places.shape, 1 / 6))
        meshes.append(replace(mesh, skin=skin))
    save_parts(replace(parts, meshes=tuple(meshes)), folder / "many.usda")
    with browser.viewing(folder / "many.usda") as url:
        results, problems = browse(url, READY, {"click": ".notes > summary"}, NOTES)
    assert problems == []
    assert "more than 4 influences" in results[-1]


def test_without_webgl(url: str) -> None:
    results, _ = browse(url, {"wait": ".message"}, MESSAGES, flags=["--disable-3d-apis"])
    assert "This browser has no WebGL 2" in results[1]


def test_without_webassembly(url: str) -> None:
    """The face is there, with its shapes."""
    steps = [READY, MESSAGES, run("return [face.sliders.length, face.shapes.length]")]
    results, _ = browse(url, *steps, before="delete globalThis.WebAssembly")
    assert "has no WebAssembly" in results[1]
    assert results[2] == [0, 52]


def test_a_damaged_glb(folder: Path) -> None:
    (folder / "bad.glb").write_bytes(b"glTF" + bytes(60))
    with browser.viewing(folder / "bad.glb") as url:
        results, _ = browse(url, {"wait": 'body[data-state="failed"]'}, MESSAGES)
    assert "is no GLB that three.js reads" in results[1]
