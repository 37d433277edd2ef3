"""What USD follows by recursion, or in the square of its number, is counted when a stage is opened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faces import tiny_face
from layers import prim, write
from photo_files import png_of
from pxr import Usd, UsdSkel

from facepipe.checks import validate_stage
from facepipe.core.errors import InputError, SchemaError
from facepipe.core.policy.bounds import MOST_OF
from facepipe.importers import load
from facepipe.parts import Material, Texture, TextureInput
from facepipe.stage import Face, open_face, save_parts
from facepipe.stage.composition import MOST_STEPS
from facepipe.stage.files import open_stage
from facepipe.stage.read_mesh import MOST_INBETWEENS

MANY = 2000  # USD runs off its stack from some 20,000 on


def test_an_image_that_many_materials_name_is_read_once(tmp_path: Path) -> None:
    face, texture = tiny_face(), Texture(name="skin.png", data=png_of(np.full((8, 8, 3), 90, np.uint8)))
    source = TextureInput(texture=texture, channels="rgb")
    materials = tuple(Material(name=name, diffuse_color=source, normal=source) for name in ("one", "two"))
    save_parts(replace(face, materials=materials), tmp_path / "face.usda")
    read = [used.texture.data for one in open_face(tmp_path / "face.usda").materials for used in one.textured.values()]
    assert len(read) == 4
    assert len({id(data) for data in read}) == 1


def test_more_meshes_than_a_face_can_have_are_not_written(tmp_path: Path) -> None:
    face = tiny_face()
    with pytest.raises(InputError, match="4097 prims of type Mesh, expected at most 4096"):
        save_parts(replace(face, meshes=face.meshes[:1] * 4097), tmp_path / "face.usda")
    assert not list(tmp_path.iterdir())


def schemas(count: int = 6000) -> str:
    names = ", ".join(f'"CollectionAPI:c{i}"' for i in range(count))
    return prim("a0", f"prepend apiSchemas = [{names}]")


def schemas_of_many_prims(count: int = 100) -> str:
    """None has too many; together they have."""
    names = ", ".join(f'"CollectionAPI:c{i}"' for i in range(count))
    return "".join(prim(f"a{i}", f'prepend apiSchemas = [{names}, "X{i}API"]') for i in range(200))


def connections(count: int = MANY) -> str:
    inputs = "".join(f"float inputs:i{i}.connect = </a0.inputs:i{i + 1}>\n" for i in range(count))
    return prim("a0", "", inputs + f"float inputs:i{count} = 1")


def relationships(count: int = MANY) -> str:
    return prim("a0", "", "".join(f"rel r{i} = </a0.r{i + 1}>\n" for i in range(count)) + f"rel r{count}")


def forking_connections(count: int = 40) -> str:
    """2^40 ways from the first to the last."""
    both = [f"[</a0.x{i + 1}>, </a0.y{i + 1}>]" for i in range(count)]
    pairs = (f"float {name}{i}.connect = {both[i]}\n" for i in range(count) for name in "xy")
    return prim("a0", "", "".join(pairs) + f"float x{count} = 1\nfloat y{count} = 1")


def circle() -> str:
    return prim("a0", "", "float x.connect = </a0.y>\nfloat y.connect = </a0.z>\nfloat z.connect = </a0.x>")


def deep_joints(count: int = 300) -> str:
    joints = ", ".join('"' + "/".join("j" * i) + '"' for i in range(1, count))
    return f'def Skeleton "a0"\n{{\nuniform token[] joints = [{joints}]\n}}\n'


BOMBS: dict[Callable[[], str], str] = {
    schemas: "6000 API schemas",
    schemas_of_many_prims: "API schemas",
    connections: "leads through more than",
    relationships: "leads through more than",
    forking_connections: "leads through more than",
    circle: "leads back to itself",
    deep_joints: "nests joints more than",
}


@pytest.mark.parametrize("bomb", BOMBS, ids=lambda one: one.__name__)
def test_what_leads_too_far_is_refused_in_one_line(bomb: Callable[[], str], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=BOMBS[bomb]) as caught:
        open_stage(write(tmp_path, {"bomb.usda": bomb()}), strict=False)
    assert "\n" not in str(caught.value)


def test_chains_of_the_most_steps_open(tmp_path: Path) -> None:
    write(tmp_path, {"most.usda": relationships(MOST_STEPS), "more.usda": relationships(MOST_STEPS + 1)})
    assert open_stage(tmp_path / "most.usda").GetDefaultPrim()
    with pytest.raises(InputError, match=f"leads through more than {MOST_STEPS}"):
        open_stage(tmp_path / "more.usda")


def test_chains_over_references_are_counted_as_composed(tmp_path: Path) -> None:
    """No layer has more than a part of the chain."""
    part, parts = 100, 20
    layers = {"shot.usda": prim("a0", "references = [" + ", ".join(f"@./l{i}.usda@" for i in range(parts)) + "]")}
    for i in range(parts):
        links = (f"rel r{j} = </a0.r{j + 1}>\n" for j in range(part * i, part * (i + 1)))
        layers[f"l{i}.usda"] = prim("a0", "", "".join(links))
    with pytest.raises(InputError, match="leads through more than"):
        open_stage(write(tmp_path, layers))


def test_what_productions_have_opens(tmp_path: Path) -> None:
    """Hundreds of sliders' schemas, lists of thousands of properties, networks through many graphs, long tails."""
    attributes = "".join(f"float x{i} = 1\n" for i in range(5000))
    listed = "rel all = [" + ", ".join(f"</a0.x{i}>" for i in range(5000)) + "]\nrel again = </a0.all>\n"
    layers = {
        "schemas.usda": schemas(600),
        "lists.usda": prim("a0", "", attributes + listed),
        "connections.usda": connections(200),
        "joints.usda": deep_joints(150),
    }
    write(tmp_path, layers)
    for name in layers:
        assert open_stage(tmp_path / name).GetDefaultPrim()
    lists = open_stage(tmp_path / "lists.usda")
    assert len(lists.GetRelationshipAtPath("/a0.again").GetForwardedTargets()) == 5000


def test_inbetweens_are_counted(tmp_path: Path) -> None:
    """Each is a curve through all."""
    path = tmp_path / "face.usda"
    save_parts(tiny_face(), path)
    stage = Usd.Stage.Open(str(path))
    shape = UsdSkel.BlendShape(next(one for one in stage.Traverse() if one.GetName() == "mouthSmileLeft"))
    offsets = shape.GetOffsetsAttr().Get()
    for i in range(MOST_INBETWEENS + 1):
        inbetween = shape.CreateInbetween(f"i{i}")
        inbetween.SetWeight((i + 1) / (MOST_INBETWEENS + 3))
        inbetween.SetOffsets(offsets)
    stage.Save()
    with pytest.raises(SchemaError, match="inbetweens, expected at most"):
        Face(open_stage(path)).parts()
    assert any("inbetweens, expected at most" in one.message for one in validate_stage(path))
    stage.GetPrimAtPath(shape.GetPath()).RemoveProperty("inbetweens:i0")
    stage.Save()
    read = next(
        blendshape
        for blendshape in Face(open_stage(path)).parts().meshes[0].blendshapes
        if blendshape.name == "mouthSmileLeft"
    )
    assert len(read.inbetweens) == MOST_INBETWEENS


@pytest.mark.parametrize("kind", ["Material", "GeomSubset"])
def test_kinds_of_prims_that_take_a_while_to_read_are_counted(tmp_path: Path, kind: str) -> None:
    most = MOST_OF[kind]
    file = tmp_path / "face.usda"
    save_parts(tiny_face(), file)
    many = "".join(f'    def {kind} "x{number}" {{}}\n' for number in range(most + 1))
    text = file.read_text().rstrip()
    file.write_text(f"{text.removesuffix('}')}{many}}}\n")
    readers: list[Callable[[Path], object]] = [open_face, validate_stage, lambda path: load("usd", path)]
    for read in readers:
        with pytest.raises(InputError, match=rf"\d+ prims of type {kind}, expected at most {most}"):
            read(file)
