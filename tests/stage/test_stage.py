"""Faces to stages and back; override layers; saves that are whole or not at all."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faces import replace_mesh, tiny_face
from full_faces import PNG, full_face, full_photo
from parts_differences import assert_same
from places import SUPPORT
from pxr import Usd, UsdGeom, UsdSkel

import facepipe
from facepipe import parts as p
from facepipe.core.errors import FacepipeError, InputError, SchemaError
from facepipe.stage import save_parts
from facepipe.stage.author_changes import author_changes


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usd", ".usdz"])
def test_round_trip_of_every_field(tmp_path: Path, suffix: str) -> None:
    parts = full_face()
    save_parts(parts, tmp_path / f"face{suffix}")
    face = facepipe.open(tmp_path / f"face{suffix}")
    assert_same(parts, face.parts())


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_same_parts_same_bytes(tmp_path: Path, suffix: str) -> None:
    for folder, later in {"a": 0.0, "b": 2.1 if suffix == ".usdz" else 0.01}.items():
        time.sleep(later)  # zip times are even seconds
        (tmp_path / folder).mkdir()
        save_parts(full_face(), tmp_path / folder / f"face{suffix}")
    files = [(tmp_path / folder / f"face{suffix}").read_bytes() for folder in ("a", "b")]
    assert files[0] == files[1]


def test_conventions_on_the_stage(tmp_path: Path) -> None:
    save_parts(full_face(), tmp_path / "face.usda")
    stage = Usd.Stage.Open(str(tmp_path / "face.usda"))
    root = stage.GetDefaultPrim()
    assert root.IsA(UsdSkel.Root)
    assert "FacepipeFaceAPI" in root.GetAppliedSchemas()
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.1
    head = stage.GetPrimAtPath("/Tiny/Head")
    binding = UsdSkel.BindingAPI(head)
    assert binding.GetJointIndicesPrimvar().GetElementSize() == binding.GetJointWeightsPrimvar().GetElementSize() == 3
    assert binding.GetGeomBindTransformAttr().HasAuthoredValue()
    assert UsdGeom.PrimvarsAPI(head).GetPrimvar("facepipe:region:mouth").GetInterpolation() == "vertex"
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Tiny/Animations/pose"))
    assert animation.GetScalesAttr().HasAuthoredValue()


def test_override_layer_holds_only_what_changed(tmp_path: Path) -> None:
    source, out = tmp_path / "face.usda", tmp_path / "deep" / "out.usda"
    out.parent.mkdir()
    save_parts(full_face(), source)
    before = source.read_bytes()
    face = facepipe.open(source)
    with face.deriving(out) as derived:
        derived.prim.GetAttribute("facepipe:attribution").Set("changed")
    text = out.read_text()
    assert "@../face.usda@" in text
    assert "points" not in text
    assert str(tmp_path) not in text
    again = facepipe.open(out)
    assert again.parts().attribution == "changed"
    assert (again.up_axis, again.meters_per_unit) == ("Z", 0.1)
    assert source.read_bytes() == before


def test_flattened_derivation_stands_alone(tmp_path: Path) -> None:
    save_parts(tiny_face(), tmp_path / "face.usda")
    with facepipe.open(tmp_path / "face.usda").deriving(tmp_path / "out.usdc", flatten=True) as derived:
        derived.prim.GetAttribute("facepipe:attribution").Set("changed")
    (tmp_path / "face.usda").unlink()
    assert len(facepipe.open(tmp_path / "out.usdc").evaluate()) == 45


def test_a_failed_derivation_writes_nothing(tmp_path: Path) -> None:
    save_parts(tiny_face(), tmp_path / "face.usda")
    face = facepipe.open(tmp_path / "face.usda")
    with pytest.raises(RuntimeError), face.deriving(tmp_path / "out.usda"):
        raise RuntimeError
    assert sorted(one.name for one in tmp_path.iterdir()) == ["face.usda"]
    with pytest.raises(InputError, match="the input itself"), face.deriving(tmp_path / "face.usda"):
        pass


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_kill_in_the_middle_of_a_save_leaves_the_old_file_whole(tmp_path: Path) -> None:
    """The saver kills itself before and after each step that the disk sees; the file is one of the two versions."""
    target = tmp_path / "face.usda"
    save_parts(replace(tiny_face(), attribution="old"), target)
    program = (
        "import os, signal, sys; sys.path.insert(0, sys.argv[2])\n"
        "from dataclasses import replace\nfrom faces import tiny_face\nfrom facepipe.stage import save_parts\n"
        "def die(*_): os.kill(os.getpid(), signal.SIGKILL)\n"
        "def hook(event, arguments): event == 'os.rename' and die()\n"
        "flush = os.fsync\n"
        "if sys.argv[3] == 'flushed': os.fsync = lambda file: (flush(file), die())\n"
        "if sys.argv[3] == 'renaming': sys.addaudithook(hook)\n"
        "if sys.argv[3] == 'renamed':\n"
        "    import facepipe.core.atomic; facepipe.core.atomic.sync_folder = die\n"
        "save_parts(replace(tiny_face(), attribution='new ' * 40000), sys.argv[1])\n"
    )
    for moment in ("flushed", "renaming", "renamed"):
        command = [sys.executable, "-c", program, str(target), str(SUPPORT), moment]
        assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
        text = target.read_text()
        assert text.rstrip().endswith("}"), "a half-written file"
        assert ('"old"' in text, text.count("new ")) == ((False, 40000) if moment == "renamed" else (True, 0))
        assert (len(list(tmp_path.iterdir())), len(list(tmp_path.glob(".facepipe-*")))) == (2, 1)
    save_parts(tiny_face(), target)
    assert list(tmp_path.iterdir()) == [target]


def test_textures_of_another_stage_are_not_overwritten(tmp_path: Path) -> None:
    parts = full_face()
    save_parts(parts, tmp_path / "face.usda")
    other = p.Texture(name="skin.png", data=PNG + b"\0")
    changed = replace(parts.materials[0], diffuse_color=p.TextureInput(texture=other), normal=None)
    save_parts(replace(parts, materials=(changed, parts.materials[1])), tmp_path / "face.usdc")
    assert_same(parts, facepipe.open(tmp_path / "face.usda").parts())
    again = facepipe.open(tmp_path / "face.usdc").materials[0].diffuse_color
    assert isinstance(again, p.TextureInput)
    assert again.texture.data == PNG + b"\0"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.usda", b"", "can't be read as USD"),
        ("empty.usdc", b"", "can't be read as USD"),
        ("wrong.usdc", b"PXR-USDC" + bytes(100), "can't be read as USD"),
        ("noface.usda", b'#usda 1.0\ndef Xform "A" {}\n', "FacepipeFaceAPI"),
        ("loop.usda", b'#usda 1.0\n(defaultPrim="A")\ndef "A" (references=@./loop.usda@</A>){}\n', "Cycle"),
        ("self.usda", b"#usda 1.0\n(subLayers=[@./self.usda@])\n", "composition error"),
        ("gone.usda", b'#usda 1.0\ndef "A" (references=@./gone2.usda@){}\n', "gone2"),
        ("data.txt", b"hello", "suffix"),
    ],
)
def test_bad_files_are_one_line_errors(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FacepipeError, match=message) as caught:
        facepipe.open(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_stage_without_face_names_the_way_out(tmp_path: Path) -> None:
    (tmp_path / "other.usda").write_text('#usda 1.0\ndef SkelRoot "A" {}\n')
    with pytest.raises(SchemaError, match="facepipe import usd"):
        facepipe.open(tmp_path / "other.usda")
    with pytest.raises(InputError, match="no such file"):
        facepipe.open(tmp_path / "gone.usda")


def test_nan_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    parts = tiny_face()
    points = parts.meshes[0].points.copy()
    points[3, 1] = np.nan
    bad = replace(parts, meshes=(replace_mesh(parts.meshes[0], points=points),))
    with pytest.raises(InputError, match="Tiny -> Head -> points: NaN or infinity, expected finite"):
        save_parts(bad, tmp_path / "face.usda")
    assert not list(tmp_path.iterdir())


def _with_number(number: float, place: str) -> p.FaceParts:
    """A face that holds it in its first mesh, its first shape, an inbetween or a slider."""
    parts = tiny_face()
    head = parts.meshes[0]
    shape = head.blendshapes[0]
    between = shape.inbetweens[0]

    def first(values: object) -> np.ndarray:
        changed = np.array(values, np.float64)
        changed.flat[0] = number
        return changed

    def reshaped(**fields: object) -> p.Mesh:
        return replace_mesh(head, blendshapes=(replace(shape, **fields),))  # type: ignore[arg-type]

    count = len(head.points)
    mesh = {
        "points": lambda: replace_mesh(head, points=first(head.points)),
        "normals": lambda: replace_mesh(head, normals=first(np.ones((count, 3)))),
        "colors": lambda: replace_mesh(head, colors=first(np.ones((count, 3)))),
        "regions -> chin": lambda: replace_mesh(head, regions={"chin": first(np.ones(count))}),
        "jawOpen -> offsets": lambda: reshaped(offsets=first(shape.offsets)),
        "jawOpen -> normal_offsets": lambda: reshaped(normal_offsets=first(shape.normal_offsets)),
        "jawOpen -> half -> offsets": lambda: reshaped(inbetweens=(replace(between, offsets=first(between.offsets)),)),
        "jawOpen -> half -> weight": lambda: reshaped(inbetweens=(replace(between, weight=number),)),
        "transform": lambda: replace_mesh(head, transform=first(np.eye(4))),
    }[place]()
    return replace(parts, meshes=(mesh,))


@pytest.mark.parametrize(
    "place",
    [
        "points",
        "normals",
        "colors",
        "regions -> chin",
        "jawOpen -> offsets",
        "jawOpen -> normal_offsets",
        "jawOpen -> half -> offsets",
        "jawOpen -> half -> weight",
    ],
)
def test_what_float32_makes_infinity_of_is_refused(tmp_path: Path, place: str) -> None:
    save_parts(_with_number(0.5, place), tmp_path / "base.usda")
    bad = _with_number(-1e39, place)
    with pytest.raises(InputError, match=f"^Tiny -> Head -> {place}: NaN, infinity or beyond float32"):
        save_parts(bad, tmp_path / "face.usda")
    with (
        pytest.raises(InputError, match=f"-> Head -> {place}: NaN, infinity or beyond float32"),
        facepipe.open(tmp_path / "base.usda").deriving(tmp_path / "over.usda") as face,
    ):
        author_changes(face, replace(face.parts(), meshes=bad.meshes))
    assert [path.name for path in tmp_path.iterdir()] == ["base.usda"]


def test_transforms_are_float64_in_files(tmp_path: Path) -> None:
    save_parts(_with_number(1e39, "transform"), tmp_path / "face.usda")
    assert facepipe.open(tmp_path / "face.usda").meshes[0].transform[0, 0] == 1e39


@pytest.mark.parametrize("source", [".usdc", ".usdz"])
@pytest.mark.parametrize("out", [".usda", ".usdz"])
def test_standalone_files_can_be_moved(tmp_path: Path, source: str, out: str) -> None:
    first, second, third = (tmp_path / name for name in ("one", "two", "three"))
    first.mkdir()
    second.mkdir()
    save_parts(full_face(), first / f"face{source}")
    with facepipe.open(first / f"face{source}").deriving(second / f"flat{out}", flatten=True) as face:
        face.prim.GetAttribute("facepipe:attribution").Set("changed")
    facepipe.open(first / f"face{source}").save(second / f"saved{out}")
    shutil.rmtree(first)
    second.rename(third)
    assert_same(replace(full_face(), attribution="changed"), facepipe.open(third / f"flat{out}").parts())
    assert_same(full_face(), facepipe.open(third / f"saved{out}").parts())
    if out == ".usda":
        assert str(tmp_path) not in (third / f"flat{out}").read_text()


def test_a_photo_has_a_pixel_or_more(tmp_path: Path) -> None:
    photo = replace(full_photo(), animation=None, tint={})
    save_parts(replace(tiny_face(), photos=(replace(photo, width=1, height=1),)), tmp_path / "face.usda")
    assert [(one.width, one.height) for one in facepipe.open(tmp_path / "face.usda").photos] == [(1, 1)]
    for size in ({"width": 0}, {"height": 0}):
        with pytest.raises(InputError, match="expected 1 to 1048576 each"):
            save_parts(replace(tiny_face(), photos=(replace(photo, **size),)), tmp_path / "none.usda")


def test_recipe_sources_are_seen_from_the_stage(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "source.npz").write_bytes(b"x")
    recipe = p.Recipe(verb="import x", sources=(str(tmp_path / "data" / "source.npz"), "gone.npz"))
    (tmp_path / "out").mkdir()
    save_parts(replace(tiny_face(), recipe=recipe), tmp_path / "out" / "face.usda")
    again = facepipe.open(tmp_path / "out" / "face.usda").parts().recipe
    assert again is not None
    assert again.sources == ("../data/source.npz", "gone.npz")


def test_recipe_options_of_another_type_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "face.usda"
    save_parts(replace(tiny_face(), recipe=p.Recipe(verb="import x", sources=("a",), digests=("sha256:0",))), path)
    text = path.read_text()
    start = text.index("uniform string facepipe:recipe:options")
    line = text[start : text.index("\n", start)]
    path.write_text(text.replace(line, "matrix2d[] facepipe:recipe:options = [((1, 0), (0, 1))]"))
    with pytest.raises(SchemaError, match="recipe:options: no JSON"):
        facepipe.open(path).parts()
