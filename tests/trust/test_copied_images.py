"""Images of others in outputs: only from roots, or the folders of the layers that name them."""

from __future__ import annotations

import os
import shutil
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import exit_code, failed
from full_faces import PNG, full_face
from pxr import Sdf, Usd, UsdUtils

import facepipe
from facepipe.checks import validate
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import Trust, trusting
from facepipe.importers import load
from facepipe.parts import TextureInput
from facepipe.pictures.scene import decode
from facepipe.registry import exporter
from facepipe.stage import Face, save_parts
from facepipe.stage.materials import textures_of
from facepipe.stage.recipes import source_digest

OWN = "./face_textures/skin.png"
SECRET = PNG + b"secret"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A face with its texture in one folder, another image beside that folder."""
    home = tmp_path / "home"
    home.mkdir()
    save_parts(full_face(), home / "face.usda")
    (tmp_path / "secret.png").write_bytes(SECRET)
    return home


def naming(face: Path, image: object) -> Path:
    """The face, with `image` as its texture."""
    face.write_text(face.read_text().replace(f"@{OWN}@", f"@{image}@"))
    return face


def sampled(face: Path, image: object) -> Path:
    """The same where the texture changes over time."""
    old, new = f"asset inputs:file = @{OWN}@", f"asset inputs:file.timeSamples = {{0: @{image}@}}"
    face.write_text(face.read_text().replace(old, new))
    return face


def images_below(folder: Path) -> bytes:
    """All that lies in a folder and in the packages there."""
    files = [one for one in folder.rglob("*") if one.is_file()]
    packed = [zipfile.ZipFile(one) for one in files if one.suffix == ".usdz"]
    return b"".join(
        [*(one.read_bytes() for one in files), *(one.read(name) for one in packed for name in one.namelist())]
    )


def shader_path(face: Path) -> Sdf.Path:
    """The first that reads a file."""
    stage = Usd.Stage.Open(str(face))
    return next(one.GetPath() for one in stage.Traverse() if one.GetAttribute("inputs:file"))


def refused(face: Path, out: Path) -> None:
    """No way out of the face takes the secret along."""
    out.mkdir()
    opened = facepipe.open(face)
    ways: list[Callable[[], object]] = [
        lambda: opened.save(out / "flat.usda"),
        lambda: opened.save(out / "packed.usdz"),
        lambda: save_parts(opened.parts(), out / "parts.usda"),
        lambda: exporter("face.glb").export(opened, out / "face.glb", exporter("face.glb").Options()),
        lambda: decode(next(iter(textures_of(opened.parts()).values())), 64),
    ]
    for way in ways:
        with pytest.raises(InputError, match=r"outside the roots \(.*\), expected --root"):
            way()
    assert images_below(out) == b""


@pytest.mark.parametrize("image", ["../secret.png", "{}/secret.png", "face_textures/../../secret.png", "link.png"])
def test_images_elsewhere_are_not_copied(home: Path, tmp_path: Path, image: str) -> None:
    if image == "link.png":
        if sys.platform == "win32":
            pytest.skip("links need rights there")
        (home / "between.png").symlink_to("../secret.png")
        (home / image).symlink_to("between.png")
    refused(naming(home / "face.usda", image.format(tmp_path)), tmp_path / "out")


def test_images_that_change_over_time_are_not_copied(home: Path, tmp_path: Path) -> None:
    face = sampled(home / "face.usda", tmp_path / "secret.png")
    with pytest.raises(InputError, match="outside the roots"):
        facepipe.open(face).save(tmp_path / "flat.usda")
    imported = load("usd", face)
    assert not isinstance(imported.parts.materials[0].diffuse_color, TextureInput)
    assert any("outside the roots" in line and line.endswith("left out") for line in imported.warnings)


def test_images_of_value_clips_are_not_copied(home: Path, tmp_path: Path) -> None:
    """A clip of another folder names them, by samples that no other layer has."""
    face, clip = home / "face.usda", home / "clip.usda"
    shader = shader_path(face)
    clip.write_text("#usda 1.0\n")
    layer = Sdf.Layer.FindOrOpen(str(clip))
    attribute = Sdf.AttributeSpec(Sdf.CreatePrimInLayer(layer, shader), "inputs:file", Sdf.ValueTypeNames.Asset)
    layer.SetTimeSample(attribute.path, 0.0, Sdf.AssetPath("../secret.png"))
    layer.Save()
    face.write_text(face.read_text().replace(f"asset inputs:file = @{OWN}@", "asset inputs:file"))
    stage = Usd.Stage.Open(str(face))
    clips = Usd.ClipsAPI(stage.GetPrimAtPath(shader))
    clips.SetClipAssetPaths([Sdf.AssetPath("./clip.usda")])
    clips.SetClipManifestAssetPath(Sdf.AssetPath("./clip.usda"))
    clips.SetClipPrimPath(str(shader))
    clips.SetClipActive([(0, 0)])
    clips.SetClipTimes([(0, 0)])
    stage.Save()
    with pytest.raises(InputError, match="outside the roots"):
        facepipe.open(face).save(tmp_path / "flat.usda")
    assert not isinstance(load("usd", face).parts.materials[0].diffuse_color, TextureInput)


def test_the_layer_that_names_an_image_counts(home: Path, tmp_path: Path) -> None:
    """A studio's asset brings textures beside it or below, wherever it is; over it, a shot can't reach for others."""
    shot = tmp_path / "shows" / "shot"
    shot.mkdir(parents=True)
    face = shot / "face.usda"
    face.write_text(f'#usda 1.0\n(\n    defaultPrim = "Tiny"\n    subLayers = [@{home}/face.usda@]\n)\n')
    facepipe.open(face).save(shot / "flat.usda")
    assert PNG in images_below(shot / "flat_textures")
    stage = Usd.Stage.Open(str(face))
    stage.GetPrimAtPath(shader_path(face)).GetAttribute("inputs:file").Set(Sdf.AssetPath(str(home / "other.png")))
    (home / "other.png").write_bytes(SECRET)
    stage.Save()
    refused(face, tmp_path / "out")


@pytest.mark.parametrize("how", ["--root", "facepipe.toml", "FACEPIPE_ROOTS"])
def test_textures_beside_the_folder_of_a_layer_need_a_root(
    home: Path, tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    face = naming(home / "face.usda", "../secret.png")
    words = ["export", str(face), "-o", str(tmp_path / "face.glb")]
    error = failed(capsys, *words, folder=tmp_path)
    assert "secret.png is outside the roots" in error
    assert error.endswith("expected --root\n")
    if how == "--root":
        words += ["--root", str(tmp_path)]
    elif how == "FACEPIPE_ROOTS":
        monkeypatch.setenv("FACEPIPE_ROOTS", str(tmp_path))
    else:
        (tmp_path / "facepipe.toml").touch()
    assert exit_code(*words) == 0
    facepipe.open(face).save(tmp_path / "packed.usdz") if how == "facepipe.toml" else None


def test_packages_hold_their_textures_and_nothing_else(home: Path, tmp_path: Path) -> None:
    text = home / "private.txt"
    text.write_text("private")
    stage = Usd.Stage.Open(str(home / "face.usda"))
    stage.GetDefaultPrim().CreateAttribute("note", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath("/etc/hostname"))
    stage.GetDefaultPrim().CreateAttribute("notes", Sdf.ValueTypeNames.AssetArray).Set([Sdf.AssetPath("./private.txt")])
    stage.GetDefaultPrim().SetAssetInfoByKey("identifier", Sdf.AssetPath("./private.txt"))
    stage.GetDefaultPrim().SetCustomDataByKey("note", Sdf.AssetPath("./private.txt"))
    stage.Save()
    facepipe.open(home / "face.usda").save(tmp_path / "packed.usdz")
    names = zipfile.ZipFile(tmp_path / "packed.usdz").namelist()
    assert names == ["packed.usdc", "packed_textures/skin.png"]
    facepipe.open(tmp_path / "packed.usdz").save(tmp_path / "flat.usda")  # a package names what is in it
    assert PNG in images_below(tmp_path / "flat_textures")


def test_a_package_can_not_name_files_around_it(home: Path, tmp_path: Path) -> None:
    shutil.copytree(home, tmp_path / "made")
    made = naming(tmp_path / "made" / "face.usda", tmp_path / "secret.png")
    layer = Sdf.Layer.FindOrOpen(str(made))
    assert layer.Export(str(tmp_path / "root.usdc"))
    with Sdf.ZipFileWriter.CreateNew(str(home / "face.usdz")) as package:
        package.AddFile(str(tmp_path / "root.usdc"), "face.usdc")
    refused(home / "face.usdz", tmp_path / "out")


def test_confined_reads_have_no_images_elsewhere(home: Path, tmp_path: Path) -> None:
    """Not even whether they are images."""
    face = naming(home / "face.usda", tmp_path / "text.txt")
    (tmp_path / "text.txt").write_text("text")
    with pytest.raises(InputError, match="is no image"):
        facepipe.open(face).parts()
    policy = Trust(roots=(home,), confined=True)
    with trusting(policy), pytest.raises(InputError, match="outside the roots"):
        facepipe.open(face).parts()
    with trusting(policy), pytest.raises(InputError, match="outside the roots"):
        facepipe.open(face).save(home / "flat.usda")


ARCS = {
    "sublayer": "(\n    subLayers = [@{}@]\n)\n",
    "reference": 'def "A" (\n    references = @{}@</Tiny>\n)\n{{\n}}\n',
    "payload in a variant": """def "A" (
    variantSets = "look"
) {{
    variantSet "look" = {{ "one" (
        payload = @{}@</Tiny>
    ) {{ }} }}
}}
""",
    "value clips": """def "A" (
    clips = {{ dictionary default = {{
        asset[] assetPaths = [@{}@]
        string primPath = "/Tiny"
        double2[] active = [(0, 0)]
    }} }}
) {{
}}
""",
}


@pytest.mark.parametrize("where", ["{}/other.usda", "../other.usda", "./link.usda"])
@pytest.mark.parametrize("arc", ARCS)
def test_confined_reads_have_no_layers_elsewhere(home: Path, tmp_path: Path, arc: str, where: str) -> None:
    """Each is refused before it is opened: it is no layer at all."""
    (tmp_path / "other.usda").write_text("no layer")
    if where == "./link.usda":
        if sys.platform == "win32":
            pytest.skip("links need rights there")
        (home / "link.usda").symlink_to("../other.usda")
    face = home / "over.usda"
    face.write_text("#usda 1.0\n" + ARCS[arc].format(where.format(tmp_path)))
    with trusting(Trust(roots=(home,), confined=True)):
        for read in (facepipe.open, validate, source_digest):
            with pytest.raises(InputError, match="outside the roots"):
                read(face)
        assert facepipe.open(home / "face.usda").parts().materials


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes")
@pytest.mark.parametrize("command", [["inspect"], ["validate"], ["export", "-o", "a.glb"]])
def test_pipes_are_no_textures(
    home: Path, command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(home)
    os.mkfifo("pipe.png")
    naming(home / "face.usda", "./pipe.png")
    assert exit_code(command[0], "face.usda", *command[1:]) in (1, 2)
    out, error = capsys.readouterr()
    assert "is not a regular file" in out + error


def test_stages_in_memory_are_the_callers_word(home: Path, tmp_path: Path) -> None:
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().TransferContent(Sdf.Layer.FindOrOpen(str(home / "face.usda")))
    UsdUtils.ModifyAssetPaths(stage.GetRootLayer(), lambda _: str(tmp_path / "secret.png"))
    Face(stage).save(tmp_path / "flat.usda")
    assert SECRET in images_below(tmp_path / "flat_textures")
