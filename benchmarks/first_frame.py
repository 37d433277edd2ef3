"""Milliseconds from asking for a GLB to its first frame in three.js, and ratios to the first one.

    python benchmarks/first_frame.py plain.glb game.glb [--runs 5] [--json out.json]

The files are fetched from a server on this machine and drawn by headless Chromium, in turns, each in a browser of its
own; the medians of the runs. The frame ends when a pixel of it can be read. Needs node, chromium and the packages of
tests/support/js. A software renderer stands for the GPU: what is uploaded to it is copied.
"""

from __future__ import annotations

import argparse
import functools
import json
import shutil
import statistics
import sys
import tempfile
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import support_modules  # noqa: F401  (finds the modules of tests/support)
from arguments import positive
from browser import HERE, READY, browse
from node import node_packages
from tables import ms

_PAGE = """<!doctype html><link rel="icon" href="data:,">
<script type="importmap">{"imports": {"three": "./node_modules/three/build/three.module.js",
"three/addons/": "./node_modules/three/examples/jsm/"}}</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { KTX2Loader } from "three/addons/loaders/KTX2Loader.js";
import { MeshoptDecoder } from "three/addons/libs/meshopt_decoder.module.js";
const renderer = new THREE.WebGLRenderer(), scene = new THREE.Scene();
renderer.setSize(800, 800);
document.body.append(renderer.domElement);
scene.add(new THREE.HemisphereLight(0xffffff, 0x444444, 3));
const transcoder = "./node_modules/three/examples/jsm/libs/basis/";
const ktx2 = new KTX2Loader().setTranscoderPath(transcoder).detectSupport(renderer);
const loader = new GLTFLoader().setMeshoptDecoder(MeshoptDecoder).setKTX2Loader(ktx2);
renderer.render(scene, new THREE.PerspectiveCamera());
await MeshoptDecoder.ready;
const start = performance.now(), file = await loader.loadAsync("FILE");
scene.add(file.scene);
const box = new THREE.Box3().setFromObject(file.scene), middle = box.getCenter(new THREE.Vector3());
const camera = new THREE.PerspectiveCamera(30, 1, 0.01, 10);
camera.position.set(middle.x, middle.y, box.max.z + 2.2 * (box.max.y - box.min.y));
camera.lookAt(middle);
renderer.render(scene, camera);
const gl = renderer.getContext();
gl.readPixels(400, 400, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
window.took = performance.now() - start;
document.body.dataset.state = "drawn";
</script>"""


def main() -> int:
    """Load, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, metavar="GLB")
    parser.add_argument("--runs", type=positive, default=5, help="browsers a file, the medians of them (default 5)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    given = parser.parse_args()
    node_packages()
    with tempfile.TemporaryDirectory() as passing:
        folder = Path(passing)
        (folder / "node_modules").symlink_to(HERE / "node_modules")
        for number, file in enumerate(given.files):
            shutil.copy(file, folder / f"{number}.glb")
            (folder / f"{number}.html").write_text(_PAGE.replace("FILE", f"{number}.glb"))
        server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Quiet, directory=passing))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        runs: list[list[float]] = [[] for _ in given.files]
        for _ in range(given.runs):
            for number, found in enumerate(runs):
                url = f"http://127.0.0.1:{server.server_port}/{number}.html"
                (_, took), problems = browse(url, READY, {"run": "window.took"})
                if problems:
                    print(f"first_frame: {given.files[number]}: {problems[0]}", file=sys.stderr)
                    return 2
                found.append(took / 1000)
        server.shutdown()
    medians = [statistics.median(found) for found in runs]
    for file, median in zip(given.files, medians, strict=True):
        print(f"{file.name:24}  {file.stat().st_size / 1e6:6.1f} MB  {ms(median):>12}  {median / medians[0]:.2f}")
    if given.json:
        given.json.write_text(json.dumps({str(file): found for file, found in zip(given.files, runs, strict=True)}))
    return 0


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


if __name__ == "__main__":
    sys.exit(main())
