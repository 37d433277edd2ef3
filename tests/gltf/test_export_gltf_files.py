"""glTF files on disk: the same bytes twice, whole or not at all, and refused input."""

from __future__ import annotations

import gc
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from facepipe_gltf import Options, export, outputs, save, write
from faces import grid_mesh, replace_mesh, spoiled, tiny_face, with_head, with_meshes
from gltf_export import Parts, Writing, difference, reference, writing, written
from gltf_reader import read
from node import node_packages, validate
from textures import COLORS, picture, textured

import facepipe
from facepipe.core.errors import ExportError, FacepipeError, InputError
from facepipe.parts import Animation, Blendshape, FaceParts, Landmarks, Material, MaterialFaces, Slider, UvSet

__all__ = ["writing", "written"]


def painted_face(value: int = 0) -> FaceParts:
    """The tiny face with a texture of its own."""
    parts = tiny_face(value)
    material = Material(name="skin", diffuse_color=textured(picture("skin.png", COLORS + np.uint8(value))))
    return replace(with_meshes(parts, material="skin"), materials=(material,), attribution="© someone, CC0")


@pytest.mark.parametrize("options", [{}, {"mode": "skin"}, {"mode": "morph"}, {"quantize": True}, {"influences": 8}])
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_validator_finds_nothing(options: dict[str, object], suffix: str, tmp_path: Path) -> None:
    """No error, no warning, no hint: every texture, UV set and target is used."""
    node_packages()
    report = export(Parts(painted_face()), tmp_path / f"face{suffix}", Options(**options))  # type: ignore[arg-type]
    (found,) = validate([report.path]).values()
    record = [{"code": "UNUSED_OBJECT", "severity": 2}] * (options.get("mode") != "morph")  # what glTF has no place for
    assert [{key: one[key] for key in ("code", "severity")} for one in found["issues"]["messages"]] == record
    assert found["info"]["hasSkins"] == (options.get("mode") != "morph")
    assert found["info"]["hasMorphTargets"] == (options.get("mode") != "skin")


def test_glb_and_gltf_hold_the_same(writing: Writing) -> None:
    one, _ = writing(painted_face(), "face.glb")
    other, report = writing(painted_face(), "face.gltf")
    for weights in ({}, {"jawOpen": 0.3, "mouthSmileLeft": 1.0}):
        for name, points in one.evaluate(weights).items():
            assert (points == other.evaluate(weights)[name]).all()
    assert one.image(0) == other.image(0)
    assert sorted(path.name for path in report.files) == sorted(
        path.name for path in report.path.parent.glob("face*[!b]")
    )
    assert report.bytes == sum(path.stat().st_size for path in report.files)


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_same_face_same_bytes(suffix: str, tmp_path: Path) -> None:
    contents = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        report = export(Parts(painted_face()), tmp_path / folder / f"face{suffix}", Options())
        contents.append({path.name: path.read_bytes() for path in report.files})
    assert contents[0] == contents[1]


def test_asset_says_who_and_what(writing: Writing) -> None:
    file, _ = writing(painted_face())
    assert file.json["asset"] == {
        "version": "2.0",
        "generator": f"facepipe {facepipe.__version__}",
        "copyright": "© someone, CC0",
    }


def test_landmarks_and_anchor_stay_in_extras_and_what_no_file_holds_is_reported(writing: Writing) -> None:
    parts = replace(tiny_face(), sliders=(Slider(name="open"),), attach_joint="body/neck")
    file, report = writing(parts)
    own = file.mesh("Head")["extras"]["facepipe"]
    marks = parts.meshes[0].landmarks["corners"]
    assert isinstance(marks, Landmarks)
    assert own["landmarks"] == {"corners": {"points": marks.indices.tolist(), "names": list(marks.names)}}
    assert own["anchor"] == 2
    assert report.dropped == ()
    assert writing(parts, "posed.glb", mode="morph")[1].dropped[:3] == (
        "2 regions (mouth, neck) on Head",
        "1 point subset (lips) on Head",
        "1 slider (open)",
    )
    root = next(node for node in file.list("nodes") if node["name"] == "root")
    assert root["extras"]["facepipe"]["attachJoint"] == "body/neck"


@pytest.mark.parametrize("mode", ["both", "morph"])
def test_an_attach_joint_without_joints_is_reported(mode: str, writing: Writing) -> None:
    skinned = replace(tiny_face(), attach_joint="body/neck")
    rigid = with_meshes(skinned, skin=None)
    line = "attach joint (body/neck): no joint of the file hangs below it"
    for name, parts in (("skinned.glb", skinned), ("rigid.glb", rigid)):
        file, report = writing(parts, name, mode=mode)
        said = any("attachJoint" in node.get("extras", {}).get("facepipe", {}) for node in file.list("nodes"))
        assert said == (mode == "both" and parts is skinned)
        assert (line in report.dropped) != said


def test_textured_materials_that_no_mesh_uses_are_reported(writing: Writing) -> None:
    parts = painted_face()
    assert not any("material" in line for line in writing(parts)[1].dropped)
    spare = replace(parts, materials=(*parts.materials, Material(name="spare")))
    file, report = writing(spare, "b.glb")
    assert [one["name"] for one in file.list("materials")] == ["skin"]
    assert not any("material" in line for line in report.dropped)
    over = MaterialFaces(material="spare", faces=np.arange(25))
    hidden = replace(spare, meshes=(replace_mesh(spare.meshes[0], material_faces=(over,)),))
    file, report = writing(hidden, "c.glb")
    assert [one["name"] for one in file.list("materials")] == ["spare"]
    assert "1 material that no mesh uses (skin)" in report.dropped


@pytest.mark.parametrize("name", ["k.glb", "k.gltf"])
def test_outputs_are_among_the_files_that_export_writes(name: str, tmp_path: Path) -> None:
    report = export(Parts(painted_face()), tmp_path / name, Options())
    assert outputs(tmp_path / name) == report.files[:1] == (tmp_path / name,)
    with pytest.raises(InputError, match=r"expected .glb or .gltf"):
        outputs(tmp_path / "k.onnx")


def test_points_that_no_face_uses_are_reported(writing: Writing) -> None:
    parts = tiny_face()
    head = parts.meshes[0]
    loose = replace_mesh(
        head, face_vertex_counts=head.face_vertex_counts[1:], face_vertex_indices=head.face_vertex_indices[4:]
    )
    _, report = writing(replace(parts, meshes=(loose,)))
    assert "skin weights and shapes of 1 point that no face uses, on Head" in report.dropped


def test_globs_choose_shapes(writing: Writing) -> None:
    file, report = writing(tiny_face(), shapes="mouth*, jaw*")
    assert report.counts["shapes"] == 2
    file, report = writing(tiny_face(), "b.glb", shapes="mouth*")
    assert file.targets("Head") == ["mouthSmileLeft"]
    assert not file.targets("Teeth")
    with pytest.raises(InputError, match=r"shapes: 'nose\*' matches none of 2"):
        writing(tiny_face(), "c.glb", shapes="mouth*,nose*")
    file, report = writing(tiny_face(), "d.glb", shapes="")
    assert report.counts["shapes"] == 0
    assert not file.targets("Head")


def odd_faces() -> dict[str, FaceParts]:
    """Faces at the edges of what a stage can hold."""
    face, flat = tiny_face(), grid_mesh()
    flat_uv = replace_mesh(flat, uv_sets=(UvSet(values=np.full((36, 2), 0.25)),))
    none = Blendshape(name="none", point_indices=np.zeros(0, np.int32), offsets=np.zeros((0, 3)))
    still = Blendshape(name="still", point_indices=np.array([4]), offsets=np.zeros((1, 3)))
    last = Blendshape(name="last", point_indices=np.array([2, 66000]), offsets=np.ones((2, 3)))
    lines = replace_mesh(flat, face_vertex_counts=np.full(2, 3), face_vertex_indices=np.array([0, 0, 1, 2, 3, 3]))
    return {
        "no mesh": FaceParts(),
        "no area": FaceParts(meshes=(lines,)),
        "one UV for all": FaceParts(meshes=(flat_uv,)),
        "several roots": replace(face, skeleton=replace(face.skeleton, joints=("a", "b", "c"))),
        "joints of one name": replace(face, skeleton=replace(face.skeleton, joints=("a", "a/b", "a/b/a"))),
        "more than 65535 vertices": FaceParts(meshes=(replace_mesh(grid_mesh(size=260), blendshapes=(last,)),)),
        "shapes that move nothing": FaceParts(meshes=(replace_mesh(flat, blendshapes=(none, still)),)),
    }


@pytest.mark.parametrize("quantize", [False, True])
@pytest.mark.parametrize("name", odd_faces())
def test_odd_faces_agree_too(name: str, quantize: bool, writing: Writing) -> None:
    parts = odd_faces()[name]
    file, report = writing(parts, quantize=quantize)
    weights = dict.fromkeys({shape.name for mesh in parts.meshes for shape in mesh.blendshapes}, 1.0)
    if name == "no area":
        assert report.dropped == ("1 mesh without faces (Head)",)
    else:
        limit = (report.error_mm or 0) / 1000 * 1.1 + 1e-6
        assert difference(file.evaluate(weights), reference(parts, weights), parts) < limit
    assert file.list("meshes") or name in ("no mesh", "no area")


def test_an_older_gltf_gives_way_with_its_sidecars(tmp_path: Path) -> None:
    path = tmp_path / "face.gltf"
    (tmp_path / "face.bin").write_bytes(b"of someone else")
    first = export(Parts(painted_face(0)), path, Options())
    second = export(Parts(painted_face(1)), path, Options())
    assert not set(first.files[1:]) & set(second.files[1:])
    assert {one.name for one in tmp_path.iterdir()} == {one.name for one in second.files} | {"face.bin"}


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_a_failed_write_leaves_the_old_files_and_no_others(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full when the last file comes: renaming it over the old one fails."""
    path = tmp_path / f"face{suffix}"
    export(Parts(painted_face(0)), path, Options())
    before = {one.name: one.read_bytes() for one in tmp_path.iterdir()}
    document = write(painted_face(1), Options())

    def full(source: object, target: object) -> None:
        if Path(str(target)) == path:
            raise OSError(28, "No space left on device")
        Path(str(source)).rename(str(target))

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(InputError, match="No space left"):
        save(document, path)
    assert {one.name: one.read_bytes() for one in tmp_path.iterdir()} == before
    read(path).evaluate()


def blink(*times: float) -> Animation:
    """A clip of a shape."""
    weights = np.zeros((len(times), 1))
    return Animation(name="blink", times=np.array(times), shapes=("jawOpen",), shape_weights=weights)


def broken(name: str) -> FaceParts:
    """A face with one defect."""
    face = tiny_face()
    head, skeleton = face.meshes[0], face.skeleton
    assert head.skin is not None
    shape = head.blendshapes[0]
    half = shape.inbetweens[0]
    changes: dict[str, Callable[[], FaceParts]] = {
        "points": lambda: with_head(face, points=spoiled(head.points)),
        "Head -> chin": lambda: with_head(face, regions={"chin": np.full(len(head.points), 1e39)}),
        "Head -> transform": lambda: with_head(face, transform=np.diag([1e200, 1.0, 1.0, 1.0])),
        "beyond float32 in metres": lambda: with_head(
            face, skin=None, transform=np.diag([1e30, 1e30, 1e30, 1.0]), points=head.points * 1e20
        ),
        "jointWeights": lambda: with_head(
            face, skin=replace(head.skin, joint_weights=spoiled(head.skin.joint_weights, np.inf))
        ),
        "negative skin weight": lambda: with_head(
            face, skin=replace(head.skin, joint_weights=spoiled(head.skin.joint_weights, -0.5))
        ),
        "no skin weight": lambda: with_head(face, skin=replace(head.skin, joint_weights=head.skin.joint_weights * 0)),
        "jointIndices": lambda: with_head(
            face, skin=replace(head.skin, joint_indices=spoiled(head.skin.joint_indices, 3))
        ),
        "jawOpen -> offsets": lambda: with_head(face, blendshapes=(replace(shape, offsets=spoiled(shape.offsets)),)),
        "jawOpen -> pointIndices": lambda: with_head(
            face, blendshapes=(replace(shape, point_indices=shape.point_indices[::-1]),)
        ),
        "jawOpen -> half -> offsets": lambda: with_head(
            face, blendshapes=(replace(shape, inbetweens=(replace(half, offsets=spoiled(half.offsets)),)),)
        ),
        "two morph targets": lambda: with_head(face, blendshapes=(shape, replace(shape, name="jawOpen_half"))),
        "faceVertexIndices": lambda: with_head(face, face_vertex_indices=spoiled(head.face_vertex_indices, 36)),
        "rest_transforms": lambda: replace(
            face, skeleton=replace(skeleton, rest_transforms=spoiled(skeleton.rest_transforms))
        ),
        "root/jaw -> bind transform": lambda: replace(
            face, skeleton=replace(skeleton, bind_transforms=skeleton.bind_transforms * [[[1]], [[0]], [[1]]])
        ),
        "metersPerUnit": lambda: replace(face, meters_per_unit=0.0),
        "not among the face's materials": lambda: with_head(face, material="skin"),
        "blink -> times": lambda: replace(face, animations=(blink(0.5, 0.5 + 1e-9),)),
    }
    return changes[name]()


@pytest.mark.parametrize(
    "name",
    [
        "points",
        "Head -> chin",
        "Head -> transform",
        "beyond float32 in metres",
        "jointWeights",
        "negative skin weight",
        "no skin weight",
        "jointIndices",
        "jawOpen -> offsets",
        "jawOpen -> pointIndices",
        "jawOpen -> half -> offsets",
        "two morph targets",
        "faceVertexIndices",
        "rest_transforms",
        "root/jaw -> bind transform",
        "metersPerUnit",
        "not among the face's materials",
        "blink -> times",
    ],
)
def test_what_gltf_cannot_hold_is_refused_with_its_place(name: str, tmp_path: Path) -> None:
    path = tmp_path / "face.glb"
    with pytest.raises(ExportError) as caught:
        export(Parts(broken(name)), path, Options(animations=True))
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_other_suffixes_and_missing_folders_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "face.fbx", tmp_path / "missing" / "face.glb", tmp_path / "missing" / "face.gltf"):
        with pytest.raises(FacepipeError, match=r"face\."):
            export(Parts(tiny_face()), path, Options())


def test_json_is_plain_and_sorted(tmp_path: Path) -> None:
    path = tmp_path / "face.gltf"
    export(Parts(tiny_face()), path, Options())
    text = path.read_text(encoding="utf-8")
    document = json.loads(text, parse_constant=pytest.fail)
    assert text == json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def test_the_host_keeps_its_garbage_collection(tmp_path: Path) -> None:
    """An export changes no setting of the process that other threads would feel."""

    class Watched(Parts):
        def parts(self) -> FaceParts:
            assert gc.isenabled()
            return super().parts()

    assert gc.isenabled()
    export(Watched(tiny_face()), tmp_path / "face.glb")
    assert gc.isenabled()
