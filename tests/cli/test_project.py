"""What a project file says of the lines that are run in its folder and below."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import Capsys, done, run
from faces import tiny_face

from facepipe.stage import save_parts


@pytest.fixture
def show(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with a face in a folder of it, which is the working folder."""
    (tmp_path / "show/shots").mkdir(parents=True)
    (tmp_path / "show/facepipe.toml").write_text("")
    save_parts(tiny_face(), tmp_path / "show/shots/face.usda")
    monkeypatch.chdir(tmp_path / "show/shots")
    return tmp_path / "show"


def test_defaults_are_as_if_they_were_given_and_what_is_given_wins(show: Path, capsys: Capsys) -> None:
    (show / "facepipe.toml").write_text("[defaults.render]\nsize = 64\n")
    from PIL import Image

    done(capsys, "render", "face.usda", "-o", "a.png")
    done(capsys, "render", "face.usda", "-o", "b.png", "--size", 32)
    assert [Image.open(one).size for one in ("a.png", "b.png")] == [(64, 64), (32, 32)]


def test_a_table_of_names_is_known_by_its_name(show: Path, capsys: Capsys) -> None:
    (show / "names.csv").write_text("old,new\njawOpen,OPEN\n")
    (show / "facepipe.toml").write_text('[names]\nstudio = "names.csv"\n')
    done(capsys, "export", "face.usda", "-o", "a.glb", "--rename", "studio", quiet=False)
    (show / "facepipe.toml").write_text('[names]\nstudio = "names.csv"\n[defaults.export]\nrename = "studio"\n')
    done(capsys, "export", "face.usda", "-o", "b.glb", quiet=False)
    assert Path("a.glb").read_bytes() == Path("b.glb").read_bytes()
    assert b"OPEN" in Path("a.glb").read_bytes()


def test_an_option_of_one_format_is_left_out_for_another(show: Path, capsys: Capsys) -> None:
    (show / "facepipe.toml").write_text("[defaults.export]\nquantize = true\n")
    done(capsys, "export", "face.usda", "-o", "a.onnx", quiet=False)
    done(capsys, "export", "face.usda", "-o", "b.glb", quiet=False)
    assert b"KHR_mesh_quantization" in Path("b.glb").read_bytes()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[defaults.render]\nsise = 64\n", "'sise' is no option that a project can choose, did you mean 'size'?"),
        ("[defaults.rendre]\nsize = 64\n", "'rendre' is no command, did you mean 'render'?"),
        ("[default]\n", "'default' is unknown, did you mean 'defaults'?"),
        ("roots = 7\n", "expected a list of folders"),
        ("[defaults.render]\nsize = [[1]]\n", "expected a text, a number, or true or false"),
        ("[defaults.render]\noutput = 'x.png'\n", "'output' is no option that a project can choose"),
        ("[defaults.render]\ntrust-models = true\n", "'trust-models' is no option that a project can choose"),
        ("[defaults.batch]\ncluster = 'tcp://1.2.3.4:1'\n", "'cluster' is no option that a project can choose"),
        ("[defaults.blender-addon]\nwheels = 'theirs'\n", "'wheels' is no option that a project can choose"),
        ('[defaults."neural-rig train"]\ncheckpoint = "../x"\n', "'checkpoint' is no option that a project can choose"),
    ],
)
def test_a_fault_is_one_line(show: Path, capsys: Capsys, text: str, said: str) -> None:
    (show / "facepipe.toml").write_text(text)
    lines = {"batch": "plan.toml", "blender-addon": "-o a.zip", "neural-rig train": "face.usda -o a.fpnr"}
    command = next((line for line in lines if line in text), "render")
    words = f"{command} {lines.get(command, 'face.usda -o a.png')}".split()
    code, _, err = run(capsys, *words)
    assert code == 2
    assert said in err
    assert err.count("\n") == 1


def test_roots_of_a_project_that_the_caller_names_are_those_of_the_files_in_it(
    show: Path, tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recipe may be cooked in an asset folder elsewhere where the project says so, and the caller trusts it."""
    (tmp_path / "assets").mkdir()
    for name in ("a", "b"):
        save_parts(tiny_face(), tmp_path / f"assets/{name}.usda")
    done(capsys, "blend", "../../assets/a.usda", "../../assets/b.usda", "-o", "../../assets/mix.usda", quiet=False)
    done(capsys, "blend", "../../assets/mix.usda", "../../assets/a.usda", "-o", "person.usda", quiet=False)
    save_parts(tiny_face(3), tmp_path / "assets/b.usda")
    code, out, _ = run(capsys, "cook", "person.usda", "--json")
    assert code == 1
    assert "outside the roots" in out
    (show / "facepipe.toml").write_text('roots = ["../assets"]\n')
    code, out, err = run(capsys, "cook", "person.usda", "--json")
    assert code == 1
    assert "roots of" in err
    assert "outside the roots" in out
    monkeypatch.setenv("FACEPIPE_PROJECT", str(show / "facepipe.toml"))
    code, out, _ = run(capsys, "cook", "person.usda", "--json")
    assert code == 0
    assert "cooked" in json.dumps(json.loads(out))


def test_edit_keeps_what_the_recipe_says(show: Path, capsys: Capsys) -> None:
    save_parts(tiny_face(2), Path("other.usda"))
    done(capsys, "blend", "face.usda", "other.usda", "-o", "person.usda", "--default", "0.25,0.75", quiet=False)
    before = Path("person.usda").read_text()
    (show / "facepipe.toml").write_text("[defaults.blend]\ndefault = '0.75,0.25'\n")
    done(capsys, "blend", "--edit", "person.usda", "--force", quiet=False)
    assert Path("person.usda").read_text() == before
    done(capsys, "blend", "face.usda", "other.usda", "-o", "person.usda", "--force", quiet=False)
    assert Path("person.usda").read_text() != before
