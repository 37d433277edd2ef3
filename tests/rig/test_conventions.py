"""Conventions of shape names: their tables, and what a name means whatever its case, breaks and sides."""

from collections import Counter

import pytest

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean, find, find_joint
from facepipe.rig.bone_coefficients import coefficients_of
from facepipe.rig.conventions import ARKIT_SHAPES, CONVENTIONS, match_shapes, meaning, recognised, shape_key


def test_tables_have_the_counts_of_their_sources_and_no_name_with_two_meanings() -> None:
    assert len(ARKIT_SHAPES) == 52  # ARFaceAnchor.BlendShapeLocation
    assert len(CONVENTIONS["oculus"].names) == 15  # Oculus Lipsync
    assert len(CONVENTIONS["vrm"].names) == 18  # VRMC_vrm-1.0 presets
    assert len(CONVENTIONS["mpfb"].names) == 52 + 15
    meanings: dict[str, set[str]] = {}
    for table in CONVENTIONS.values():
        assert table.source
        assert max(Counter(table.written.values()).values()) == 1
        for meant, names in table.names.items():
            for name in names:
                meanings.setdefault(shape_key(name), set()).add(meant)
    assert {key: meant for key, meant in meanings.items() if len(meant) > 1} == {}


FORMS = {
    "_L _R": lambda stem, side: f"{stem}_{side[0]}",
    ".L .R": lambda stem, side: f"{stem}.{side[0]}",
    "Left Right": lambda stem, side: f"{stem}{side}",
    "_left _right": lambda stem, side: f"{stem}_{side.lower()}",
    "L_ R_": lambda stem, side: f"{side[0]}_{stem}",
    "left right before": lambda stem, side: f"{side.lower()}{stem[0].upper()}{stem[1:]}",
    "L R": lambda stem, side: f"{stem}{side[0]}",
    "small": lambda stem, side: f"{stem}{side}".lower(),
    "LARGE": lambda stem, side: f"{stem}_{side}".upper() if "_" in stem else f"{stem}{side}".upper(),
    "blanks": lambda stem, side: f"{stem} {side}",
    "first large": lambda stem, side: f"{stem[0].upper()}{stem[1:]}{side}",
    "namespace": lambda stem, side: f"blendShape1.{stem}_{side[0]}",
}


@pytest.mark.parametrize("form", FORMS)
def test_every_arkit_shape_is_found_in_any_usual_form(form: str) -> None:
    pairs = {}
    for name in sorted(ARKIT_SHAPES):
        side = next((side for side in ("Left", "Right") if name.endswith(side) and name != side), "")
        pairs[FORMS[form](name.removesuffix(side), side) if side else name.capitalize()] = name
    assert match_shapes(pairs, sorted(ARKIT_SHAPES)) == {given: (name,) for given, name in pairs.items()}


def test_other_conventions_mean_arkit_shapes() -> None:
    assert meaning("CTRL_expressions_eyeLookRightL") == "eyeLookInLeft"  # the left eye's look to the right is inwards
    assert meaning("RightEyeturnRight") == "eyeLookOutRight"
    assert meaning("Fcl_MTH_A") == meaning("aa") == meaning("vrc.v_aa") == "viseme_aa"
    assert meaning("!ex-jawOpen") == "jawOpen"
    assert meaning("あ") is meaning("") is meaning("nose hump") is None


def test_a_name_without_side_means_both_sides_and_the_better_match_has_the_shape() -> None:
    shapes = ("browInnerUp_L", "browInnerUp_R", "jawOpen", "JAWOPEN", "Key 1", "あ")
    assert match_shapes(("browInnerUp", "jawOpen", "Jaw_Open", "key 1", "あ", "い"), shapes) == {
        "browInnerUp": ("browInnerUp_L", "browInnerUp_R"),
        "jawOpen": ("jawOpen",),  # by its own name; Jaw_Open fits two alike
        "key 1": ("Key 1",),
        "あ": ("あ",),
    }
    assert match_shapes(("JawOpen", "jaw_open"), ("jawOpen",)) == {"JawOpen": ("jawOpen",)}  # not to two names


def test_conventions_are_recognised() -> None:
    assert recognised(sorted(ARKIT_SHAPES)) == ("arkit", 52)
    assert recognised([f"{one}_L" for one in ("eyeBlink", "mouthSmile", "browDown")]) == ("arkit", 3)
    assert recognised(list(CONVENTIONS["vrm"].written.values())) == ("vrm", 18)
    assert recognised(list(CONVENTIONS["metahuman"].written.values())) == (
        "metahuman",
        len(CONVENTIONS["metahuman"].names),
    )
    assert recognised(("Key 1", "Key 2", "jawOpen")) is None


def test_wrong_names_get_the_nearest_and_case_alone_is_no_error() -> None:
    known = ("jawOpen", "jawLeft", "Blink", "BLINK")
    assert find("JAWOPEN", known, "--set", "shape") == "jawOpen"
    assert find("Blink", known, "--set", "shape") == "Blink"
    with pytest.raises(InputError, match="did you mean 'jawOpen'"):
        find("jawOpn", known, "--set", "shape")
    with pytest.raises(InputError, match="2 that differ in case"):
        find("blink", known, "--set", "shape")
    with pytest.raises(InputError, match="expected one of jawOpen"):
        find("tail", known, "--set", "shape")
    assert did_you_mean("x" * 100_000, known) == ""


def test_joints_are_found_by_path_source_name_or_last_part() -> None:
    joints = ("root", "root/mixamorig_Jaw", "root/eye_L", "root/eye_L/tip", "root/tip")
    names = ("root", "mixamorig:Jaw", "eye.L", "tip", "Tip.001")

    def found(word: str) -> int:
        return find_joint(word, joints, names, "--bone")

    assert [found(word) for word in ("mixamorig:Jaw", "root/eye_L", "eye_L", "EYE.l", "Tip.001")] == [1, 2, 2, 2, 4]
    assert found("tip") == 3  # the source's name of one alone
    assert coefficients_of({"mixamorig:Jaw:rx": 0.5}, joints, names)[1, 3] == 0.5
    with pytest.raises(InputError, match="no joint 'mixamorig:Jw', did you mean 'mixamorig:Jaw'"):
        found("mixamorig:Jw")
    with pytest.raises(InputError, match="2 joints called 'tip', expected a path: root/eye_L/tip, root/tip"):
        find_joint("tip", joints, ("root", "a", "b", "c", "d"), "--bone")
