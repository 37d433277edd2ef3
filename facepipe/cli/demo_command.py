"""The whole way in one go: sample head -> inspect -> validate -> GLB -> ONNX -> eval -> contact sheet.

example: facepipe demo demo/
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from facepipe import registry
from facepipe.cli.show import progress
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_written
from facepipe.verbs.inspect import report_of

TEXTURES = "head_textures"  # the folder beside head.usdc
FILES = ("head.usdc", "head.glb", "head.onnx", "head.onnx.json", "points.npz", "sheet.png")
_TEXTURES = 1024  # texels a side, which is what the sheet shows
POSE = {"jawOpen": 0.7, "mouthSmileLeft": 0.5}
SHEET = (
    "jawOpen",
    "eyeBlinkLeft",
    "mouthSmileLeft",
    "mouthSmileRight",
    "mouthFunnel",
    "mouthPucker",
    "browInnerUp",
    "browDownLeft",
    "noseSneerLeft",
    "cheekPuff",
    "mouthLeft",
)


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    parser.add_argument("folder", nargs="?", type=Path, default=Path("facepipe-demo"), metavar="DIR", help="where to")
    parser.add_argument("--seed", type=int, default=0, help="which sample head (default 0)")
    parser.add_argument("--force", action="store_true", help="overwrite the files of an earlier demo")


def run(arguments: argparse.Namespace) -> int:
    """Make all files, print what was made."""
    from facepipe.core.atomic import hidden_folder, replacing, replacing_folder, together

    start, folder = time.perf_counter(), Path(arguments.folder)
    for name in (*FILES, TEXTURES):
        check_written(folder / name)
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "is a file, expected a folder")
    there = [name for name in (*FILES, TEXTURES) if (folder / name).exists()]
    if there and not arguments.force:
        raise InputError(folder / there[0], "exists, expected a new folder (or --force)")
    check_written(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with hidden_folder(folder) as inner:
        errors = _made(inner, arguments.seed)
        with together(folder / FILES[0]):
            for name in FILES:
                with replacing(folder / name) as temporary:
                    (inner / name).replace(temporary)
            with replacing_folder(folder / TEXTURES) as temporary:
                for image in (inner / TEXTURES).iterdir():
                    image.replace(temporary / image.name)
    print(f"\n{folder}: {', '.join((*FILES, TEXTURES))}\ndone in {time.perf_counter() - start:.1f} s")
    return 1 if errors else 0


def _made(folder: Path, seed: int) -> int:
    """Make the files in `folder`; the number of errors found in them."""
    import io

    import numpy as np

    import facepipe
    from facepipe.checks import validate
    from facepipe.core.atomic import write_bytes
    from facepipe.performing import perform
    from facepipe.pictures import PictureOptions, contact_sheet, poses, save_png
    from facepipe.verbs.sample import Sample

    path = {name: folder / name for name in FILES}
    with progress("demo", 5) as bar:
        perform(Sample(seed=seed, textures=_TEXTURES), path["head.usdc"])
        bar.update()
        face = facepipe.open(path["head.usdc"])
        print(report_of(face).as_text(path["head.usdc"]))
        for name in ("head.glb", "head.onnx"):
            exporter = registry.exporter(path[name])
            report = exporter.export(face, path[name], exporter.Options())
            print(f"\n{name}: {report.bytes:,} bytes in {report.seconds:.2f} s")
            bar.update()
        errors = 0
        for name in ("head.usdc", "head.glb", "head.onnx"):
            findings = [one for one in validate(path[name]) if one.severity != "info" or "NotInstalled" in one.check]
            errors += sum(finding.severity == "error" for finding in findings)
            good = all(finding.severity == "info" for finding in findings)
            print("\n".join([f"{name}: {'no errors, no warnings' if good else ''}", *(f"  {one}" for one in findings)]))
        bar.update()
        graphs: Any = registry.exporter(path["head.onnx"])
        outputs: dict[str, Any] = graphs.Deformer(path["head.onnx"]).evaluate(POSE)
        buffer = io.BytesIO()
        np.savez(buffer, **outputs)
        write_bytes(path["points.npz"], buffer.getvalue())
        apart = np.linalg.norm(outputs["points"].reshape(-1, 3) - face.evaluate(POSE), axis=1).max()
        print(f"points.npz: onnxruntime agrees with the stage to {apart * face.mm_per_unit:.1e} mm")
        parts = face.parts()
        options = PictureOptions(size=320, view="three-quarter", framing=face.evaluate())
        shapes = [name for name in SHEET if name in face.shapes]
        points = [face.evaluate(), *(face.evaluate({name: 1.0}) for name in shapes)]
        images = zip(("neutral", *shapes), poses(parts, points, options), strict=True)
        save_png(contact_sheet(list(images), columns=4), path["sheet.png"])
        bar.update()
    print("\nsheet.png: the face and its shapes")
    return errors
