"""What a stage plays where any program opens it: found by UsdSkel alone, and as facepipe evaluates it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faces import tiny_face
from oracle import difference, played
from pxr import Sdf, Usd, UsdSkel
from small_head import make

import facepipe
from facepipe.importers import load
from facepipe.importers.usd import Options
from facepipe.parts import Animation, FaceParts
from facepipe.stage import save_parts


def clip(name: str, rate: float, samples: int = 4) -> Animation:
    """A clip of the tiny face on whole frames."""
    rng = np.random.default_rng(len(name))
    return Animation(
        name=name,
        times=np.arange(samples) / rate,
        joints=("root/jaw",),
        coefficients=rng.uniform(0.9, 1.1, (samples, 1, 9)).astype(np.float16),
        shapes=("jawOpen",),
        shape_weights=rng.random((samples, 1)).astype(np.float32),
    )


def playing(rate: float = 30.0, name: str | None = "second") -> FaceParts:
    clips = (clip("first", rate), clip("second", rate))
    return replace(tiny_face(), animations=clips, played=name, frames_per_second=rate)


def bound(path: Path) -> str | None:
    """Name of the animation that UsdSkel finds for the skeleton."""
    stage = Usd.Stage.Open(str(path))
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(stage.GetDefaultPrim()), Usd.PrimDefaultPredicate)
    skeleton = next(UsdSkel.Skeleton(one) for one in stage.Traverse() if one.IsA(UsdSkel.Skeleton))
    query = cache.GetSkelQuery(skeleton).GetAnimQuery()
    return query.GetPrim().GetName() if query else None


def rates(path: Path) -> tuple[float, float]:
    stage = Usd.Stage.Open(str(path))
    return stage.GetTimeCodesPerSecond(), stage.GetFramesPerSecond()


def agrees(path: Path) -> None:
    """What UsdSkel bakes of the file is, sample by sample, what facepipe evaluates."""
    face = facepipe.open(path)
    assert face.played is not None
    animation = next(one for one in face.animations if one.name == face.played)
    assert animation.times is not None
    baked = played(path, animation.times)
    for index, points in enumerate(baked):
        local, weights = face.sample(face.played, index)
        assert difference(face, points, face.evaluate(weights, joint_transforms=local)) < 1e-5


def test_the_sample_plays_its_clip(tmp_path: Path) -> None:
    path = tmp_path / "head.usda"
    save_parts(make(0), path)
    assert bound(path) == "talk"
    agrees(path)


@pytest.mark.parametrize("name", ["first", "second", None])
def test_what_a_face_plays_is_saved_and_read(name: str | None, tmp_path: Path) -> None:
    path = tmp_path / "face.usda"
    save_parts(playing(name=name), path)
    assert bound(path) == name
    assert facepipe.open(path).parts().played == name
    assert rates(path) == (30.0, 30.0)
    if name is not None:
        agrees(path)


def above(stage: Usd.Stage) -> None:
    """The source is bound on the SkelRoot, as older files have it."""
    skeleton = stage.GetPrimAtPath("/Tiny/Skeleton")
    (target,) = UsdSkel.BindingAPI(skeleton).GetAnimationSourceRel().GetTargets()
    skeleton.RemoveProperty("skel:animationSource")
    UsdSkel.BindingAPI.Apply(stage.GetDefaultPrim()).CreateAnimationSourceRel().SetTargets([target])


def outside(stage: Usd.Stage) -> None:
    """The played clip stands beside the face."""
    layer = stage.GetRootLayer()
    assert Sdf.CopySpec(layer, "/Tiny/Animations/second", layer, "/Beside")
    UsdSkel.BindingAPI(stage.GetPrimAtPath("/Tiny/Skeleton")).GetAnimationSourceRel().SetTargets(["/Beside"])


def same_names(stage: Usd.Stage) -> None:
    """Another clip of the same name comes first."""
    layer = stage.GetRootLayer()
    stage.DefinePrim("/Tiny/A", "Scope")
    assert Sdf.CopySpec(layer, "/Tiny/Animations/first", layer, "/Tiny/A/second")


@pytest.mark.parametrize("change", [None, above, outside, same_names])
def test_an_import_plays_what_its_source_plays(change: Callable[[Usd.Stage], None] | None, tmp_path: Path) -> None:
    source, path = tmp_path / "source.usda", tmp_path / "face.usda"
    save_parts(playing(rate=25.0), source)
    if change is not None:
        stage = Usd.Stage.Open(str(source))
        change(stage)
        stage.Save()
    save_parts(load("usd", source, Options()).parts, path)
    times = np.arange(4) / 25
    face = facepipe.open(path)
    assert difference(face, played(path, times).reshape(-1, 3), played(source, times).reshape(-1, 3)) < 1e-6
    assert rates(path) == (25.0, 25.0)
    agrees(path)


@pytest.mark.parametrize("name", [None, "pose"])
def test_an_import_binds_nothing_of_its_own(name: str | None, tmp_path: Path) -> None:
    source, path = tmp_path / "source.usda", tmp_path / "face.usda"
    pose = Animation(name="pose", shapes=("jawOpen",), shape_weights=np.ones((1, 1)))
    save_parts(replace(tiny_face(), animations=(clip("first", 24), pose), played=name), source)
    save_parts(load("usd", source, Options()).parts, path)
    assert bound(path) == name


@pytest.mark.parametrize("flatten", [False, True])
def test_derived_stages_keep_source_and_rate(flatten: bool, tmp_path: Path) -> None:
    source, path = tmp_path / "face.usda", tmp_path / "derived.usda"
    save_parts(playing(rate=60.0), source)
    with facepipe.open(source).deriving(path, flatten=flatten) as face:
        face.prim.SetCustomDataByKey("touched", True)
    assert bound(path) == "second"
    assert rates(path) == (60.0, 60.0)
    agrees(path)


def test_frames_per_second_alone_give_the_rate_of_a_derived_stage(tmp_path: Path) -> None:
    source, path = tmp_path / "face.usda", tmp_path / "derived.usda"
    save_parts(playing(rate=60.0), source)
    stage = Usd.Stage.Open(str(source))
    stage.GetRootLayer().ClearTimeCodesPerSecond()
    stage.Save()
    with facepipe.open(source).deriving(path) as face:
        face.prim.SetCustomDataByKey("touched", True)
    agrees(path)
    assert difference(facepipe.open(path), *(played(one, [0.05])[0] for one in (source, path))) < 1e-6
