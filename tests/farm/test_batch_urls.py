"""Plans over files at URLs: the results have the bytes of those on local folders, and are kept and made anew alike."""

from __future__ import annotations

import json
import os
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from command_line import Capsys, done, run
from conftest import PLAN, Runner
from faces import tiny_face, with_meshes
from farm_cluster import farm_in
from textures import COLORS, picture, textured

from facepipe.core.errors import InputError
from facepipe.core.policy.paths import Trust, trust, trusting
from facepipe.farm.batch import BatchReport, batch
from facepipe.farm.plan import read_plan
from facepipe.parts import Material
from facepipe.stage import save_parts
from facepipe.tasks.mirror import mirror

fsspec = pytest.importorskip("fsspec")
pytest.importorskip("s3fs")
pytest.importorskip("moto.moto_server.werkzeug_app")

from s3_server import S3Server, serving  # noqa: E402  (needs moto)

AT_URLS = (
    PLAN.replace('"built"', '"s3://show/built"')
    .replace("heads/", "s3://show/heads/")
    .replace("base.bin", "s3://show/base.bin")
)


@pytest.fixture(scope="module")
def server() -> Iterator[S3Server]:
    with serving() as server:
        yield server


@pytest.fixture
def s3(server: S3Server, show: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """The store, with the files of `show` in a bucket of that name."""
    server.cuts.clear()
    settings = {"AWS_ENDPOINT_URL": server.address, "AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret"}
    settings |= {"AWS_DEFAULT_REGION": "us-east-1", "AWS_MAX_ATTEMPTS": "1", "XDG_CACHE_HOME": str(tmp_path)}
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("s3fs.core.S3FileSystem.retries", 1)  # each of five would wait longer than the one before
    urllib.request.urlopen(urllib.request.Request(f"{server.address}/moto-api/reset", method="POST"))
    files = fsspec.filesystem("s3", use_listings_cache=False)
    for bucket in ("show", "other"):
        files.mkdir(bucket)
    for path in show.rglob("*.bin"):
        files.put_file(str(path), f"show/{path.relative_to(show).as_posix()}")
    return files


@pytest.fixture
def run_urls(s3: Any, run_plan: Runner) -> Callable[..., BatchReport]:
    """As `run_plan`, with the bucket as a root."""

    def run(text: str = "", roots: tuple[str, ...] = ("s3://show",), **options: Any) -> BatchReport:
        with trusting(replace(trust(), urls=roots)):
            return run_plan(text, **options)

    return run


def test_results_are_those_of_local_folders(s3: Any, show: Path, run_plan: Runner, run_urls: Runner) -> None:
    run_plan(PLAN)
    report = run_urls(AT_URLS, processes=2)
    assert dict(report.counts) == {"made": 6}, report.failures
    local = {path.relative_to(show).as_posix(): path.read_bytes() for path in (show / "built").rglob("*.bin")}
    assert {name.removeprefix("show/"): s3.cat_file(name) for name in s3.find("show/built")} == local


def test_a_finished_plan_is_kept_in_a_request_a_folder(s3: Any, server: S3Server, run_urls: Runner) -> None:
    for number in range(8):
        s3.pipe_file(f"show/heads/more{number}.bin", b"more")
    assert dict(run_urls(AT_URLS, processes=2).counts) == {"made": 22}
    server.asked.clear()
    assert dict(run_urls().counts) == {"kept": 22}
    assert len(server.asked) <= 8, (
        server.asked
    )  # the table's, and those of heads/, the base's folder and built/, not 11


def test_a_changed_object_is_followed_and_nothing_else(s3: Any, show: Path, run_urls: Runner) -> None:
    run_urls(AT_URLS)
    s3.pipe_file("show/heads/bea.bin", b"Bea")
    s3.rm_file("show/built/game/cyd.bin")
    assert dict(run_urls().counts) == {"kept": 3, "made": 3}
    assert s3.cat_file("show/built/game/bea.bin") == b"Beabase"
    assert s3.cat_file("show/built/game/cyd.bin") == b"cydbase"


def test_results_come_from_the_cache_of_results(s3: Any, run_urls: Runner, tmp_path: Path) -> None:
    run_urls(AT_URLS, cache=tmp_path / "cache")
    s3.rm("show/built", recursive=True)
    assert dict(run_urls(cache=tmp_path / "cache").counts) == {"cached": 6}
    assert s3.cat_file("show/built/game/ada.bin") == b"adabase"


def test_copies_stay_within_their_size_and_none_is_left_of_a_task(s3: Any, run_urls: Runner, tmp_path: Path) -> None:
    s3.pipe_file("show/base.bin", bytes(700_000))
    local = tmp_path / "local"
    report = run_urls(AT_URLS, local=local, local_gb=0.001)
    assert dict(report.counts) == {"made": 6}, report.failures
    assert s3.info("show/built/game/ada.bin")["size"] == 700_003
    left = [path for path in local.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in left) <= 1e6
    assert not [path for path in left if path.suffix == ".bin"]


def test_a_damaged_copy_is_not_used(s3: Any, run_urls: Runner, tmp_path: Path) -> None:
    run_urls(AT_URLS, local=tmp_path / "local")
    for path in (tmp_path / "local/copies").glob("*/0"):
        path.write_bytes(b"damaged")
    s3.pipe_file("show/heads/bea.bin", b"Bea")
    run_urls(local=tmp_path / "local")
    assert s3.cat_file("show/built/game/bea.bin") == b"Beabase"


def test_a_face_that_is_not_there_fails_alone(s3: Any, show: Path, run_urls: Runner) -> None:
    s3.pipe_file("show/faces.csv", b"name,face\nada,s3://show/heads/ada.bin\nlost,s3://show/heads/lost.bin\n")
    report = run_urls(AT_URLS.replace('glob = "s3://show/heads/*.bin"', 'csv = "s3://show/faces.csv"'))
    assert dict(report.counts) == {"made": 2, "failed": 1, "skipped": 1}
    assert report.failures == ("s3://show/heads/lost.bin: no such file",)


FAULTS = {
    "s3://other/secret.bin": "s3://other/secret.bin: is outside the roots (s3://show), expected --root s3://other",
    "s3://show/../other/secret.bin": "can't be used",
    "s3://key:secret@show/heads/ada.bin": "is outside the roots",
    "s3://key@show/heads/ada.bin": "s3://...@show/heads/ada.bin: can't be used",
    "s3://show/heads/ada.bin?versionId=1": "can't be used",
    "gs://show/heads/ada.bin": "is outside the roots",
    "file:///etc/hostname": "no such file",
    "local://etc/hostname": "no such file",
    "https://localhost/ada.bin": "no such file",
    "simplecache::s3://show/heads/ada.bin": "can't be used",
    "s3:/show/heads/ada.bin": "no such file",
    "s3://show/.facepipe-0123456789abcdef/ada.bin": "can't be used",
}


def test_a_url_that_is_none_of_the_roots_is_a_line(s3: Any, show: Path, run_urls: Runner) -> None:
    s3.pipe_file("other/secret.bin", b"secret")
    bad = [f'{{ name = "bad{number}", face = "{url}" }}' for number, url in enumerate(FAULTS)]
    rows = f'rows = [{", ".join(bad)}, {{ name = "ada", face = "s3://show/heads/ada.bin" }}]'
    report = run_urls(AT_URLS.replace('glob = "s3://show/heads/*.bin"', rows))
    assert dict(report.counts) == {"made": 2, "failed": len(FAULTS), "skipped": len(FAULTS)}
    state = json.loads((show / "state/report.json").read_text())
    errors = {record["task"]: record.get("error") for record in state["records"]}
    for number, fault in enumerate(FAULTS.values()):
        assert fault in errors[f"mixed/bad{number}"]
        assert errors[f"mixed/bad{number}"] in report.failures
    assert "secret@" not in json.dumps(state["failures"])


@pytest.mark.parametrize(
    "change",
    [('"s3://show/built"', '"s3://other/built"'), ("s3://show/heads/*", "s3://other/*"), ("s3://", "file:///")],
)
def test_a_plan_never_chooses_its_roots(s3: Any, run_urls: Runner, change: tuple[str, str]) -> None:
    with pytest.raises(InputError, match=r"outside the roots \(s3://show\)|can't be used"):
        run_urls(AT_URLS.replace(*change))


def test_addresses_that_are_no_files_stay_words() -> None:
    line = ["export", "face.usda", "--license-url", "https://vrm.dev/licenses/1.0/"]
    with mirror((), None, 0) as here:
        assert here.words(line) == line


def test_without_a_root_no_url_is_read(run_urls: Runner) -> None:
    rows = 'rows = [{ name = "ada", face = "s3://show/heads/ada.bin" }]'
    report = run_urls(PLAN.replace('glob = "heads/*.bin"', rows), roots=())
    assert "is outside the roots (none has a URL), expected --root s3://show" in report.failures[0]


def test_a_folder_for_copies_that_can_not_be_made_is_a_line(run_urls: Runner, show: Path) -> None:
    report = run_urls(AT_URLS, local=show / "base.bin")
    assert report.failures == (f"{show / 'base.bin'}: can't be made: File exists (3 tasks)",)


@pytest.mark.slow
def test_a_lost_connection_is_tried_again_and_then_told(
    s3: Any, server: S3Server, show: Path, run_urls: Runner
) -> None:
    source = "HEAD /show/heads/bea.bin"  # asked before and after it is copied, and when the task is tried again
    server.asked.clear()
    server.cuts["PUT /show/built/mixed/bea.bin"] = lambda: server.asked.count(source) < 3
    server.cuts["GET /show/heads/cyd.bin"] = lambda: True
    report = run_urls(AT_URLS, failures=1)
    assert dict(report.counts) == {"made": 4, "failed": 1, "skipped": 1}
    assert report.failures[0].startswith("s3://show/heads/cyd.bin: ")
    assert report.failures[0].count("\n") == 0
    records = {one["task"]: one for one in json.loads((show / "state/report.json").read_text())["records"]}
    assert records["mixed/bea"]["lost"] == 1
    assert records["mixed/cyd"]["lost"] == 2
    server.cuts.clear()
    assert dict(run_urls().counts) == {"kept": 4, "made": 2}


@pytest.mark.slow
def test_workers_of_a_cluster_have_copies_of_their_own(s3: Any, show: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    (show / "plan.toml").write_text(AT_URLS)
    (tmp_path / "file").touch()
    with farm_in(tmp_path / "farm") as farm, trusting(Trust(urls=("s3://show",))):
        farm.worker(XDG_CACHE_HOME=str(tmp_path / "file"))  # has no place for copies
        farm.worker(XDG_CACHE_HOME=str(tmp_path / "own"))
        with distributed.Client(farm.address, set_as_default=False) as client:
            client.wait_for_workers(2)
        report = batch(read_plan(show / "plan.toml"), show / "state", cluster=farm.address)
    assert dict(report.counts) == {"made": 6}, report.failures
    assert s3.cat_file("show/built/game/bea.bin") == b"beabase"
    assert any((tmp_path / "own/facepipe/copies").iterdir())
    assert [line for line in report.warnings if "can't be made" in line and "its tasks go to others" in line]


FACES = """
out = "OUT"
[faces]
glob = "SOURCES/heads/*.usda"
[steps.mixed]
run = "blend {face} BASE"
out = "mixed/{name}.usda"
[steps.game]
run = "export {mixed}"
out = "game/{name}.glb"
"""


@pytest.fixture
def sources(show: Path) -> Path:
    """A folder with a textured face, two heads that stand on it by a relative path, and a base."""
    skin = Material(name="Skin", diffuse_color=textured(picture("skin.png", COLORS)))
    folder = show / "src"
    (folder / "heads").mkdir(parents=True)
    (show / "bases").mkdir()
    save_parts(replace(with_meshes(tiny_face(), material="Skin"), materials=(skin,)), folder / "body.usda")
    save_parts(tiny_face(1), show / "bases/base.usda")
    for name in ("ada", "bea"):
        (folder / f"heads/{name}.usda").write_text(
            f'#usda 1.0\n(\n    customLayerData = {{ string name = "{name}" }}\n    defaultPrim = "Tiny"\n'
            '    metersPerUnit = 0.01\n    upAxis = "Y"\n    subLayers = [@../body.usda@]\n)\n'
        )
    return folder


def test_faces_with_layers_and_textures_come_out_alike(
    s3: Any, show: Path, sources: Path, run_plan: Runner, run_urls: Runner
) -> None:
    def plan(out: str, heads: str, base: str) -> str:
        return FACES.replace("OUT", out).replace("SOURCES", heads).replace("BASE", base)

    s3.put(str(show / "src"), "show/", recursive=True)
    s3.put_file(str(show / "bases/base.usda"), "show/bases/base.usda")
    local = run_plan(plan("built", "src", "bases/base.usda"))
    assert dict(local.counts) == {"made": 4}, local.failures
    same = run_urls(plan("s3://show/built", "s3://show/src", "s3://show/bases/base.usda"))
    assert dict(same.counts) == {"made": 4}, same.failures
    made = {path.relative_to(show).as_posix(): path.read_bytes() for path in (show / "built").rglob("*.*")}
    assert {name.removeprefix("show/"): s3.cat_file(name) for name in s3.find("show/built")} == made
    assert any(path.endswith(".glb") and b"image/png" in data for path, data in made.items())


def test_sources_results_and_bases_can_have_a_place_each(
    s3: Any, show: Path, sources: Path, run_urls: Runner, tmp_path: Path
) -> None:
    """Heads in one bucket, results in another, a base on a folder that all see."""
    s3.put(str(show / "src"), "show/", recursive=True)
    (show / "bases").rename(tmp_path / "bases")
    base = tmp_path / "bases/base.usda"
    text = FACES.replace("OUT", "s3://other/built").replace("SOURCES", "s3://show/src").replace("BASE", str(base))

    def made(local: str) -> dict[str, bytes]:
        with trusting(Trust(roots=(tmp_path / "bases", show))):
            report = run_urls(text, ("s3://show/src", "s3://other"), local=tmp_path / local)
        assert not report.failures
        return {name: s3.cat_file(name) for name in s3.find("other/built")}

    first = made("one/cache")
    assert len(first) == 4
    assert str(base).encode() in first["other/built/mixed/ada.usda"]
    assert b"cache" not in first["other/built/mixed/ada.usda"]
    s3.rm("other/built", recursive=True)
    assert made("another") == first  # wherever a worker has its copies
    s3.pipe_file("show/src/body_textures/skin.png", picture("skin.png", COLORS[::-1]).data)
    assert made("another")["other/built/game/ada.glb"] != first["other/built/game/ada.glb"]


def test_the_command_takes_urls_as_roots(
    s3: Any, show: Path, sources: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    s3.put(str(show / "src"), "show/", recursive=True)
    monkeypatch.chdir(show)
    words = ("batch", "--each", "s3://show/src/heads/*.usda", "-o", "s3://show/game/{name}.glb", "--processes", "1")
    line = ("--", "export", "{face}")
    code, out, _ = run(capsys, *words, *line)
    allowed = "outside the roots (s3://show/src/heads, s3://show/game)"  # the folders of what is typed, no others
    assert (code, f"s3://show/src/body.usda: is {allowed}" in out) == (1, True)
    done(capsys, *words, "--root", "s3://show", *line, quiet=False)
    assert sorted(s3.ls("show/game")) == ["show/game/ada.glb", "show/game/bea.glb"]
    pictures = [path.name for path in (show / "facepipe_batch/thumbnails").iterdir()]
    assert sorted(pictures) == ["ada.png", "bea.png"]
    monkeypatch.setenv("FACEPIPE_ROOTS", f"{show}{os.pathsep}s3://show")
    assert "4 kept" in done(capsys, *words, *line, quiet=False)


def test_a_local_result_over_a_layer_at_a_url_is_refused(s3: Any, show: Path, sources: Path, run_urls: Runner) -> None:
    s3.put(str(show / "src"), "show/", recursive=True)
    text = FACES.replace("OUT", "built").replace("SOURCES", "s3://show/src").replace("BASE", "bases/base.usda")
    report = run_urls(text)
    assert "s3://show/src/heads/ada.usda" in report.failures[0]
    assert "expected --flatten" in report.failures[0]
    flat = run_urls(text.replace("{face} bases", "--flatten {face} bases"))
    assert dict(flat.counts) == {"made": 4}, flat.failures
    assert str(show.parent) not in (show / "built/mixed/ada.usda").read_text()
