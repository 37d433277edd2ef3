"""Draws docs/web.png and docs/web_blend.png: `python docs/web_picture.py`. Needs ../shared/data, node and chromium.

The viewer's page with ICT-FaceKit (MIT license) on sliders made of its shapes, and with a blend of two sample heads.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
import threading
from pathlib import Path

import facepipe_web
from facepipe_web import build

from facepipe.cli import main

HERE = Path(__file__).resolve().parent
DATA = HERE.parents[1] / "shared" / "data"
BROWSE = HERE.parent / "tests" / "support" / "js" / "browse.mjs"
SIZE = (1280, 720)

POSED = """(async () => {
  const wanted = { jawOpen: 0.45, mouthSmileLeft: 0.9, mouthSmileRight: 0.5, browInnerUpRight: 0.8 };
  for (const [name, value] of Object.entries(wanted)) {
    const number = document.querySelector(`.row[data-name="${name}"] input[type="number"]`);
    number.value = value;
    number.dispatchEvent(new Event("change"));
  }
  for (const one of document.querySelectorAll("details")) one.open = /^(brow|jaw)/.test(one.textContent);
})()"""
UNFOLDED = """(() => {
  const folds = document.querySelectorAll("section[aria-label=Blend] details");
  for (const one of folds) one.open = /^(all|eyes|mouth|nose)/.test(one.textContent);
})()"""


def make() -> None:
    """Both pictures."""
    if not build.is_built():
        build.build()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ict = ict_sliders(folder)
        later = {"run": "new Promise((done) => setTimeout(done, 3000))"}
        press = [{"click": f'button[data-value="{value}"]'} for value in ("distance", "split")]
        draw(ict, HERE / "web.png", [{"run": POSED}, *press, later, {"run": "document.activeElement.blur()"}])
        draw(
            blend(folder), HERE / "web_blend.png", [{"run": UNFOLDED}, {"click": 'button[data-value="regions"]'}, later]
        )


def ict_sliders(folder: Path) -> Path:
    """ICT-FaceKit with MakeHuman's bones and sliders."""
    ict, bones, skinned, out = (folder / f"{name}.usdc" for name in ("face", "bones", "skinned", "ict"))
    run("import", "ict", DATA / "ict_facekit" / "ict_facekit.npz", ict, "--identity-seed", "7")
    run("import", "makehuman", DATA / "makehuman" / "makehuman_head.npz", bones)
    run("skin", ict, "--from", bones, "-o", skinned)
    run("sliders", skinned, "--from-shapes", "--residual", "-o", out)
    return out


def blend(folder: Path) -> Path:
    """A child of two sample heads."""
    heads = [folder / "head.usda", folder / "other.usda"]
    for path, seed in zip(heads, (3, 8), strict=True):
        run("sample", path, "--seed", seed)
    weights = ("--set", "eyes=0.2,0.8", "--set", "mouth=0,1", "--default", "0.6,0.4")
    run("blend", *heads, "-o", folder / "child.usda", *weights)
    return folder / "child.usda"


def run(*words: object) -> None:
    """A command of facepipe."""
    if main([str(word) for word in words]) == 2:
        raise SystemExit(2)


def draw(face: Path, picture: Path, steps: list[dict[str, str]]) -> None:
    """A picture of the page after some steps."""
    node, chromium = shutil.which("node"), shutil.which("chromium")
    if node is None or chromium is None:
        raise SystemExit("needs node and chromium on the PATH")
    playwright = build.HERE / "node_modules" / "playwright-core" / "index.mjs"
    with facepipe_web.view([face], facepipe_web.Options()) as page:
        thread = threading.Thread(target=page.serve)
        thread.start()
        whole = [{"wait": "body[data-state=ready]"}, *steps, {"picture": str(picture)}]
        request = json.dumps({"url": page.url, "viewport": SIZE, "steps": whole})
        try:
            subprocess.run([node, BROWSE, playwright, chromium], input=request, text=True, check=True)
        finally:
            page.close()
            thread.join()


if __name__ == "__main__":
    make()
