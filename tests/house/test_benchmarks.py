"""The benchmark commands run, and their figures hold together."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from import_data import shared
from places import REPOSITORY

BENCHMARKS = REPOSITORY / "benchmarks"


def run(*words: str | Path, benchmark: str = "export_gltf.py") -> str:
    """What a benchmark prints."""
    command = [sys.executable, str(BENCHMARKS / benchmark), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_export_benchmark_measures_ict_without_blender(tmp_path: Path) -> None:
    shared("ict_facekit/ict_facekit.npz")
    out = tmp_path / "out.json"
    printed = run("--runs", "1", "--json", out, "--blender-python", "")
    result: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    face = next(one for one in result["faces"] if one["name"] == "ICT-FaceKit")

    assert "Blender" in result["skipped"]
    assert "skipped: Blender" in printed
    assert "blender" not in face["median"]
    for sample in face["samples"]["facepipe"]:
        assert sample["load_s"] + sample["export_s"] == pytest.approx(sample["load_export_s"])
        assert sample["baseline_bytes"] <= sample["loaded_bytes"] <= sample["peak_bytes"]
    assert min(face["median"]["import"][key] for key in ("read_s", "save_s")) > 0

    content = face["content"]["facepipe"]
    assert (content["shapes"], content["of_mesh"]["Head"]["targets"]) == (53, 53)
    sizes = face["sizes"]["facepipe"]
    assert sizes["quantised"] < sizes["sparse"] < sizes["dense"]
    heads = content["of_mesh"].values()
    assert sizes["dense"] > sum(12 * head["targets"] * head["vertices"] for head in heads)


def test_export_benchmark_skips_what_is_not_there(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    printed = run("--json", out, "--data", tmp_path, "--blender-python", tmp_path / "python")
    result = json.loads(out.read_text(encoding="utf-8"))
    assert result["faces"] == []
    assert set(result["skipped"]) == {"ICT-FaceKit", "MakeHuman", "Blender"}
    assert str(tmp_path / "python") in result["skipped"]["Blender"]
    assert printed.count("skipped: ") == 3


def test_neural_rig_engine_benchmark_needs_the_makehuman_head(tmp_path: Path) -> None:
    assert run("--data", tmp_path, benchmark="neural_rig_engine.py") == ""


@pytest.mark.slow
def test_neural_rigs_in_the_engine_are_less_and_nearer_than_dense_blendshapes(tmp_path: Path) -> None:
    shared("makehuman/makehuman_head.npz")
    out = tmp_path / "out.json"
    run("--runs", "20", "--spread", "400", "--steps", "300", "--json", out, benchmark="neural_rig_engine.py")
    rows = {(row["of"], row["way"].partition(" (")[0]): row for row in json.loads(out.read_text())["rows"]}
    assert rows["neural rig", "points"]["mean_mm"] < rows["blendshapes", "points"]["mean_mm"]
    sizes = [
        rows[of, "shapes of the GLB"]["kilobytes"] + rows[of, "matrices, float32"]["kilobytes"]
        for of in ("neural rig", "blendshapes")
    ]
    assert sizes[0] < sizes[1]
    small = [rows["small, with bones", way] for way in ("shapes of the GLB", "matrices, float32")]
    assert sum(row["kilobytes"] for row in small) < 0.5 * sizes[1]
    assert rows["small, with bones", "points"]["mean_mm"] < rows["blendshapes", "points"]["mean_mm"]
    corrected = rows["blendshapes and 128 correctives", "shapes of the GLB"]
    assert corrected["mean_mm"] < rows["blendshapes", "points"]["mean_mm"]
    assert corrected["kilobytes"] > 2.0 * sum(row["kilobytes"] for row in small)


@pytest.mark.slow
def test_blend_benchmark_measures_samples_where_ict_is_not_there(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    printed = run("--runs", "1", "--json", out, "--data", tmp_path, benchmark="blend.py")
    result = json.loads(out.read_text(encoding="utf-8"))
    (face,) = result["faces"]

    assert set(result["skipped"]) == {"ICT-FaceKit"}
    assert printed.count("skipped: ") == 1
    assert face["difference_mm"]["points"] < 1e-6
    assert face["difference_mm"]["offsets"] < 1e-6
    for side in ("cholespy", "splu", "splu-default"):
        (sample,) = face["samples"][side]
        assert sample["shapes"] == 52
        assert sample["session_s"] + sample["first_s"] == pytest.approx(sample["cold_s"])
        assert sample["factor_s"] < sample["cold_s"]
        assert sample["baseline_bytes"] <= sample["peak_bytes"]
    (whole,) = face["samples"]["whole"]
    assert sum(whole[step] for step in ("open_s", "solve_s", "author_s", "save_s")) == pytest.approx(whole["whole_s"])
    assert 0 < whole["border_step_mm"] < 1


@pytest.mark.slow
def test_bone_fit_benchmark_measures_a_sample_where_ict_is_not_there(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    words = ("--runs", "1", "--joints", "3", "--scipy-targets", "1", "--json", out, "--data", tmp_path)
    printed = run(*words, benchmark="bone_fit.py")
    result = json.loads(out.read_text(encoding="utf-8"))
    nine, six = result["tasks"]

    assert "ICT-FaceKit" in result["skipped"]
    assert printed.count("skipped: ") == len(result["skipped"])
    assert (nine["targets"], nine["joints"], nine["dof"], six["dof"]) == (52, 3, 9, 6)
    best = nine["best"]
    assert best["plain"]["rms_mm"] < six["best"]["plain"]["rms_mm"], "scales help"
    assert best["even"]["max_mm"] < best["plain"]["max_mm"]
    assert nine["scipy"]["ours"]["rms_mm"] <= (1 + 1e-4) * nine["scipy"]["rms_mm"]
    if "py-dem-bones" not in result["skipped"]:
        rigid = six["best"]
        assert rigid["plain"]["rms_mm"] <= (1 + 1e-4) * rigid["dem-bones"]["rms_mm"], "the same least squares"


@pytest.mark.needs_torch
@pytest.mark.slow
def test_photo_fit_benchmark_measures_the_sample(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    words = ("--runs", "1", "--size", "64", "--threads", "1", "--fits", "0", "--json", out)
    printed = run(*words, benchmark="photo_fit.py")
    result = json.loads(out.read_text(encoding="utf-8"))
    seconds = {row["step"]: row["processor_s"] for row in result["rows"]}
    assert 40_000 < result["triangles"] < 55_000
    assert set(seconds) == {
        f"{step} {way}" for step in ("rig", "image", "whole") for way in ("forward", "forward + backward")
    }
    assert all(name in printed for name in seconds)
    assert printed.count("skipped: mitsuba") == 1
    (own,) = result["peer"]["rows"]
    assert min(own[way]["best_wall_s"] for way in ("forward", "both")) > 0
    assert abs(result["peer"]["slopes"]["facepipe"]["jawWidth"][0]) < 0.2, "its gradient goes the way differences do"
    assert result["sliders_us"]["warm"] > 0


@pytest.mark.slow
def test_photo_texture_benchmark_finds_known_skin(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    words = ("--seeds", "5", "--size", "128", "--pixels", "320", "--json", out)
    assert "evenness" in run(*words, benchmark="photo_texture.py")
    mean = json.loads(out.read_text(encoding="utf-8"))["mean"]
    assert mean["error"] < 0.06
    assert mean["error"] < mean["template"] / 2


@pytest.mark.needs_torch
@pytest.mark.slow
def test_photo_recovery_benchmark_finds_known_people(tmp_path: Path) -> None:
    """By landmarks alone, which is quick; two people."""
    out = tmp_path / "out.json"
    words = ("--faces", "2", "--iterations", "0", "--modes", "neutral", "expression", "--processes", "1", "--json", out)
    printed = run(*words, benchmark="photo_recovery.py")
    result = json.loads(out.read_text(encoding="utf-8"))
    assert all(len(fits) == 2 for fits in result["fits"].values())
    for mode, means in result["means"].items():
        assert mode in printed
        assert means["landmark_px"] <= 1.5
        assert means["landmark_px"] < means["noisy_px"], "nearer to the truth than to the noise"
        assert means["geometry_mm"] < means["default_mm"]
        assert means["slider"] < means["nothing_slider"]


@pytest.mark.needs_torch
@pytest.mark.slow
def test_photo_geometry_benchmark_fits_nearer_than_the_mean_head(tmp_path: Path) -> None:
    """One person, one photo."""
    out = tmp_path / "out.json"
    run("--people", "1", "--three", "0", "--processes", "1", "--json", out, benchmark="photo_geometry.py")
    rows = json.loads(out.read_text(encoding="utf-8"))["rows"]
    assert set(rows) == {"one photo", "mean head", "nearest of the modes"}
    assert rows["nearest of the modes"]["mean"] < rows["one photo"]["mean"] < rows["mean head"]["mean"]


def test_rebuild_benchmark_skips_what_is_not_there(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    printed = run("--json", out, "--data", tmp_path, benchmark="rebuild.py")
    result = json.loads(out.read_text(encoding="utf-8"))
    assert result["people"] == []
    assert str(tmp_path) in result["skipped"]["ICT-FaceKit"]
    assert printed.count("skipped: ") == len(result["skipped"])


@pytest.mark.slow
def test_rebuild_benchmark_fits_nearer_than_its_peers(tmp_path: Path) -> None:
    """One person; the peers where trimesh is installed."""
    shared("ict_facekit/ict_facekit.npz")
    out = tmp_path / "out.json"
    printed = run("--identities", "1", "--json", out, benchmark="rebuild.py")
    result = json.loads(out.read_text(encoding="utf-8"))
    (person,) = result["people"]
    ours, head = person["best"]["facepipe"], person["best"]["facepipe, whole head"]
    assert (ours["points"], head["points"]) == (9409, 14062)
    assert ours["mean_mm"] == pytest.approx(person["best"]["facepipe, all threads"]["mean_mm"], rel=1e-3)
    assert ours["surface_mm"] < 0.12 < ours["mean_mm"] < 0.8, "the distance from the scan is not the error"
    assert ours["mean_mm"] < ours["p95_mm"]
    for side, one in person["best"].items():
        assert side in printed
        assert one["before_bytes"] <= one["peak_bytes"]
        assert side in ("facepipe", "facepipe, all threads", "facepipe, whole head") or one["mean_mm"] > ours["mean_mm"]
    assert ("trimesh" in result["skipped"]) == (not any(side.startswith("nricp") for side in person["best"]))


@pytest.mark.slow
def test_files_of_others_are_read_as_what_they_mean(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    printed = run("--seed", "1", "--inputs", "64", "--json", out, benchmark="files_of_others.py")
    verdicts = json.loads(out.read_text(encoding="utf-8"))
    assert {verdict["outcome"] for verdict in verdicts} == {"right", "named"}
    assert len({verdict["kind"] for verdict in verdicts}) == 32
    assert "seed 1: " in printed


@pytest.mark.slow
def test_all_requests_of_a_load_are_planned_answered_and_fit_the_model(tmp_path: Path) -> None:
    out, rates = tmp_path / "load.json", (4.0, 0.5, 2.0)
    words = ("--sessions", "2", "--alone", "2", "--seconds", "4", "--requests", "40", "--clients", "2", "--no-photo")
    run("--rates", *map(str, rates), *words, "--json", out, benchmark="serve_load.py")
    result = json.loads(out.read_text(encoding="utf-8"))
    assert sum(one["count"] for one in result["open"]["kinds"].values()) == round(4.0 * sum(rates))
    assert result["open"]["errors"] == result["memory"]["errors"] == {}
    assert result["memory"]["requests"] == 40
    assert result["memory"]["last"]["sessions"] > 0.5 * result["session_mb"]
    for one in (*result["alone"].values(), *result["open"]["kinds"].values()):
        assert 0.0 < one["p50"] <= one["p95"] <= one["p99"] <= one["largest"]
    day = run("--players", "2000", "--measured", out, "--json", tmp_path / "day.json", benchmark="serve_model.py")
    assert "a player: " in day
    assert json.loads((tmp_path / "day.json").read_text())["players"] == pytest.approx(2000, rel=0.1)
