"""The policy towards files of others: roots, links, what is written, copied, read and loaded."""

import os
import sys
import threading
from pathlib import Path

import pytest
from command_line import done, exit_code, failed

import facepipe
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import (
    Trust,
    check_copied,
    check_model,
    check_readable,
    check_writable,
    check_written,
    is_below,
    is_writable,
    roots_of,
    trust,
    trusting,
)
from facepipe.core.reading import file_beside, files_in, read_bytes


@pytest.fixture
def show(tmp_path: Path) -> Path:
    for name in ("show/shots", "show/assets", "other"):
        (tmp_path / name).mkdir(parents=True)
    return tmp_path / "show"


def test_the_root_of_a_stage_is_its_folder(show: Path) -> None:
    assert roots_of(show / "shots/a.usda") == (show / "shots",)


def test_the_root_is_the_nearest_project(show: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (show / "facepipe.toml").touch()
    assert roots_of(show / "shots/a.usda") == (show,)
    (show / "shots/facepipe.toml").touch()
    monkeypatch.chdir(show)
    assert roots_of(Path("shots/a.usda")) == (show / "shots",)


def test_given_roots_are_the_only_ones(show: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (show / "facepipe.toml").touch()
    monkeypatch.setenv("FACEPIPE_ROOTS", os.pathsep.join([str(show / "assets"), str(show / "shots"), ""]))
    assert roots_of(show / "a.usda") == (show / "assets", show / "shots")
    with trusting(Trust(roots=(show.parent / "other",))):
        assert roots_of(show / "a.usda") == (show.parent / "other",)


def test_roots_of_the_environment_are_folders_and_urls(show: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FACEPIPE_ROOTS", os.pathsep.join([str(show), "s3://show/a", str(show / "shots")]))
    assert trust() == Trust(roots=(show, show / "shots"), urls=("s3://show/a",))


def test_the_project_one_works_in_is_the_root_of_the_files_in_it_alone(show: Path) -> None:
    (show / "shots/facepipe.toml").touch()
    with trusting(Trust(project=(show / "assets", show))):
        assert roots_of(show / "shots/a.usda") == (show / "assets", show)
        assert roots_of(show.parent / "other/a.usda") == (show.parent / "other",)


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_the_project_is_that_of_the_folder_that_a_link_means(show: Path) -> None:
    (show / "facepipe.toml").touch()
    (show / "shots/facepipe.toml").mkdir()  # marks nothing
    (show.parent / "link").symlink_to(show / "shots")
    (show / "shots/a.usda").symlink_to(show.parent / "other/a.usda")
    assert roots_of(show.parent / "link/a.usda") == (show,)


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_paths_that_mean_nothing_are_below_nothing(show: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (show / "round").symlink_to("round")
    assert is_below(show / "a.usda", [show / "round", show / "a\0b", show])
    assert not is_below(show / "a\0b", [show])
    (show / "gone").mkdir()
    monkeypatch.chdir(show / "gone")
    (show / "gone").rmdir()
    assert not is_below(Path("a.usda"), [show])


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_links_are_followed_before_paths_are_compared(show: Path) -> None:
    (show / "shots/out").symlink_to(show.parent / "other")
    (show / "shots/round").symlink_to("round")
    assert not is_below(show / "shots/out/a.usda", [show])
    assert not is_below(show / "shots/round/a.usda", [show / "shots"])
    assert is_below(show / "shots/../assets/new/a.usda", [show])
    assert not is_below(show / "shots/../../other/a.usda", [show])
    (show.parent / "link").symlink_to(show)
    assert is_below(show / "a.usda", [show.parent / "link"])


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_what_lies_in_a_folder_or_beside_a_file_is_no_link_elsewhere(show: Path) -> None:
    """What the caller types may be one."""
    (show.parent / "other/a.json").write_text('{"kind": "content"}')
    for name in ("a.json", "net.onnx.json", "a.png", ".hidden.json", "net.onnx"):
        (show / "shots" / name).symlink_to(show.parent / "other/a.json")
    net = show / "shots/net.onnx"
    for read in (
        lambda: files_in(show / "shots", (".json",)),
        lambda: file_beside(show / "shots", "gone.json", "a.json"),
        lambda: file_beside(net, "net.onnx.json"),
    ):
        with pytest.raises(InputError, match="outside the roots"):
            read()
        with trusting(Trust(roots=(show.parent,))):
            assert read()
    assert files_in(show / "shots", (".obj",)) == []
    assert file_beside(net, "gone.json") is None
    assert read_bytes(net, 100) == b'{"kind": "content"}'


def test_a_folder_that_begins_alike_is_another(show: Path) -> None:
    (show.parent / "show2").mkdir()
    assert not is_below(show.parent / "show2/a.usda", [show])


def test_what_is_written_stays_below_the_roots(show: Path) -> None:
    check_writable("a", show / "shots/b/c.usda", show / "shots/a.usda")
    with pytest.raises(InputError, match="outside the roots"):
        check_writable("a", show / "assets/c.usda", show / "shots/a.usda")


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_a_link_outside_is_not_written_though_it_leads_inside(show: Path) -> None:
    (show.parent / "other/c.usda").symlink_to(show / "shots/c.usda")
    with pytest.raises(InputError, match="outside the roots"):
        check_writable("a", show.parent / "other/c.usda", show / "shots/a.usda")
    assert not is_writable(show.parent / "other/c.usda", iter([show]))
    assert is_writable(show / "shots/c.usda", iter([show]))


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
@pytest.mark.parametrize("said", ["nothing", "root", "mark", "project"])
def test_an_output_is_not_written_through_links_out_of_the_roots(
    show: Path, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file itself, its folder, a folder between, or what a link there leads to; whoever said the roots."""
    monkeypatch.chdir(show)
    folder = show / "shots"
    (folder / "deep").mkdir()
    links = {"file": "../../other/file", "folder": "../../other", "deep/up": "../../..", "deep/round": "../folder"}
    for name, target in links.items():
        (folder / name).symlink_to(target)
    (folder / "own").symlink_to("deep")
    (show / "facepipe.toml").touch() if said == "mark" else None
    policy = Trust(roots=(show,)) if said == "root" else Trust(project=(show,)) if said == "project" else Trust()
    with trusting(policy):
        for name in ("a.glb", "new.glb", "deep/../a.glb", "own/a.glb", "own/new/a.glb"):
            check_written(folder / name)
            check_written(Path("shots", name))
        for name in ("file", "folder", "folder/a.glb", "folder/new/a.glb", "own/up/a.glb", "deep/up/other/a.glb"):
            with pytest.raises(InputError, match=r"is a link to .*, outside the roots \(.*\), expected --root "):
                check_written(Path("shots", name))
        with pytest.raises(InputError, match="outside the roots"):
            check_written(folder / "deep/round/a.glb")
    fix = Trust(roots=(show.parent / "other",))
    with trusting(fix):
        check_written(folder / "file")
        check_written(folder / "folder/a.glb")


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_links_outside_of_the_roots_are_the_caller_s_own(show: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (show.parent / "link").symlink_to("other")
    (show.parent / "home").symlink_to("show")
    (show.parent / "circle").symlink_to("circle")
    monkeypatch.chdir(show)
    check_written(show.parent / "link/a.glb")
    check_written(Path("../link/new/a.glb"))
    check_written(show.parent / "home/shots/a.glb")
    for name in ("a" * 300, "a\0b"):  # no file can have it: who writes it says so
        check_written(show / name / name)
    monkeypatch.chdir(show.parent / "home/shots")
    check_written(Path("a.glb"))
    with pytest.raises(InputError, match="more than 1000"):
        check_written(show.parent / "circle/a.glb")
    (show.parent / "other/a.glb").symlink_to("../show/a.glb")
    with pytest.raises(InputError, match="outside the roots"):  # nobody types that it is one
        check_written(show.parent / "link/a.glb")


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_a_link_to_a_model_with_code_is_one(show: Path) -> None:
    for name, meant in {"start.onnx": "start.pt2", "net.pt": "net.onnx"}.items():
        (show / name).symlink_to(show / meant)
        with pytest.raises(InputError, match="can run code"):
            check_model(show / name)
    (show / "round.onnx").symlink_to("round.onnx")
    check_model(show / "round.onnx")


def test_copied_files_come_from_roots_or_the_folder_that_names_them(show: Path) -> None:
    layer = show / "assets/face.usda"
    with trusting(Trust(roots=(show / "shots",))):
        check_copied("a", show / "assets/skin.png", layer)
        check_copied("a", show / "shots/skin.png", layer)
        with pytest.raises(InputError, match="outside the roots"):
            check_copied("a", show.parent / "other/skin.png", layer)


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_copied_files_lie_below_the_folder_of_a_linked_layer_not_beside_what_it_leads_to(show: Path) -> None:
    (show / "assets/face.usda").symlink_to(show.parent / "other/face.usda")
    check_copied("a", show / "assets/skin.png", show / "assets/face.usda")
    with pytest.raises(InputError, match="outside the roots"):
        check_copied("a", show.parent / "other/skin.png", show / "assets/face.usda")


def test_reads_are_confined_where_the_caller_says_so(show: Path) -> None:
    check_readable(show.parent / "other/a.usda")
    with trusting(Trust(roots=(show,), confined=True)):
        check_readable(show / "shots/a.usda")
        check_readable(Path(facepipe.__file__).parent / "networks/face_features.onnx")  # what comes with facepipe
        for path in (show.parent / "other/a.usda", Path(facepipe.__file__).parents[1] / "a.usda"):
            with pytest.raises(InputError, match="outside the roots"):
                check_readable(path)
    check_readable(show.parent / "other/a.usda")


def test_models_with_code_are_loaded_only_where_the_caller_says_so() -> None:
    check_model(Path("net.onnx"))
    for kind in ("PT2", "pt", "pth", "ckpt", "pkl", "pickle", "joblib"):
        with pytest.raises(InputError, match="--trust-models"):
            check_model(Path(f"net.{kind}"))
    with trusting(Trust(models=True)):
        check_model(Path("net.pt2"))


def test_a_policy_is_of_its_own_thread(show: Path) -> None:
    found = []
    with trusting(Trust(models=True)):
        other = threading.Thread(target=lambda: found.append(trust().models))
        other.start()
        other.join()
    assert found == [False]


@pytest.mark.parametrize("policy", [{"roots": (Path("no such folder"),)}, {"confined": True}])
def test_policies_that_make_no_sense_are_refused(policy: dict[str, object]) -> None:
    with pytest.raises(InputError, match="--root"), trusting(Trust(**policy)):  # type: ignore[arg-type]
        pass


def test_every_command_takes_roots(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "a.usda")
    assert "none: is no folder" in failed(capsys, "sample", out, "--root", tmp_path / "none", folder=tmp_path)
    assert exit_code("sample", out, "--textures", "0", "--root", tmp_path) == 0


@pytest.mark.parametrize("words", [["--root", "none", "info", "a.fpdb"], ["info", "a.fpdb", "--root", "none"]])
def test_roots_stand_before_and_after_an_action(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("database", *words) == 2
    assert "--root none: is no folder" in capsys.readouterr().err


def test_a_line_keeps_what_its_host_has_confined(show: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (show.parent / "other/a.json").write_text("{}")
    face = str(show / "a.usda")
    done(capsys, "sample", face, "--textures", "0")
    words = ["landmarks", face, "--from", str(show.parent / "other/a.json"), "-o", str(show / "b.usda")]
    with trusting(Trust(roots=(show,), confined=True)):
        assert "a.json: is outside the roots" in failed(capsys, *words, folder=show.parent)
