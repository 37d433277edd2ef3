"""A page on which the person of a selfie stands over the standard head, as on a phone that has the head already.

usage: python samples/device/make_page.py PHOTO FOLDER

PHOTO is a picture of a face, or a person that `facepipe person` or `fit-photo` wrote (.fpb). FOLDER gets the page and
its files: me.fpb is the person; the standard head (head.glb) and its basis (head.fpbasis) are everyone's. Then `python
-m http.server --directory FOLDER` shows it. Needs the runtime: `python -m facepipe_web.build`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from facepipe_web import build

import facepipe
from facepipe.cli import main as command

HERE = Path(__file__).resolve().parent


def bundle(out: Path) -> None:
    """The page's script with the runtime and what it needs of three.js."""
    packages = build.HERE / "node_modules"
    words = [
        "--bundle",
        "--minify",
        "--format=esm",
        "--target=es2022",
        "--legal-comments=eof",
        "--external:onnxruntime-web/*",
    ]
    words += [f"--alias:facepipe-web={build.DIST / 'facepipe.js'}", f"--outfile={out}", str(HERE / "page.js")]
    command = ["node", str(packages / "esbuild" / "bin" / "esbuild"), "--log-level=warning", *words]
    subprocess.run(command, check=True, env=os.environ | {"NODE_PATH": str(packages)})


def main(words: list[str]) -> int:
    """The exit code."""
    if len(words) != 2:
        print(__doc__, file=sys.stderr)
        return 2
    photo, folder = map(Path, words)
    folder.mkdir(parents=True, exist_ok=True)
    person, stage = folder / "me.fpb", folder / "head.usdc"
    if photo.suffix == ".fpb":
        shutil.copyfile(photo, person)
    elif command(["fit-photo", str(photo), "--person", str(person), "--force"]) > 1:
        return 2
    facepipe.sample(stage, seed=0, overwrite=True)
    facepipe.export(stage, folder / "head.glb", purpose="persons", engine="three", overwrite=True)
    facepipe.basis(out=folder / "head.fpbasis", overwrite=True)
    shutil.copyfile(HERE / "index.html", folder / "index.html")
    bundle(folder / "page.js")
    for name in ("me.fpb", "head.fpbasis", "head.glb", "page.js", "index.html"):
        print(f"{folder / name}: {(folder / name).stat().st_size:,} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
