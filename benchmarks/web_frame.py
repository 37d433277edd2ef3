"""Milliseconds of a frame in the browser's JavaScript and WebAssembly, of 16.7 that 60 frames a second allow.

usage: python benchmarks/web_frame.py [--runs 300] [--json out.json] [--data FOLDER]

ICT-FaceKit (26,719 points) in the viewer's page, in headless Chromium, one thread of WebAssembly. Every frame sets all
sliders to random values. Faces:

  shapes  one slider for each of its 53 shapes; no joints
  bones   MakeHuman's skeleton carried over, sliders made from the shapes: bones, and shapes for what they don't reach

Columns, medians; `p95` is of the whole frame:

  graph   onnxruntime-web alone: sliders to skinning matrices and morph weights
  set     all of `face.setSliders`: the graph, matrices to joints, weights to meshes
  three   three.js: matrices of the scene, uploads, draw calls; not the GPU's work on them, which is waited for after it
  frame   set and three
  peer    three's part where weights and joints are set at random by hand: the same face without any graph
  ratio   frame / peer

Here a software renderer stands for the GPU and shares the cores: `three` and `peer` wait for it at times.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import shutil
import subprocess
import tempfile
import threading
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import facepipe_web
from arguments import add_common
from facepipe_web import build
from tables import aligned

import facepipe
from facepipe.cli import main as run_command
from facepipe.parts import Slider
from facepipe.stage import save_parts

BUDGET = 1000 / 60
HEAD = ("face", "sliders", "joints", "targets", "graph", "set", "three", "frame", "p95", "of 16.7", "peer", "ratio")
BROWSE = Path(__file__).resolve().parents[1] / "tests" / "support" / "js" / "browse.mjs"

MEASURE = """(async () => {
  const { picture } = facepipe, face = facepipe.face(), gl = picture.canvas.getContext("webgl2");
  const found = { graph: [], set: [], three: [], peer: [] };
  const random = (low, high) => low + Math.random() * (high - low);
  const timed = async (list, run) => {
    const start = performance.now();
    await run();
    list.push(performance.now() - start);
  };
  const posed = () => Object.fromEntries(face.sliders.map((one) => [one.name, random(one.minimum, one.maximum)]));
  const byHand = () => {
    for (const mesh of face.meshes) for (const one of mesh.primitives) {
      one.morphTargetInfluences?.forEach((_, i, all) => (all[i] = Math.random()));
    }
    for (const bone of face.joints?.bones ?? []) {
      bone.matrix.elements[12] += random(-1e-4, 1e-4);
      bone.matrixWorldNeedsUpdate = true;
    }
  };
  for (let frame = 0; frame < FRAMES + 20; frame++) {
    const values = posed();
    await timed(found.set, () => face.setSliders(values));
    await timed(found.three, () => picture.draw());
    gl.finish();
    await timed(found.graph, () => face.network.run());
    byHand();
    await timed(found.peer, () => picture.draw());
    gl.finish();
    await new Promise((done) => setTimeout(done));
  }
  const warm = Object.fromEntries(Object.entries(found).map(([name, list]) => [name, list.slice(20)]));
  const targets = face.meshes.reduce((most, mesh) => Math.max(most, mesh.targets.length), 0);
  return { ...warm, sliders: face.sliders.length, joints: face.joints?.bones.length ?? 0, targets };
})()"""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One face's figures, times in milliseconds."""

    face: str
    sliders: int
    joints: int
    targets: int  # of the mesh that has most
    graph: float
    set: float
    three: float
    frame: float
    p95: float
    peer: float


def main() -> None:
    """Measure, print the table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_common(parser, 300, "the median")
    arguments = parser.parse_args()
    if not build.is_built():
        build.build()
    with tempfile.TemporaryDirectory() as name:
        faces = stages(arguments.data, Path(name))
        rows = [measured(kind, path, arguments.runs) for kind, path in faces.items()]
    print(table(rows))
    if arguments.json:
        content = {"rows": [asdict(row) for row in rows], "budget_ms": BUDGET, "runs": arguments.runs}
        arguments.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def stages(data: Path, folder: Path) -> dict[str, Path]:
    """The faces with sliders."""
    ict, makehuman, skinned, shapes, bones = (
        folder / f"{name}.usdc" for name in ("ict", "makehuman", "skinned", "shapes", "bones")
    )
    done("import", "ict", data / "ict_facekit" / "ict_facekit.npz", ict)
    done("import", "makehuman", data / "makehuman" / "makehuman_head.npz", makehuman)
    done("skin", ict, "--from", makehuman, "-o", skinned)
    done("sliders", skinned, "--from-shapes", "--residual", "-o", bones)
    face = facepipe.open(ict)
    sliders = tuple(Slider(name=name, shapes=((name, 1.0),)) for name in face.shapes)
    save_parts(replace(face.parts(), sliders=sliders), shapes)
    return {"shapes": shapes, "bones": bones}


def done(*words: object) -> None:
    """Run a command of facepipe, without its words."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
        code = run_command([str(word) for word in words])
    if code == 2:
        raise SystemExit(said.getvalue())


def measured(kind: str, path: Path, frames: int) -> Row:
    """One face in the browser."""
    with facepipe_web.view([path], facepipe_web.Options()) as page:
        thread = threading.Thread(target=page.serve)
        thread.start()
        try:
            found = in_page(page.url, frames)
        finally:
            page.close()
            thread.join()
    frame = [a + b for a, b in zip(found["set"], found["three"], strict=True)]
    times = {name: quantile(found[name], 0.5) for name in ("graph", "set", "three", "peer")}
    counts = {name: found[name] for name in ("sliders", "joints", "targets")}
    return Row(face=kind, frame=quantile(frame, 0.5), p95=quantile(frame, 0.95), **counts, **times)


def in_page(url: str, frames: int) -> dict[str, Any]:
    """What the page measures of itself."""
    node, chromium = shutil.which("node"), shutil.which("chromium")
    if node is None or chromium is None:
        raise SystemExit("needs node and chromium on the PATH")
    steps = [{"wait": "body[data-state=ready]"}, {"run": MEASURE.replace("FRAMES", str(frames))}]
    request = json.dumps({"url": url, "viewport": [400, 300], "steps": steps})
    playwright = build.HERE / "node_modules" / "playwright-core" / "index.mjs"
    command = [node, str(BROWSE), str(playwright), chromium]
    answer = subprocess.run(command, input=request, capture_output=True, text=True, check=False)
    if answer.returncode:
        raise SystemExit(answer.stderr)
    results: dict[str, Any] = json.loads(answer.stdout)["results"][1]
    return results


def quantile(values: list[float], share: float) -> float:
    """A value of the list."""
    return sorted(values)[min(int(share * len(values)), len(values) - 1)]


def table(rows: list[Row]) -> str:
    """The rows as text."""
    lines: list[tuple[str, ...]] = [HEAD]
    for row in rows:
        counts = (str(row.sliders), str(row.joints), str(row.targets))
        times = tuple(f"{value:.2f}" for value in (row.graph, row.set, row.three, row.frame, row.p95))
        last = (f"{row.frame / BUDGET:.0%}", f"{row.peer:.2f}", f"{row.frame / row.peer:.2f}x")
        lines.append((row.face, *counts, *times, *last))
    return "\n".join(aligned(lines))


if __name__ == "__main__":
    main()
