"""What a VRM says of its avatar comes through a stage: bones, expressions, looks, springs, constraints and terms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import done
from facepipe_gltf import read as gltf
from facepipe_gltf import vrm
from facepipe_gltf.vrm.options import fault
from facepipe_gltf.vrm_format import section
from faces import tiny_face
from gltf_builder import glb
from node import validate, vrm_facts
from vrm_export import exported, head
from vrm_files import BONES, LICENSE, PICTURE, Person, avatar, former_avatar, in_centimetres, root_of, said

import facepipe
from facepipe.core.errors import InputError
from facepipe.core.reports import ExportReport
from facepipe.parts import FaceParts, HeldFace
from facepipe.rig import build
from facepipe.stage import open_face
from facepipe.stage.author import save_parts
from facepipe.stage.recipes import Imported


def read(path: Path) -> Imported:
    return gltf.read(path, gltf.Options())


def through(data: bytes, folder: Path, **options: Any) -> tuple[bytes, Imported, ExportReport]:
    """The file that a VRM becomes on its way through a stage on disk."""
    (folder / "in.vrm").write_bytes(data)
    imported = read(folder / "in.vrm")
    save_parts(imported.parts, folder / "face.usda")
    report = vrm.export(open_face(folder / "face.usda"), folder / "out.vrm", vrm.Options(**options))
    return (folder / "out.vrm").read_bytes(), imported, report


def changed(data: bytes, change: Any) -> bytes:
    """The file with its JSON changed in place."""
    size = int.from_bytes(data[12:16], "little")
    root = root_of(data)
    change(root)
    return glb(root, data[28 + size :])


@pytest.mark.parametrize("seed", range(4))
def test_every_field_comes_back_whatever_the_order_of_nodes(seed: int, tmp_path: Path) -> None:
    data = avatar(seed)
    out, imported, report = through(data, tmp_path)
    assert said(out) == said(data)
    assert [one["name"] for one in root_of(out)["nodes"]] != [one["name"] for one in root_of(data)["nodes"]]
    assert (imported.warnings, report.dropped, report.added) == ((), (), ())
    again, imported, _ = through(out, tmp_path)
    assert (said(again), imported.warnings) == (said(data), ())
    assert not [one for one in vrm.validate(tmp_path / "out.vrm", khronos=False) if one.severity != "info"]


@pytest.mark.parametrize("unit", ["metres", "centimetres"])
def test_three_vrm_sees_the_same_avatar(unit: str, tmp_path: Path) -> None:
    through(avatar(1) if unit == "metres" else in_centimetres(avatar(1)), tmp_path)
    before, after = (vrm_facts(tmp_path / name) for name in ("in.vrm", "out.vrm"))
    assert after == before
    assert before["meta"]["modification"]
    assert len(before["bones"]) == len(BONES)
    assert len(before["springs"]) == 3
    assert len(before["constraints"]) == 3
    report = validate([tmp_path / "out.vrm"])[tmp_path / "out.vrm"]["issues"]
    assert report["numErrors"] == report["numWarnings"] == 0


@pytest.mark.parametrize("kind", ["tiny", pytest.param("sample", marks=pytest.mark.slow)])
def test_a_stub_body_and_expressions_of_ours_come_back(kind: str, tmp_path: Path) -> None:
    exported(tiny_face() if kind == "tiny" else head(), tmp_path / "head.vrm")
    data = (tmp_path / "head.vrm").read_bytes()
    out, imported, report = through(data, tmp_path)
    assert said(out) == said(data)
    assert imported.warnings == ()
    assert any("human bones that move no point" in line for line in report.added)
    assert not [one for one in vrm.validate(tmp_path / "out.vrm", khronos=False) if one.severity == "error"]


@pytest.mark.parametrize("seed", range(3))
def test_vrm_0_becomes_1_and_looks_along_z(seed: int, tmp_path: Path) -> None:
    data, expected = former_avatar(seed)
    out, imported, _ = through(data, tmp_path)
    found = said(out)
    terms = found["VRMC_vrm"].pop("meta")
    assert found == expected
    assert terms["authors"] == ["A. Author"]
    assert terms["thumbnailImage"] == PICTURE.hex()
    assert terms["otherLicenseUrl"] == "https://example.org/terms"
    (tmp_path / "plain.glb").write_bytes(Person(seed).glb({}))  # the same person, looking along +Z
    plain = read(tmp_path / "plain.glb").parts
    turned = build(imported.parts).evaluate()
    assert np.abs(turned - build(plain).evaluate())[: len(turned) - 2 * 72].max() < 1e-6
    for one, other in zip(plain.meshes[0].blendshapes, imported.parts.meshes[0].blendshapes, strict=True):
        assert np.abs(one.offsets - other.offsets).max() < 1e-6
    assert not [one for one in vrm.validate(tmp_path / "out.vrm", khronos=False) if one.severity != "info"]


def test_three_vrm_sees_the_same_in_vrm_0_and_what_it_becomes(tmp_path: Path) -> None:
    through(former_avatar(2)[0], tmp_path)
    before, after = (vrm_facts(tmp_path / name) for name in ("in.vrm", "out.vrm"))
    for facts in (before, after):
        facts.pop("meta")
        for one in facts["springs"]:
            one.pop("gravity")  # three-vrm takes it as if Unity's space were glTF's
    assert after == before
    assert before["springs"]
    assert before["lookAt"]["from"][2] != 0


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, {"avatarPermission": "everyone", "commercialUsage": "personalProfit"}),
        ({}, {"allowExcessivelyViolentUsage": True, "allowExcessivelySexualUsage": False}),
        ({"allowedUserName": "ExplicitlyLicensedPerson"}, {"avatarPermission": "onlySeparatelyLicensedPerson"}),
        ({"allowedUserName": "Anyone", "commercialUssageName": 1}, {"avatarPermission": "onlyAuthor"}),
        ({"texture": 99, "violentUssageName": None, "title": []}, {"allowExcessivelyViolentUsage": False}),
        ({"violentUssageName": "Disallow"}, {"allowExcessivelyViolentUsage": False}),
        (
            {"licenseName": "CC_BY_NC", "otherPermissionUrl": ""},
            {"otherLicenseUrl": "https://creativecommons.org/licenses/by-nc/4.0/"},
        ),
        (
            {"licenseName": "CC0"},
            {"otherLicenseUrl": "https://creativecommons.org/publicdomain/zero/1.0/, https://example.org/terms"},
        ),
    ],
)
def test_terms_of_vrm_0_never_become_looser(given: dict[str, Any], expected: dict[str, Any], tmp_path: Path) -> None:
    data, _ = former_avatar(0, **given)
    out, _, _ = through(data, tmp_path)
    terms = said(out)["VRMC_vrm"]["meta"]
    always = {"modification": "prohibited", "allowRedistribution": False, "creditNotation": "required"}
    assert terms | expected | always | {"licenseUrl": LICENSE} == terms


MILD = {"name": "N", "authors": ["A"], "licenseUrl": LICENSE, "modification": "allowModification"}


@pytest.mark.parametrize(
    ("options", "meta", "words"),
    [
        ({"authors": "me"}, None, r'option authors: \["me"\], but the terms .*authors is \["A"\]'),
        ({}, {"modification": "allowModificationRedistribution"}, "modification is"),
        ({}, {"modification": "prohibited"}, "modification is"),
        ({}, {"commercialUsage": "corporation"}, 'commercialUsage is "personalNonProfit"'),  # where it says nothing
        ({}, {"allowRedistribution": True}, "allowRedistribution is false"),
    ],
)
def test_no_option_overrides_a_term(options: Any, meta: Any, words: str, tmp_path: Path) -> None:
    data = changed(avatar(0), lambda root: root["extensions"]["VRMC_vrm"].update(meta=MILD))
    if meta is not None:
        (tmp_path / "meta.json").write_text(json.dumps(meta))
        options = options | {"meta": tmp_path / "meta.json"}
    with pytest.raises(InputError, match=words):
        through(data, tmp_path, **options)
    assert not (tmp_path / "out.vrm").exists()


def test_options_add_what_terms_leave_open(tmp_path: Path) -> None:
    data = changed(avatar(0), lambda root: root["extensions"]["VRMC_vrm"].update(meta=MILD))
    (tmp_path / "meta.json").write_text('{"version": "3", "otherLicenseUrl": "https://example.org/", "name": "M"}')
    out, imported, _ = through(data, tmp_path, meta=tmp_path / "meta.json", authors="A", license_url=LICENSE)
    added = {"version": "3", "otherLicenseUrl": "https://example.org/", "name": "M"}
    assert said(out)["VRMC_vrm"]["meta"] == MILD | added
    assert imported.parts.attribution.startswith("A; https://vrm.dev/licenses/1.0/")
    assert "modification allowModification," in imported.parts.attribution


def test_a_body_gets_no_second_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="option stub_body: the face has a body"):
        through(avatar(0), tmp_path, stub_body=True)
    # without the extension no name says what its joints are
    person = changed(Person(0).glb({}), lambda root: [one.update(name=f"J{i}") for i, one in enumerate(root["nodes"])])
    (tmp_path / "body.glb").write_bytes(person)
    face, terms = HeldFace(read(tmp_path / "body.glb").parts), {"authors": "me", "license_url": LICENSE}
    with pytest.raises(InputError, match=r"no joints for 15 of .*; expected joints of known names, or option bones"):
        vrm.export(face, tmp_path / "body.vrm", vrm.Options(**terms))
    with pytest.raises(InputError, match="option stub_body: the face has a body"):
        vrm.export(face, tmp_path / "body.vrm", vrm.Options(stub_body=True, **terms))


def test_what_is_wrong_is_named_and_the_rest_kept(tmp_path: Path) -> None:
    def damage(root: Any) -> None:
        own, springs = (root["extensions"][name] for name in ("VRMC_vrm", "VRMC_springBone"))
        own["expressions"]["preset"]["aa"]["morphTargetBinds"].append({"node": 99, "index": 0, "weight": 1})
        own["expressions"]["preset"]["aa"]["morphTargetBinds"].append({"node": face, "index": 99, "weight": 1})
        own["expressions"]["preset"]["smug"] = {}
        own["meta"]["modification"] = "whatever"
        own["meta"]["thumbnailImage"] = 0  # no picture
        own["humanoid"]["humanBones"]["tail"] = {"node": 0}
        own["lookAt"]["type"] = "nose"
        springs["colliders"][0]["node"] = -1
        springs["springs"][1]["joints"][0]["stiffness"] = "stiff"

    data = avatar(3)
    face = next(i for i, one in enumerate(root_of(data)["nodes"]) if one["name"] == "Face")
    out, imported, _ = through(changed(data, damage), tmp_path)
    expected = said(data)
    own, springs = expected["VRMC_vrm"], expected["VRMC_springBone"]
    own["meta"].pop("modification")
    own["meta"].pop("thumbnailImage")
    own["lookAt"].pop("type")
    springs["colliders"].pop(0)
    springs["colliderGroups"] = [{"name": "skull", "colliders": []}, {"colliders": [1, 0]}]
    springs["springs"][1]["joints"][0].pop("stiffness", None)
    assert said(out) == expected
    assert len(imported.warnings) == 10
    for words in ("99 is no node", "but there are 4 morph targets", "'smug'", "'tail'", "whatever", "thumbnailImage"):
        assert sum(words in line for line in imported.warnings) == 1
    assert all(line.endswith("left out") and "\n" not in line for line in imported.warnings)


def test_what_the_file_lacks_is_named(tmp_path: Path) -> None:
    _, _, report = through(avatar(3), tmp_path, shapes="smile*")
    lost = [line for line in report.dropped if "no shape" in line]
    kept = said((tmp_path / "out.vrm").read_bytes())["VRMC_vrm"]["expressions"]
    assert {line.partition("no shape ")[2].partition(" of")[0] for line in lost} == {"'brow.down'", ascii("口開け")}
    assert kept["preset"]["aa"]["morphTargetBinds"] == []
    assert [one["index"] for one in kept["preset"]["happy"]["morphTargetBinds"]] == ["smile L", "smile R"]


WRONG: dict[str, Any] = {
    "VrmFirstPerson": lambda own, springs: own["firstPerson"]["meshAnnotations"][0].update(node=99),
    "VrmSpringBones": lambda own, springs: springs["springs"][0].update(colliderGroups=[7]),
    "VrmExpressions": lambda own, springs: own["expressions"]["preset"].update(smug={}),
}


@pytest.mark.parametrize("check", WRONG)
def test_validate_finds(check: str, tmp_path: Path) -> None:
    def damage(root: Any) -> None:
        WRONG[check](root["extensions"]["VRMC_vrm"], root["extensions"]["VRMC_springBone"])

    for data, expected in ((avatar(0), set[str]()), (changed(avatar(0), damage), {f"facepipe:{check}"})):
        (tmp_path / "in.vrm").write_bytes(data)
        findings = vrm.validate(tmp_path / "in.vrm", khronos=False)
        assert {one.check for one in findings if one.severity == "error"} == expected


@pytest.mark.parametrize("change", [{"specVersion": "2.0"}, [], "x", None, {}, {"meta": 3, "specVersion": "1.0"}])
def test_an_extension_that_is_none_costs_the_avatar_alone(change: Any, tmp_path: Path) -> None:
    (tmp_path / "in.vrm").write_bytes(changed(avatar(0), lambda root: root["extensions"].update(VRMC_vrm=change)))
    imported = read(tmp_path / "in.vrm")
    assert len(imported.parts.meshes) == 4
    assert "meta" not in imported.parts.vrm.get("VRMC_vrm", {})  # type: ignore[operator]
    assert imported.warnings or change is None


def test_expressions_of_one_name_are_told_apart(tmp_path: Path) -> None:
    groups = [{"name": "smug"}] * 3 + [{"name": "happy"}]

    def change(root: Any) -> None:
        root["extensions"]["VRM"]["blendShapeMaster"]["blendShapeGroups"] = groups

    (tmp_path / "in.vrm").write_bytes(changed(former_avatar(0)[0], change))
    custom = section(read(tmp_path / "in.vrm").parts.vrm, "VRMC_vrm", "expressions", "custom")
    assert [*custom] == ["smug", "smug_2", "smug_3", "happy_2"]


@pytest.mark.parametrize("levels", range(950, 1000, 3))
def test_terms_nested_as_deep_as_python_reads_are_no_traceback(levels: int) -> None:
    deep: list[Any] = []
    for _ in range(levels):
        deep = [deep]
    assert str(fault("name", deep)).endswith("expected a text")


def test_names_that_change_are_followed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Shapes by --rename, and joints and meshes that share a name."""
    data = changed(avatar(0), lambda root: [one.update(name="頭") for one in root["nodes"]])
    (tmp_path / "in.vrm").write_bytes(data)
    (tmp_path / "names.json").write_text('{"口開け": "jawOpen"}')
    names = ("--rename", tmp_path / "names.json")
    done(capsys, "import", "gltf", tmp_path / "in.vrm", tmp_path / "face.usda", *names, quiet=False)
    done(capsys, "export", tmp_path / "face.usda", "-o", tmp_path / "out.vrm")
    before, after = said(data), said((tmp_path / "out.vrm").read_bytes())
    before.pop("constraints")  # by name, of which there is one
    after.pop("constraints")
    assert json.loads(json.dumps(before, ensure_ascii=False).replace("口開け", "jawOpen")) == after
    bones = root_of((tmp_path / "out.vrm").read_bytes())["extensions"]["VRMC_vrm"]["humanoid"]["humanBones"]
    assert len({one["node"] for one in bones.values()}) == len(BONES)


def test_commands_that_take_a_face_take_a_vrm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "in.vrm"
    path.write_bytes(avatar(0))
    assert facepipe.read(path).parts().vrm == read(path).parts.vrm
    assert "shapes         4" in done(capsys, "inspect", path)
    done(capsys, "export", path, "-o", tmp_path / "out.vrm")
    assert said((tmp_path / "out.vrm").read_bytes()) == said(avatar(0))


def test_an_import_of_the_stage_keeps_it_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, imported, _ = through(avatar(2), tmp_path)
    done(capsys, "import", "usd", tmp_path / "face.usda", tmp_path / "again.usda", quiet=False)
    assert open_face(tmp_path / "again.usda").parts().vrm == imported.parts.vrm
    done(capsys, "export", tmp_path / "again.usda", "-o", tmp_path / "again.vrm")
    assert said((tmp_path / "again.vrm").read_bytes()) == said(out)


def test_a_glb_names_what_only_a_vrm_holds_and_brings_it_back(tmp_path: Path) -> None:
    (tmp_path / "in.vrm").write_bytes(avatar(0))
    face = read(tmp_path / "in.vrm").parts
    report = facepipe_gltf_export(face, tmp_path / "face.glb")
    assert any("only a .vrm holds it" in line for line in report.dropped)
    assert "modification" in root_of((tmp_path / "face.glb").read_bytes())["asset"]["copyright"]
    assert read(tmp_path / "face.glb").parts.vrm == face.vrm


def facepipe_gltf_export(face: FaceParts, path: Path) -> ExportReport:
    import facepipe_gltf

    return facepipe_gltf.export(HeldFace(face), path)
