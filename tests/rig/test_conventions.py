"""Conventions of shape names: their tables, and what a name means whatever its case, breaks and sides."""

from collections import Counter

import pytest

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean, find, find_joint
from facepipe.rig.bone_coefficients import coefficients_of
from facepipe.rig.conventions import (
    ARKIT_SHAPES,
    CONVENTIONS,
    convention_names,
    convention_of,
    convention_text,
    match_shapes,
    meaning,
    recognised,
    shape_key,
    unnamed,
)


def test_tables_have_the_counts_of_their_sources_and_no_name_with_two_meanings() -> None:
    assert len(ARKIT_SHAPES) == 52  # ARFaceAnchor.BlendShapeLocation
    assert len(CONVENTIONS["oculus"].names) == 15  # Oculus Lipsync
    assert len(CONVENTIONS["vrm"].names) == 18  # VRMC_vrm-1.0 presets
    assert len(CONVENTIONS["mpfb"].names) == 52 + 15
    assert len(CONVENTIONS["vroid"].names) == 57  # of VRoid Studio's exports
    assert {*CONVENTIONS["cc3"].names} & {*CONVENTIONS["daz"].names} >= ARKIT_SHAPES  # A01 to A52; Genesis 8.1
    meanings: dict[str, set[str]] = {}
    for table in CONVENTIONS.values():
        assert table.source
        assert max(Counter(table.written.values()).values()) == 1
        for meant, names in table.names.items():
            for name in (meant, *names):
                meanings.setdefault(shape_key(name), set()).add(meant)
    assert {key: meant for key, meant in meanings.items() if len(meant) > 1} == {}
    assert {name for one in CONVENTIONS.values() for meant, names in one.names.items() for name in names
            if meaning(name) != meant} == set()  # fmt: skip


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
    assert meaning("") is meaning("nose hump") is None


TOOLS = {  # what each tool calls some of ARKit's shapes and Oculus's visemes
    "Character Creator 3": {
        "A01_Brow_Inner_Up": "browInnerUp",
        "A11_Eye_Look_In_Left": "eyeLookInLeft",
        "A25_Jaw_Open": "jawOpen",
        "A52_Tongue_Out": "tongueOut",
        "V_Explosive": "viseme_PP",
        "V_Dental_Lip": "viseme_FF",
    },
    "Character Creator 4": {
        "Brow_Drop_L": "browDownLeft",
        "Eye_L_Look_R": "eyeLookInLeft",
        "Eye_R_Look_R": "eyeLookOutRight",
        "Mouth_Up_Upper_R": "mouthUpperUpRight",
        "Cheek_Raise_L": "cheekSquintLeft",
        "Jaw_L": "jawLeft",
    },
    "Daz": {
        "facs_jnt_JawOpen": "jawOpen",
        "Genesis8_1Female__facs_bs_MouthSmileLeft_div2": "mouthSmileLeft",
        "facs_ctrl_EyeLookUpRight": "eyeLookUpRight",
        "Genesis9__facs_bs_NoseSneerLeft": "noseSneerLeft",
        "facs_ctrl_vM": "viseme_PP",
    },
    "Meta": {
        "JAW_DROP": "jawOpen",
        "lipCornerPullerL": "mouthSmileLeft",
        "bls_head.browLowerer_R": "browDownRight",
        "EYES_LOOK_LEFT_L": "eyeLookOutLeft",
        "EyesLookLeftR": "eyeLookInRight",
        "eyesClosedL": "eyeBlinkLeft",
        "LipsToward": "mouthClose",
    },
    "faceshift": {
        "EyeOpen_L": "eyeWideLeft",
        "BrowsU_C": "browInnerUp",
        "LipsPucker": "mouthPucker",
        "JawFwd": "jawForward",
        "Puff": "cheekPuff",
    },
    "VRoid Studio": {
        "Fcl_EYE_Close_L": "eyeBlinkLeft",
        "Face.M_F00_000_00_Fcl_MTH_O": "viseme_O",
        "Fcl_MTH_A": "viseme_aa",
    },
    "MikuMikuDance": {
        "ウィンク２": "eyeBlinkLeft",
        "ｳｨﾝｸ２右": "eyeBlinkRight",
        "あ": "viseme_aa",
        "お": "viseme_O",
        "口角上げ左": "mouthSmileLeft",
    },
    "MetaHuman": {
        "head_lod0_mesh__mouth_cornerPull_L": "mouthSmileLeft",
        "head_lod0_mesh__eye_blink_R": "eyeBlinkRight",
    },
    "Unified Expressions": {"EyeClosedRight": "eyeBlinkRight", "LipSuckUpper": "mouthRollUpper"},
}


@pytest.mark.parametrize("tool", TOOLS)
def test_a_clip_of_arkit_and_oculus_finds_the_shapes_of_every_tool(tool: str) -> None:
    names = TOOLS[tool]
    assert {name: meaning(name) for name in names} == names
    clip = [*sorted(ARKIT_SHAPES), *CONVENTIONS["oculus"].names]
    assert match_shapes(clip, [*names, "Head_Turn_L", "Tongue_Bulge_L"]) == {
        meant: (name,) for name, meant in sorted(names.items(), key=lambda pair: clip.index(pair[1]))
    }
    assert match_shapes(names, clip) == {name: (meant,) for name, meant in names.items()}


OTHERS = """jawOpen_2 jawOpen2 jawOpenWide jawOpen_mouthClose jawOpen_corrective corrective_jawOpen no_jawOpen c_jawOpen
pJCMJawOpen facs_bs_JawOpenWide facs_cbs_MouthUpperUp Mouth_Smile_Sharp_L Mouth_Roll_Out_Upper_L T01_Tongue_Up Head_L
V_Tight V_Tight_O V_Tongue_Out head_lod0_mesh__Mfunnel_MupperLipRaise_UL CTRL_expressions_mouthFunnelUL LipTightenerL
CheekSuckL JawChew LipsUpperOpen あ２ ああ 右眉左 右 Key.001 Key mouth jaw Eye L R Basis mouthOpen MouthUp smile Open"""


@pytest.mark.parametrize("name", OTHERS.split())
def test_what_no_convention_names_means_nothing(name: str) -> None:
    assert meaning(name) is None
    assert match_shapes([name], sorted(ARKIT_SHAPES)) == match_shapes(sorted(ARKIT_SHAPES), [name]) == {}


AROUND = (
    "BS_{}", "bs_{}", "blendShape1.{}", "blendshape2_{}", "head_geo.{}", "Head_blendShape.{}", "head_lod0_mesh__{}",
    "head_GEO|head_bs|{}", "face:rig:{}", "A25_{}", "07-{}", "{}_ncl1_1", "{}.001", "{} copy", "{}_Mesh", "{} (1)",
    "{}_bs", "facs_bs_{}_div2", "XR_FACE_EXPRESSION_{}_FB", "bs_03_{}_ncl1_2.002",
)  # fmt: skip


@pytest.mark.parametrize("around", AROUND)
def test_what_tools_put_around_names_is_left_out(around: str) -> None:
    shapes = sorted(ARKIT_SHAPES)
    assert match_shapes(shapes, [around.format(name) for name in shapes]) == {
        name: (around.format(name),) for name in shapes
    }
    assert match_shapes([around.format("eyeBlink_L")], shapes) == {around.format("eyeBlink_L"): ("eyeBlinkLeft",)}


def test_words_that_all_shapes_of_a_mesh_begin_with_are_left_out() -> None:
    shapes = [f"Wolf3D_Head_{name}" for name in sorted(ARKIT_SHAPES)]
    assert match_shapes(ARKIT_SHAPES, shapes) == {name: (f"Wolf3D_Head_{name}",) for name in ARKIT_SHAPES}
    assert recognised(shapes) == ("arkit", 52)
    assert match_shapes(shapes, sorted(ARKIT_SHAPES)) == {shape: (shape[12:],) for shape in shapes}
    # one mesh's words are not another's, and the columns of a clip have theirs
    teeth = ["Wolf3D_Teeth_jawOpen", "Wolf3D_Teeth_tongueOut"]
    found = match_shapes(["jawOpen"], [*shapes, *teeth], [shapes, teeth])
    assert found == {"jawOpen": ("Wolf3D_Head_jawOpen", "Wolf3D_Teeth_jawOpen")}
    assert match_shapes(["jawOpen"], ["Wolf3D_Teeth_jawOpen"]) == {}  # one shape shows no words in common
    # correctives are called so as well: what they begin with is a shape
    for word in ("jawOpen_", "corrective_", "fix_", "x_jawOpen_"):
        assert match_shapes(ARKIT_SHAPES, [word + name for name in ("mouthClose", "mouthLeft", "mouthFunnel")]) == {}


def test_the_closest_of_several_shapes_has_the_name() -> None:
    shapes = ["A25_Jaw_Open", "Jaw_Open", "jawOpen_2", "jawOpen.001"]
    assert match_shapes(["jawOpen"], shapes) == {"jawOpen": ("Jaw_Open",)}
    assert match_shapes(["jawOpen", "jawOpen_2"], shapes[2:]) == {
        "jawOpen": ("jawOpen.001",),
        "jawOpen_2": ("jawOpen_2",),
    }
    assert convention_names("arkit", shapes) == {"Jaw_Open": "jawOpen"}
    assert unnamed("arkit", shapes) == ["A25_Jaw_Open", "jawOpen.001"]
    assert convention_names("arkit", ["A25_Jaw_Open", "jawOpen"]) == {}
    # equals: none of them
    assert match_shapes(["jawOpen"], ["01_jawOpen", "02_jawOpen"]) == {}
    assert convention_names("arkit", ["a.jawOpen", "b.jawOpen"]) == {}
    assert unnamed("arkit", ["JawOpen", "jaw_open", "tongueOut"]) == ["JawOpen", "jaw_open"]
    # ARKit's own word is closer than another tool's: ICT-FaceKit has both
    assert convention_names("arkit", ["cheekRaiser_L", "cheekSquint_L"]) == {"cheekSquint_L": "cheekSquintLeft"}
    # a blink of one eye is closer than a wink, which has its place on faces without
    winks = ["ウィンク", "ウィンク右", "ウィンク２", "ｳｨﾝｸ２右", "まばたき"]
    blinks = ["eyeBlinkLeft", "eyeBlinkRight"]
    assert match_shapes(blinks, winks) == {"eyeBlinkLeft": ("ウィンク２",), "eyeBlinkRight": ("ｳｨﾝｸ２右",)}
    assert match_shapes(blinks, winks[:2]) == {"eyeBlinkLeft": ("ウィンク",), "eyeBlinkRight": ("ウィンク右",)}


def test_shapes_in_halves_and_quarters_are_moved_together() -> None:
    quarters = [f"Mouth_Funnel_{row}_{side}" for row in ("Up", "Down") for side in "LR"]
    shapes = [*quarters, "facs_bs_MouthPressUpperLeft", "facs_bs_MouthPressLowerLeft", "Brow_Raise_Inner_L"]
    assert match_shapes(("mouthFunnel", "mouthPressLeft", "mouthPressRight", "browInnerUp"), shapes) == {
        "mouthFunnel": tuple(quarters),
        "mouthPressLeft": ("facs_bs_MouthPressUpperLeft", "facs_bs_MouthPressLowerLeft"),
    }
    assert match_shapes(("mouthFunnel",), quarters[:3]) == {}  # not without the fourth
    assert match_shapes(("lookUp", "まばたき"), sorted(ARKIT_SHAPES)) == {
        "lookUp": ("eyeLookUpLeft", "eyeLookUpRight"),
        "まばたき": ("eyeBlinkLeft", "eyeBlinkRight"),
    }
    assert match_shapes(("mouth", "jaw"), sorted(ARKIT_SHAPES)) == {}  # left and right are ways there, not halves


def test_a_name_has_a_shape_on_every_mesh() -> None:
    meshes = [[f"{mesh}__facs_jnt_JawOpen", f"{mesh}__facs_jnt_EyeBlinkLeft"] for mesh in ("Genesis8", "Lashes")]
    shapes = [shape for mesh in meshes for shape in mesh]
    assert match_shapes(["jawOpen"], shapes, meshes) == {"jawOpen": (meshes[0][0], meshes[1][0])}
    assert match_shapes(["jawOpen"], shapes) == {}  # on one mesh they are equals
    assert convention_names("arkit", shapes, meshes) == dict(zip(shapes, ["jawOpen", "eyeBlinkLeft"] * 2, strict=True))
    # JawOpen is on the first mesh too, where jawOpen is the better match
    assert match_shapes(["jawOpen"], ["JawOpen", "jawOpen"], [["jawOpen", "JawOpen"], ["JawOpen"]]) == {
        "jawOpen": ("jawOpen",)
    }
    # sliders are on no mesh: a name moves one of them or shapes, what is closer
    assert match_shapes(["jawOpen"], [*shapes, "A25_Jaw_Open"], meshes) == {"jawOpen": (meshes[0][0], meshes[1][0])}
    assert match_shapes(["jawOpen"], [*shapes, "jaw_open"], meshes) == {"jawOpen": ("jaw_open",)}
    assert match_shapes(["jawOpen", "JawOpen"], ["JawOpen", "jawOpen"], [["jawOpen", "JawOpen"], ["JawOpen"]]) == {
        "jawOpen": ("jawOpen",),
        "JawOpen": ("JawOpen",),
    }


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
    for kind, table in CONVENTIONS.items():
        if kind != "mpfb":  # whose names are ARKit's and Oculus's
            assert recognised(list(table.written.values())) == (kind, len(table.names))


def test_a_face_of_two_conventions_is_called_so() -> None:
    both = [*ARKIT_SHAPES, *CONVENTIONS["oculus"].names]
    found = convention_of([*both, "eyesClosed", "mouthOpen", "noseHump"])
    assert found is not None
    assert convention_text(found) == "ARKit 52 of 52 and Oculus visemes 15 of 15"
    assert (found["convention"], found["names"], found["of"], found["exact"]) == ("arkit", 52, 52, True)
    assert found["also"] == [
        {"convention": "oculus", "title": "Oculus visemes", "names": 15, "of": 15, "exact": True},
    ]
    perfect_sync = [*ARKIT_SHAPES, *CONVENTIONS["vroid"].written.values()]
    assert convention_text(convention_of(perfect_sync)).startswith("VRoid Studio 57 of 57 and ARKit 52 of 52")
    assert "also" not in (convention_of([*ARKIT_SHAPES, "viseme_aa", "viseme_O"]) or {})


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


def test_many_names_find_their_shapes_on_many_meshes() -> None:
    """Names without any are not tried on each mesh: these would take minutes."""
    meshes = [[f"m{i}.jawOpen", f"m{i}.eyeBlink_L"] for i in range(300)]
    others = [f"curve {i}" for i in range(2000)]
    shapes = [shape for mesh in meshes for shape in mesh]
    matched = match_shapes([*others, "JawOpen", "eyeBlinkLeft"], shapes, meshes)
    assert matched == {"JawOpen": tuple(shapes[::2]), "eyeBlinkLeft": tuple(shapes[1::2])}
