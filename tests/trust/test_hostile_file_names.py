"""Names that files of others bring along never choose where something is written."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest
from faces import tiny_face
from hypothesis import example, given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

import facepipe
from facepipe.core.errors import InputError
from facepipe.core.names import file_name
from facepipe.parts import FaceParts, Material, Texture, TextureInput
from facepipe.scanning.rebuild import read_project
from facepipe.stage import save_parts

IMAGE = b"\x89PNG\r\n\x1a\n"
HOSTILE = (
    *(
        "../../out.png",
        "..\\..\\out.png",
        "/out.png",
        "C:\\out.png",
        "C:out.png",
        "\\\\host\\share\\out.png",
        "..",
        ".",
    ),
    *("", "CON", "con.png", "nul.tar.png", "COM1.png", "a:b.png", "a.png:stream", "a\0b.png", "a\nb.png"),
    *("<UDIM>.png", ".facepipe-0123456789abcdef", ".facepipe-journal", "~/out.png", "$HOME.png", "x" * 5000 + ".png"),
    *("skin.png", "SKIN.png", "Skin.png", "skin.png.", "skin.png ", "a\ud800.png"),
)
DEVICES = {"CON", "PRN", "AUX", "NUL", "CONIN$", "CONOUT$", *(f"{one}{n}" for one in ("COM", "LPT") for n in range(10))}


@settings(deadline=None)
@given(st.text())
@example("con .png")
@example("conin$")
@example("com1.tar.gz")
@example("a.bcdefghij k")
@example("b" * 199 + " " + "b" * 99)
def test_a_name_is_one_plain_file_on_any_system(text: str) -> None:
    name = file_name(text)
    assert name == file_name(name)
    assert name
    assert len(name.encode()) < 255 - 8
    assert name.isprintable()
    assert not name.startswith(".")
    assert name == name.strip(" .")
    assert not set(name) & set('/\\<>:"|?*')
    assert name.partition(".")[0].strip().upper() not in DEVICES


def _textured(names: tuple[str, ...]) -> FaceParts:
    materials = [
        Material(
            name=f"m{number}",
            diffuse_color=TextureInput(texture=Texture(name=name, data=IMAGE + bytes([number])), channels="rgb"),
        )
        for number, name in enumerate(names)
    ]
    return dataclasses.replace(tiny_face(), materials=tuple(materials))


def test_textures_of_hostile_names_come_beside_the_stage_alone(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    save_parts(_textured(HOSTILE), tmp_path / "in/face.usda")
    assert [one.name for one in tmp_path.iterdir()] == ["in"]
    assert sorted(one.name for one in (tmp_path / "in").iterdir()) == ["face.usda", "face_textures"]
    written = [one.name for one in (tmp_path / "in/face_textures").iterdir()]
    assert len(written) == len(HOSTILE) == len({name.casefold() for name in written})
    read = facepipe.open(tmp_path / "in/face.usda").materials
    found = {one.name: one.diffuse_color.texture.data for one in read if isinstance(one.diffuse_color, TextureInput)}
    assert found == {f"m{number}": IMAGE + bytes([number]) for number in range(len(HOSTILE))}


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_a_folder_of_textures_that_leads_elsewhere_is_not_written(tmp_path: Path) -> None:
    for name in ("in", "out"):
        (tmp_path / name).mkdir()
    (tmp_path / "in/face_textures").symlink_to("../out")
    with pytest.raises(InputError, match=r"face_textures.*outside the roots"):
        save_parts(_textured(("a.png",)), tmp_path / "in/face.usda")
    assert not any((tmp_path / "out").iterdir())
    (tmp_path / "facepipe.toml").touch()
    save_parts(_textured(("a.png",)), tmp_path / "in/face.usda")
    assert (tmp_path / "out/a.png").read_bytes() == IMAGE + b"\0"


@pytest.mark.parametrize("name", ["con", "LPT1", "..", "../x", "a b"])
def test_expressions_have_names_that_files_can_have(tmp_path: Path, name: str) -> None:
    for file in ("head.usda", "faces.fpdb", "scan.ply"):
        (tmp_path / file).touch()
    project = tmp_path / "anna.toml"
    head = 'template = "head.usda"\ndatabase = "faces.fpdb"\n[neutral]\nscan = "scan.ply"\n'
    project.write_text(f'{head}[expressions."{name}"]\nscan = "scan.ply"\nweights = {{ jawOpen = 1 }}\n')
    with pytest.raises(InputError, match="expected a name of letters, digits and underscores that files can have"):
        read_project(project)


@pytest.mark.needs_torch
def test_networks_with_data_in_other_files_are_refused(tmp_path: Path) -> None:
    """In constants of nodes too, which the runtime would read."""
    from facepipe.networks.onnx_file import read_model

    tensor = helper.make_tensor("t", TensorProto.FLOAT, [1], [1.0])
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="../secret.bin")
    node = helper.make_node("Constant", [], ["y"], value=tensor)
    inner = helper.make_graph([node], "g", [], [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1])])
    outer = helper.make_node("If", ["c"], ["z"], then_branch=inner, else_branch=inner)
    for nodes in ([node], [outer]):
        graph = helper.make_graph(nodes, "g", [], [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1])])
        path = tmp_path / "net.onnx"
        path.write_bytes(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 15)]).SerializeToString())
        with pytest.raises(InputError, match="has its data in another file"):
            read_model(path)
