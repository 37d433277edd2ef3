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


PRIVATE = '{"jawOpen": "OPEN"}'
FILES = {  # what a project says -> the line that it is said of
    "[names]\nstudio = '{}'\n": "export face.usda -o a.glb --rename studio",
    "[defaults.export]\nrename = '{}'\n": "export face.usda -o a.glb",
    "[defaults.import]\nrename = '{}'\n": "import usd face.usda a.usda",
    "[defaults.import]\nidentity = '{}'\n": "import ict face.usda a.usda",
    "[defaults.export]\nmeta = '{}'\n": "export face.usda -o a.vrm",
    "[defaults.export]\nneural = '{}'\n": "export face.usda -o a.glb",
    "[defaults.view]\nonnx = '{}'\n": "view face.usda",
    "[defaults.blend]\nweights = '{}'\n": "blend face.usda face.usda -o a.usda",
    "[defaults.sliders]\nlimits = '{}'\n": "sliders face.usda --from-shapes -o a.usda",
    "[defaults.fit-bones]\nlimits = ['{}']\n": "fit-bones face.usda --target jawOpen -o a.usda",
}


@pytest.mark.parametrize("text", FILES, ids=lambda text: text.replace("\n", " "))
@pytest.mark.parametrize("way", ["{top}/private.json", "../private.json", "link.json", "file://{top}/private.json"])
def test_files_that_a_project_chooses_lie_in_it(
    show: Path, tmp_path: Path, capsys: Capsys, text: str, way: str
) -> None:
    (tmp_path / "private.json").write_text(PRIVATE)
    (show / "link.json").symlink_to("../private.json")
    (show / "facepipe.toml").write_text(text.format(way.format(top=tmp_path)))
    before = sorted(Path().iterdir())
    code, _, err = run(capsys, *FILES[text].split())
    assert (code, err.count("\n")) == (2, 1)
    assert ("is a URL, expected a file" if "file:" in way else "is outside the roots") in err
    assert sorted(Path().iterdir()) == before


def test_files_that_a_project_chooses_may_lie_below_given_roots(
    show: Path, tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of the line and of the environment; its own where the caller names it. Paths are from its folder."""
    for folder in (tmp_path / "library", show):
        folder.mkdir(exist_ok=True)
        (folder / "names.json").write_text(PRIVATE)
    own, other = "[defaults.export]\nrename = 'names.json'\n", "[defaults.export]\nrename = '../library/names.json'\n"
    project, line = show / "facepipe.toml", ("export", "face.usda", "-o", "a.glb", "--force")
    project.write_text(own)
    done(capsys, *line, quiet=False)
    first = Path("a.glb").read_bytes()
    assert b"OPEN" in first
    project.write_text(f'roots = ["../library"]\n{other}')
    assert run(capsys, *line)[0] == 2
    done(capsys, *line, "--root", "../../library", "--root", ".", quiet=False)
    assert Path("a.glb").read_bytes() == first
    with monkeypatch.context() as patch:
        patch.setenv("FACEPIPE_ROOTS", str(tmp_path / "library"))
        done(capsys, *line, quiet=False)
    monkeypatch.setenv("FACEPIPE_PROJECT", str(project))
    done(capsys, *line, quiet=False)
    project.write_text(f"roots = ['s3://bucket']\n{other}")
    assert "is a URL, expected a folder" in run(capsys, *line)[2]


@pytest.mark.parametrize("name", ["{}", "{nose}", "{game}"])
def test_braces_of_a_project_are_those_of_the_plan(show: Path, capsys: Capsys, name: str) -> None:
    (show / "facepipe.toml").write_text(f'[defaults.export]\nengine = "{name}"\n')
    plan = '[faces]\nglob = "face.usda"\n[steps.game]\nrun = "export {face}"\nout = "{name}.glb"\n'
    Path("plan.toml").write_text(plan)
    code, out, _ = run(capsys, "batch", "plan.toml", "--processes", "1", "--thumbnails", "0")
    assert code == 1
    assert "steps.game: " in out
    assert not Path("out").exists()
