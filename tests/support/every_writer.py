"""Every command that writes, in the folder it runs in: `python every_writer.py SEED`.

Folders list their files in an order of chance, that of SEED. Pictures have one sample a pixel, and lamps of photos are
looked for in few directions: that is quick, and leaves no step out.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import live_link
import numpy as np
import scan_domes
import started
from baked_face import put_fitted
from facepipe_blender.addon import write_own_wheel
from import_data import SHARED
from network_faces import network, networked
from photographed_face import write_photos
from PIL import Image
from rebuild_stages import put_scans
from small_head import make
from turning_clip import portrait, write_video

from facepipe.cli import main
from facepipe.scanning.database import save_database
from facepipe.stage import save_parts

HEADS = """
sample head.usda --textures 0
sample other.usdc --seed 1 --textures 0
sample third.usdz --seed 2 --textures 0
sample dressed.usda --seed 3 --textures 128
export head.usda -o head.gltf --animations
export head.usda -o head.glb --quantize
export head.usda -o head.vrm --stub-body --authors me --license-url https://vrm.dev/licenses/1.0/
export head.usda -o head.onnx --normals
export head.usda -o sliders.onnx --sliders --points --weights int8
import gltf head.gltf imported.usda
import obj objects objects.usda
import usd other.usdc others.usda
animate head.usda take.csv -o take.usda
landmarks head.usda --from points.json --scheme mine -o marked.usda
regions head.usda --map map.png --legend legend.json -o painted.usda --picture painted.png
render head.usda -o head.png --size 200 --set jawOpen=0.7
blend head.usda other.usdc third.usdz -o mix.usda --set mouth=0.2,0.3,0.5 --region-width-mm 8 --heatmap mix.png
blend --match other.usdc head.usda third.usdz -o match.usda
database create head.usda other.usdc third.usdz -o faces.fpdb
database add faces.fpdb mix.usda -o more.fpdb --ignore-quality
database remove more.fpdb third -o fewer.fpdb
fit-bones head.usda --target mix.usda -o bones.usda --coefficients bones.fpb --heatmap bones.png --max-iterations 4
apply-bones head.usda bones.fpb -o applied.usda
apply-bones head.usda bones.fpb -o applied.npz
person mix.usda -o mix.fpb --bytes 1300
basis -o mix.fpbasis --template mix.usda
apply-bones head.usda mix.fpb -o mixed.usda
sliders head.usda --set noseWidth=0.8 -o person.usda
cook person.usda --force
sliders head.usda --from-shapes jaw*,mouthSmile* -o own.usda --replace --residual
skin objects.usda --joints joints.json -o skinned.usda --picture skinned.png
skin third.usdz --from head.usda -o moved.usda --optimise --iterations 1
train-photo head.usda -o start.onnx --people 1024 --renders 8 --epochs 1 --steps 1
fit-photo front.png head.usda --landmarks front.json -o me.usda --report me --start start.onnx \
--iterations 1 --size 64 --identity 0
choose-frames clip.mp4 -o frames
bake-photo painted/fitted.usda painted/front.png -o photographed.usda --size 128
transfer head.usda -o given.usda --shapes jawOpen eyeBlinkLeft --replace
lod head.usda --triangles 8000,2500 -o lods.usda
export lods.usda -o lods.glb --lods
lod third.usdz --triangles 3000 --flatten -o flat_lods.usdc
import ict ict.npz ict.usdc --identity-seed 7
import makehuman makehuman.npz mh.usdc --sliders arkit
import ict ict.npz icts.usdc --identity-seed 8
skin ict.usdc --learn-from icts.usdc --count 4 -o learnt.usda
"""
DOMES = """
export tiny.usda -o learned.onnx --sliders --distil --distil-steps 100 --distil-threshold-mm 100
bake dome.usda -o motion.usdc --spread 10 --sweep 3 --together 5
neural-rig train dome.usda -o dome.fpnr --spread 200 --sweep 9 --together 50 --steps 100 --encoder-steps 20
neural-rig apply dome.usda dome.fpnr -o neural.usda
neural-rig invert dome.fpnr motion.usdc -o controls.usda
neural-rig retarget dome.fpnr person.usda --frames person_motion.usdc -o person.fpnr
export dome.usda -o rig.onnx --neural dome.fpnr
export dome.usda -o encoder.onnx --neural dome.fpnr --encoder
fit-neutral anna.ply --template head.usda --database faces.fpdb -o fitted.usda --picture fitted.png
conform anna.ply --template head.usda --database faces.fpdb -o conformed.usda
refine-neutral fitted.usda anna.ply -o refined.usda
personal-template anna.usda --template head.usda -o personal.usda
register-scan open.ply --personal personal.usda -o open.usda --weights jawOpen=0.8
register-scan both.ply --personal personal.usda -o both.usda --weights jawOpen=0.4 browUp=1
split-shapes open.usda both.usda --personal personal.usda -o actor.usda
rebuild anna.toml -o rebuilt.usda --joint --report rebuilt
"""
PROJECT = """
template = "head.usda"
database = "faces.fpdb"
[neutral]
scan = "anna.ply"
[expressions.open]
scan = "open.ply"
weights = { jawOpen = 0.8 }
"""


def work(seed: int) -> None:
    """Write all of it."""
    started.watch()
    _list_in_any_order(random.Random(seed))
    write_own_wheel(Path())
    for name, put, lines in (("heads", _put_heads, HEADS), ("domes", _put_domes, DOMES)):
        Path(name).mkdir()
        os.chdir(name)
        put()
        for line in lines.strip().splitlines():
            assert main(line.split()) in (0, 1), line
        os.chdir("..")


def _put_heads() -> None:
    parts = make(0)
    write_photos(parts, Path())
    Path("painted").mkdir()
    painted = make(0, textures=64)
    put_fitted(painted, painted, Path("painted"), size=64, front=0.0)
    live_link.write(Path("take.csv"), live_link.performance(20))
    write_video(Path("clip.mp4"), [portrait(yaw, 0) for yaw in (0, 30)])
    _put("points.json", {"nose": 3, "chin": 4})
    places = {"neck": (0, 150, 0), "neck/head": (0, 160, 0), "neck/head/jaw": (0, 158, 2)}
    _put("joints.json", {"unit": "cm", "joints": {name: {"position": place} for name, place in places.items()}})
    colors = np.zeros((64, 64, 3), np.uint8)
    colors[:, :32, 0] = colors[:, 32:, 1] = 255
    Image.fromarray(colors).save("map.png")
    _put("legend.json", {"#ff0000": "left", "#00ff00": "right"})
    mesh = parts.meshes[0]
    corners = np.split(mesh.face_vertex_indices + 1, np.cumsum(mesh.face_vertex_counts)[:-1])
    faces = "".join(f"f {' '.join(map(str, one))}\n" for one in corners)
    Path("objects").mkdir()
    for name, factors in {"neutral": (1, 1, 1), "wide": (1.1, 1, 1), "long": (1, 1.1, 1), "deep": (1, 1, 1.1)}.items():
        points = "".join(f"v {x:.5f} {y:.5f} {z:.5f}\n" for x, y, z in mesh.points * factors)
        Path("objects", f"{name}.obj").write_text(points + faces)
    shutil.copy(SHARED / "ict_facekit/ict_facekit.npz", "ict.npz")
    shutil.copy(SHARED / "makehuman/makehuman_head.npz", "makehuman.npz")


def _put_domes() -> None:
    put_scans(Path())
    save_database(scan_domes.database(), Path("faces.fpdb"))
    Path("anna.toml").write_text(PROJECT)
    save_parts(networked(network()), Path("tiny.usda"))
    for seed, name in enumerate(("dome", "person")):
        save_parts(scan_domes.face(seed), Path(f"{name}.usda"))
    assert (
        main(["bake", "person.usda", "-o", "person_motion.usdc", "--spread", "20", "--sweep", "3", "--together", "5"])
        == 0
    )


def _put(name: str, value: Any) -> None:
    Path(name).write_text(json.dumps(value))


def _list_in_any_order(order: random.Random) -> None:
    """As other file systems list folders, which promise none."""

    class Listing:
        """What `os.scandir` returns."""

        def __init__(self, found: Iterator[Any]) -> None:
            with found:
                self._left = sorted(found, key=lambda entry: entry.name)
            order.shuffle(self._left)

        def __enter__(self) -> Listing:
            return self

        def __exit__(self, *_: object) -> None: ...

        def __iter__(self) -> Listing:
            return self

        def __next__(self) -> Any:
            if not self._left:
                raise StopIteration
            return self._left.pop()

        def close(self) -> None: ...

    def shuffled(listed: Callable[..., list[Any]]) -> Callable[..., list[Any]]:
        def listing(*folder: Any) -> list[Any]:
            names = sorted(listed(*folder))
            order.shuffle(names)
            return names

        return listing

    scanned = os.scandir
    os.scandir = lambda *folder: Listing(scanned(*folder))  # type: ignore[assignment,misc]
    os.listdir = shuffled(os.listdir)  # type: ignore[assignment]


if __name__ == "__main__":
    work(int(sys.argv[1]))
