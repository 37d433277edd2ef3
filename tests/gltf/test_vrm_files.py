"""VRM's terms and checks: options that are refused, and what validate finds in damaged files."""

from __future__ import annotations

import json
import struct
import tempfile
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from facepipe_gltf import vrm
from faces import tiny_face, with_head
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from vrm_export import (
    exported,
    extension,
    head,
    read_json,
)

from facepipe.core.errors import InputError
from facepipe.parts import Landmarks


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"license_url": ""}, "license_url: not given"),
        ({"license_url": "https://example.org/mine"}, "expected https://vrm.dev/licenses/1.0/"),
        ({"authors": " , "}, "authors: not given"),
        ({"bones": "tail=root"}, "'tail' is no human bone"),
        ({"bones": "hips"}, "expected BONE=JOINT"),
        ({"bones": "hips=pelvis"}, r"no joint called 'pelvis', expected one of \d"),
        ({"bones": "neck=nekc"}, "no joint called 'nekc', did you mean 'neck'"),
        ({"bones": "neck=neck,chest=neck"}, "expected each once"),
        ({"bones": "spine=root/neck/head/jaw"}, "jaw: is the spine, below the head"),
    ],
)
def test_what_cannot_be_is_refused(change: dict[str, str], words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        exported(replace(head(), attribution=None), tmp_path / "head.vrm", **change)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "expected a JSON object"),
        ('{"name": ', "is not JSON"),
        ('{"comercialUsage": "corporation"}', "did you mean 'commercialUsage'"),
        ('{"commercialUsage": "always"}', "expected personalNonProfit or personalProfit or corporation"),
        ('{"allowRedistribution": "yes"}', "expected true or false"),
        ('{"name": "\\ud800"}', "half a surrogate pair"),
        ('{"authors": []}', "expected a list of texts"),
        ('{"thumbnailImage": 0}', "thumbnailImage"),
    ],
)
def test_meta_that_vrm_does_not_have_is_refused(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "meta.json").write_text(text)
    with pytest.raises(InputError, match=words):
        exported(head(), tmp_path / "head.vrm", authors="", meta=tmp_path / "meta.json")
    assert not (tmp_path / "head.vrm").exists()


def test_meta_comes_from_options_their_file_and_the_attribution(tmp_path: Path) -> None:
    parts = replace(tiny_face(), attribution="Someone Else, CC0 1.0")
    (tmp_path / "meta.json").write_text(
        '{"version": "7", "licenseUrl": "https://vrm.dev/licenses/1.0/", "name": "Ann"}'
    )
    exported(parts, tmp_path / "one.vrm", authors="", license_url="", meta=tmp_path / "meta.json")
    exported(parts, tmp_path / "two.vrm", authors="Me, You")
    one, two = (extension(tmp_path / name)["meta"] for name in ("one.vrm", "two.vrm"))
    assert (one["name"], one["version"], one["authors"]) == ("Ann", "7", ["Someone Else, CC0 1.0"])
    assert (two["name"], two["authors"], two["copyrightInformation"]) == ("two", ["Me", "You"], "Someone Else, CC0 1.0")


DAMAGES: dict[str, Any] = {
    "VrmVersion": lambda one: one["extensions"]["VRMC_vrm"].update(specVersion="0.9"),
    "VrmMeta": lambda one: one["extensions"]["VRMC_vrm"]["meta"].pop("licenseUrl"),
    "VrmHumanBones": lambda one: one["extensions"]["VRMC_vrm"]["humanoid"]["humanBones"].pop("leftFoot"),
    "VrmScales": lambda one: one["nodes"][-1].update(scale=[1, 1, -1]),
    "VrmPose": lambda one: swap(one, "leftUpperLeg", "rightUpperLeg"),
    "VrmExpressions": lambda one: one["extensions"]["VRMC_vrm"]["expressions"]["custom"]["jawOpen"]["morphTargetBinds"][
        0
    ].update(index=99),
    "VrmLookAt": lambda one: one["extensions"]["VRMC_vrm"]["lookAt"].update(type="bone"),
}


@pytest.mark.parametrize("check", DAMAGES)
def test_validate_finds(check: str, tmp_path: Path) -> None:
    parts = tiny_face()
    marks = {"multipie68": Landmarks(indices=np.arange(68) % len(parts.meshes[0].points))}
    exported(with_head(parts, landmarks=marks), tmp_path / "one.vrm")
    findings = vrm.validate(tmp_path / "one.vrm", khronos=False)
    assert not [finding for finding in findings if finding.severity == "error"]
    document = read_json(tmp_path / "one.vrm")
    DAMAGES[check](document)
    data = (tmp_path / "one.vrm").read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    (tmp_path / "two.vrm").write_bytes(head + text + rest)
    found = {one.check for one in vrm.validate(tmp_path / "two.vrm", khronos=False)}
    assert f"facepipe:{check}" in found - {finding.check for finding in findings}


WEIRD = st.sampled_from([None, True, -1, 1.5, 1e999, "x", [], [None], {}, {"node": "x"}, {"": 0}, [[1]], 2**70])


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_hostile_files_are_judged_not_believed(data: st.DataObject, tmp_path: Path) -> None:
    """Whatever stands in the extension, the checks end, and say so where it is no VRM any more."""
    document = deepcopy(tiny_document())
    for _ in range(data.draw(st.integers(1, 4))):
        place: Any = document
        while isinstance(place, dict | list) and place:
            key = data.draw(st.sampled_from(sorted(place) if isinstance(place, dict) else range(len(place))))
            if not isinstance(place[key], dict | list) or not place[key] or data.draw(st.booleans()):
                place[key] = deepcopy(data.draw(WEIRD))
                break
            place = place[key]
    path = tmp_path / "hostile.vrm"
    text = json.dumps(document).replace("Infinity", "1e999").encode()
    path.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text)
    assert all("\n" not in one.message for one in vrm.validate(path, khronos=False))


@cache
def tiny_document() -> Any:
    """The JSON of a small model, of what VRM's checks read."""
    with tempfile.TemporaryDirectory() as folder:
        exported(tiny_face(), Path(folder) / "one.vrm", shapes="jawOpen", morph_normals=False)
        document = read_json(Path(folder) / "one.vrm")
    return {key: document[key] for key in ("asset", "extensions", "extensionsUsed", "meshes", "nodes", "scenes")}


def swap(document: Any, one: str, other: str) -> None:
    """Exchange the places of two human bones' nodes."""
    bones = document["extensions"]["VRMC_vrm"]["humanoid"]["humanBones"]
    a, b = (document["nodes"][bones[bone]["node"]] for bone in (one, other))
    a["translation"], b["translation"] = b["translation"], a["translation"]
