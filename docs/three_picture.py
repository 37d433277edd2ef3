"""Draws docs/three.png: `python docs/three_picture.py`. GLBs of samples in three.js beside facepipe's own pictures.

Needs node and chromium.
"""

from __future__ import annotations

import functools
import json
import shutil
import subprocess
import tempfile
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from facepipe_web import build
from PIL import Image

import facepipe
from facepipe.pictures import contact_sheet, save_png

HERE = Path(__file__).resolve().parent
BROWSE = HERE.parent / "tests" / "support" / "js" / "browse.mjs"
SIZE = 480
PEOPLE = ((4, {}), (9, {"mouthSmileLeft": 0.8, "mouthSmileRight": 0.8, "jawOpen": 0.25}))  # seed, shapes
PAGE = """<!doctype html><style>body{margin:0;overflow:hidden}</style>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js", "three/": "/three/"}}</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { RoomEnvironment } from "three/examples/jsm/environments/RoomEnvironment.js";
const renderer = new THREE.WebGLRenderer({ antialias: true });
renderer.setSize(innerWidth, innerHeight);
renderer.toneMapping = THREE.ACESFilmicToneMapping;
document.body.append(renderer.domElement);
const scene = new THREE.Scene();
scene.background = new THREE.Color(0xc4c9d2);
scene.environment = new THREE.PMREMGenerator(renderer).fromScene(new RoomEnvironment(), 0.04).texture;
scene.environmentIntensity = 0.7;
const key = new THREE.DirectionalLight(0xffffff, 1.2);
key.position.set(-1, 1.5, 2);
scene.add(key);
const { scene: head } = await new GLTFLoader().loadAsync("/head.glb");
scene.add(head);
const wanted = await (await fetch("/shapes.json")).json();
head.traverse((one) => {
  one.frustumCulled = false;
  for (const [name, value] of Object.entries(wanted)) {
    const index = one.morphTargetDictionary?.[name];
    if (index !== undefined) one.morphTargetInfluences[index] = value;
  }
});
const box = new THREE.Box3().setFromObject(head);
const [middle, size] = [box.getCenter(new THREE.Vector3()), box.getSize(new THREE.Vector3())];
const [yaw, pitch, lens] = [(38 * Math.PI) / 180, (4 * Math.PI) / 180, 12 / 105]; // facepipe's three-quarter view
const far = (1.18 * Math.hypot(size.y, 0.5 * size.z)) / 2 / lens;
const camera = new THREE.PerspectiveCamera((2 * Math.atan(lens) * 180) / Math.PI, 1, 0.01, 10);
camera.position.set(Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch));
camera.position.multiplyScalar(far).add(middle);
camera.lookAt(middle);
renderer.render(scene, camera);
document.body.dataset.state = "ready";
</script>"""


def main() -> None:
    """Sample, export, draw both ways, save."""
    node, chromium = shutil.which("node"), shutil.which("chromium")
    if node is None or chromium is None:
        raise SystemExit("needs node and chromium on the PATH")
    if not build.is_built():
        build.build()
    playwright = build.HERE / "node_modules" / "playwright-core" / "index.mjs"
    sheet = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "three").symlink_to(build.HERE / "node_modules" / "three")
        (folder / "index.html").write_text(PAGE)
        server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Quiet, directory=name))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        for seed, shapes in PEOPLE:
            face = folder / f"{seed}.usdc"
            facepipe.sample(face, seed=seed)
            facepipe.export(face, folder / "head.glb", overwrite=True)
            (folder / "shapes.json").write_text(json.dumps(shapes))
            facepipe.render(
                face, out=folder / "own.png", weights=shapes, view="three-quarter", size=SIZE, overwrite=True
            )
            shown = folder / "shown.png"
            steps = [{"wait": "body[data-state=ready]"}, {"picture": str(shown)}]
            url = f"http://127.0.0.1:{server.server_port}/"
            request = json.dumps({"url": url, "viewport": (SIZE, SIZE), "steps": steps})
            subprocess.run([node, BROWSE, playwright, chromium], input=request, text=True, check=True)
            own = Image.open(folder / "own.png").convert("RGB")
            sheet += [(f"seed {seed}, three.js", Image.open(shown).convert("RGB"))]
            sheet += [(f"seed {seed}, facepipe render", own)]
        server.shutdown()
    save_png(contact_sheet(sheet, columns=4), HERE / "three.png")


class _Quiet(SimpleHTTPRequestHandler):
    """Files of a folder, without a line for each."""

    def log_message(self, *_: object) -> None:
        """Nothing."""


if __name__ == "__main__":
    main()
