"""Draws docs/vrm.png: `python docs/vrm_picture.py`. Needs node, chromium and ../shared/data.

VRM's presets, single expressions and a turned head as three-vrm shows the sample and ICT-FaceKit (MIT license).
"""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from facepipe_web import build

from facepipe.cli import main

HERE = Path(__file__).resolve().parent
DATA = HERE.parents[1] / "shared" / "data"
SCRIPTS = HERE.parent / "tests" / "support" / "js"
TERMS = ("--stub-body", "--authors", "facepipe", "--license-url", "https://vrm.dev/licenses/1.0/")
CELL, COLUMNS = 200, 9
POSES = (
    *("neutral", "happy", "angry", "sad", "relaxed", "surprised", "blink", "blinkLeft", "blinkRight"),
    *("aa", "ih", "ou", "ee", "oh", "look up", "look down", "look left", "head turned"),
)
PAGE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<style>body{margin:0;background:#fff;font:14px sans-serif}
div{position:absolute;color:#333}canvas{display:block}</style>
<script type="importmap">{"imports": {"three": "./node_modules/three/build/three.module.js",
"three/addons/": "./node_modules/three/examples/jsm/",
"@pixiv/three-vrm": "./node_modules/@pixiv/three-vrm/lib/three-vrm.module.min.js"}}</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { VRMLoaderPlugin } from "@pixiv/three-vrm";
const { files, poses, cell, columns } = REQUEST;
const rows = Math.ceil(poses.length / columns);
const renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
renderer.setSize(cell * columns, cell * rows * files.length);
renderer.setClearColor(0xffffff);
renderer.setScissorTest(true);
document.body.append(renderer.domElement);
for (const [number, file] of files.entries()) {
  const loader = new GLTFLoader();
  loader.register((parser) => new VRMLoaderPlugin(parser));
  const { vrm } = (await loader.loadAsync(file)).userData;
  const scene = new THREE.Scene();
  const sun = new THREE.DirectionalLight(0xffffff, 2.2);
  sun.position.set(0.6, 1, 1);
  scene.add(sun, new THREE.HemisphereLight(0xffffff, 0x887766, 1.6), vrm.scene);
  vrm.scene.updateMatrixWorld(true);
  const eyes = vrm.lookAt.getLookAtWorldPosition(new THREE.Vector3());
  const camera = new THREE.PerspectiveCamera(17, 1, 0.1, 20);
  camera.position.copy(eyes).add(new THREE.Vector3(0.12, 0, 1));
  camera.lookAt(eyes.x, eyes.y - 0.025, eyes.z - 0.08);
  const ways = { "look up": [0, 0.4, 1], "look down": [0, -0.45, 1], "look left": [0.5, 0, 1] };
  for (const [i, name] of poses.entries()) {
    vrm.humanoid.resetNormalizedPose();
    vrm.expressionManager.resetValues();
    vrm.lookAt.reset();
    vrm.update(0);
    if (vrm.expressionManager.getExpression(name)) vrm.expressionManager.setValue(name, 1);
    if (ways[name]) vrm.lookAt.lookAt(eyes.clone().add(new THREE.Vector3(...ways[name])));
    if (name === "head turned") vrm.humanoid.getNormalizedBoneNode("head").rotation.set(0.1, 0.5, 0.1);
    vrm.update(0);
    const x = (i % columns) * cell, y = (Math.floor(i / columns) + number * rows) * cell;
    const below = renderer.domElement.height - y - cell;
    renderer.setViewport(x, below, cell, cell);
    renderer.setScissor(x, below, cell, cell);
    renderer.render(scene, camera);
    const label = document.createElement("div");
    label.textContent = name;
    label.style.left = `${x + 6}px`;
    label.style.top = `${y + 4}px`;
    document.body.append(label);
  }
}
document.body.dataset.state = "ready";
</script>"""


class Quiet(SimpleHTTPRequestHandler):
    """Serves files without a word."""

    def log_message(self, *_: object) -> None:
        """Nothing."""


def make(out: Path = HERE / "vrm.png") -> None:
    """The picture."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "node_modules").symlink_to(SCRIPTS / "node_modules")
        run("sample", folder / "sample.usdc")
        run("import", "ict", DATA / "ict_facekit" / "ict_facekit.npz", folder / "ict.usdc")
        files = [f"{face}.vrm" for face in ("sample", "ict")]
        for file in files:
            run("export", (folder / file).with_suffix(".usdc"), "-o", folder / file, *TERMS)
        draw(folder, files, out)


def draw(folder: Path, files: list[str], out: Path) -> None:
    """Show `files` of a folder on a page and take its picture."""
    request = {"files": files, "poses": POSES, "cell": CELL, "columns": COLUMNS}
    (folder / "index.html").write_text(PAGE.replace("REQUEST", json.dumps(request)))
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    rows = -(-len(POSES) // COLUMNS) * len(files)
    steps = [{"wait": "body[data-state]"}, {"picture": str(out)}]
    page = {"url": f"http://127.0.0.1:{server.server_port}/index.html", "viewport": [CELL * COLUMNS, CELL * rows]}
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    playwright = build.HERE / "node_modules" / "playwright-core" / "index.mjs"
    done = subprocess.run(
        ["node", SCRIPTS / "browse.mjs", playwright, str(browser)],
        input=json.dumps(page | {"steps": steps}), capture_output=True, text=True, check=False,
    )  # fmt: skip
    server.shutdown()
    problems = [] if done.returncode else json.loads(done.stdout)["problems"]
    if done.returncode or problems:
        raise SystemExit(done.stderr or "\n".join(problems))


def run(*words: object) -> None:
    """A facepipe command."""
    if main([str(word) for word in words]):
        raise SystemExit(f"facepipe {words[0]} failed")


if __name__ == "__main__":
    make()
