"""A command of each verb that can be cooked, with its files and a change of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import neural_faces
from bone_faces import pose, save_sources, saved, sculpt, skeletonless, small
from cook_chain import TABLE
from faces import tiny_face
from network_faces import network, networked, save_network
from payloads import tiny_payload
from region_painter import legend_of, paint, save
from small_sources import made

import facepipe
from facepipe.neural import save_neural_rig
from facepipe.rig import build
from facepipe.stage import save_parts


@dataclass(frozen=True)
class Case:
    """A line of a command that makes out.usda, the files that it needs, and a change of one of them."""

    line: tuple[str, ...]
    put: Callable[[Path], object]
    change: Callable[[], object]
    code: int = 0  # of the command
    edit: tuple[str, ...] = ()  # what else its --edit is given

    @property
    def command(self) -> tuple[str, ...]:
        """Its words before any argument."""
        return self.line[: 2 if self.line[0] == "neural-rig" else 1]


def _face(name: str = "face.usda", seed: int = 0) -> None:
    save_parts(made(seed), Path(name))


def _text(name: str, text: str) -> None:
    Path(name).write_text(text)


def _with_json(name: str, content: object) -> Callable[[Path], None]:
    def put(folder: Path) -> None:
        _face()
        (folder / name).write_text(json.dumps(content))

    return put


def _two(folder: Path) -> None:
    _face("face.usda", 0)
    _face("other.usda", 1)


def _tabled(folder: Path) -> None:
    _face()
    (folder / "table.toml").write_text(TABLE)


def _learned(folder: Path) -> None:
    save_parts(networked(None), folder / "face.usda")
    save_network(folder / "net.npz", network())


def _mapped(folder: Path) -> None:
    _face()
    head = tiny_face().meshes[0]
    save(paint(head, 16), folder / "map.png")
    (folder / "legend.json").write_text(json.dumps(legend_of(list(head.regions))))


def _skinnable(folder: Path) -> None:
    save_parts(skeletonless(made(0)), folder / "face.usda")
    _text("joints.json", _JOINTS)


def _posed(folder: Path) -> None:
    _face()
    tiny_payload(folder / "pose.fpb")


def _performed(folder: Path) -> None:
    _face()
    _text("take.csv", "jawOpen\n0\n0.25\n1\n")


def _neural(folder: Path) -> None:
    save_parts(neural_faces.face(), folder / "face.usda")
    _rig(0)


def _rig(seed: int) -> None:
    parts = facepipe.open("face.usda").parts()
    save_neural_rig(neural_faces.neural_rig(parts, bones=True, seed=seed), Path("rig.fpnr"), {})


_WEIGHTS = ("--region", "neck=0.3", "--region", "mouth=2.1", "--region", "lips=1.7", "--limits", "limits.json")
_RIG = build(small())
_JOINTS = '{"unit": "mm", "joints": {"head": {"position": [0, 40, -20]}, "head/jaw": {"position": [0, 10, -15]}}}'
_MORE = TABLE + '[slider.up]\nchannels = { "jaw:ty" = 0.25 }\n'
CASES = {
    "animate": Case(
        ("animate", "face.usda", "take.csv", "--resample", "24", "--offset", "0.5", "--name", "hello"),
        _performed,
        lambda: _text("take.csv", "jawOpen\n0\n0.5\n1\n"),
        edit=("--start", "0.01", "--no-name"),
    ),
    "apply-bones": Case(
        ("apply-bones", "face.usda", "pose.fpb", "--name", "open"),
        _posed,
        lambda: tiny_payload(Path("pose.fpb"), scale=1.1),
        edit=("--clamp", "--no-name"),
    ),
    "blend": Case(("blend", "face.usda", "other.usda", "--lock", "mouth=2"), _two, lambda: _face("other.usda", 2)),
    "fit-bones": Case(
        ("fit-bones", "rig.usda", "--target", "goal.usda", "--initial", "talk", *_WEIGHTS),
        save_sources,
        lambda: saved(
            sculpt(small(), build(small()).evaluate(coefficients=pose(build(small()), 2))), Path("goal.usda")
        ),
    ),
    "fit-bones missed": Case(
        ("fit-bones", "rig.usda", "--target", "shapes", "--limits", "limits.json", "--rounds", "0"),
        save_sources,
        lambda: saved(tiny_face(5), Path("rig.usda")),
        code=1,
    ),
    "landmarks": Case(
        ("landmarks", "face.usda", "--from", "points.json", "--scheme", "mine"),
        _with_json("points.json", {"a": 1, "b": 2}),
        lambda: _text("points.json", '{"a": 3, "b": 2}'),
        edit=("--mesh", "Teeth"),
    ),
    "neural-rig": Case(
        ("neural-rig", "apply", "face.usda", "rig.fpnr", "--offset-tolerance-mm", "0.02"),
        _neural,
        lambda: _rig(1),
        edit=("--no-keep-shapes",),
    ),
    "regions": Case(
        ("regions", "face.usda", "--map", "map.png", "--legend", "legend.json", "--edge", "1"),
        _mapped,
        lambda: _text("legend.json", json.dumps(legend_of(["lips", "chin"]))),
        edit=("--tile", "all"),
    ),
    "skin": Case(
        ("skin", "face.usda", "--joints", "joints.json", "--influences", "2"),
        _skinnable,
        lambda: _text("joints.json", _JOINTS.replace("[0, 10", "[0, 20")),
        edit=("--influences", "1"),
    ),
    "sliders from a table": Case(
        ("sliders", "face.usda", "--from", "table.toml", "--replace"), _tabled, lambda: _text("table.toml", _MORE)
    ),
    "sliders from shapes": Case(
        ("sliders", "face.usda", "--from-shapes", "mouthSmileLeft", "--residual", "--replace"),
        lambda folder: _face(),
        lambda: _face(seed=3),
    ),
    "sliders from a network": Case(
        ("sliders", "face.usda", "--from-network", "net.npz"),
        _learned,
        lambda: save_network(Path("net.npz"), network(seed=1)),
    ),
    "sliders set": Case(
        ("sliders", "face.usda", "--set", "jaw=0.5", "--reset"),
        _learned,
        lambda: save_parts(networked(network()), Path("face.usda")),
    ),
}
