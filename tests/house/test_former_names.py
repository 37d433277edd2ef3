"""What docs and samples of version 0.1.0 import is there, and says where it went."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

# every import of a module of then in docs and samples whose module has moved
IMPORTS = {
    "facepipe.core.trust": "Trust, trusting",
    "facepipe.photo_options": "PhotoFitOptions",
    "facepipe.processors.animate": "AnimateFace, AnimateOptions, read_performance",
    "facepipe.processors.blend": "Blend, BlendFaces, BlendSession, Weights, match",
    "facepipe.processors.blend.graph": "mix",
    "facepipe.processors.bone_payload": "PayloadReport, write_payload",
    "facepipe.processors.clean_scan": "CleanScan",
    "facepipe.processors.database": "WholeFace, create_database, load_database, save_database, whole_face",
    "facepipe.processors.fit_bones": "BoneFit, FitBones, FitBonesReport, LimitRules, Target, read_limits, read_targets",
    "facepipe.processors.neural_rig": (
        "InvertNeuralRig, InvertNeuralRigOptions, SampleMotion, TrainNeuralRig, load_encoder, load_neural_rig, "
        "save_neural_rig"
    ),
    "facepipe.processors.photo_fit": "read_landmarks, read_photo",
    "facepipe.processors.rebuild": "FitNeutral, FitNeutralOptions, Template",
    "facepipe.processors.rebuild.author_neutral": "AuthorNeutral",
    "facepipe.processors.skin": "SkinFace, SkinOptions, SkinReport, read_joints",
    "facepipe.processors.skin.from_face": "from_face",
    "facepipe.processors.skin.surface": "Surface, surface_of",
    "facepipe.processors.sliders": "SetSliders, SlidersFromShapes",
}
WITH_TORCH = {
    "facepipe.learn.features.crops": "sample_crop",
    "facepipe.learn.features.extractor": "load_extractor",
    "facepipe.learn.photo.amortised.guess": "load_start",
    "facepipe.learn.photo.fit": "fit_photos, pose_space",
    "facepipe.learn.photo.subject": "Subject",
}


def check(module: str, names: str) -> None:
    for name in names.split(", "):
        with pytest.warns(DeprecationWarning, match=rf"^{module} is facepipe\.\S+ now") as said:
            exec(f"from {module} import {name}", found := {})
        (now,) = {str(one.message).split()[2] for one in said}
        assert found[name] is getattr(importlib.import_module(now), name)
        assert {one.filename for one in said} == {"<string>"}  # it points at who imports


@pytest.mark.parametrize(("module", "names"), IMPORTS.items(), ids=lambda one: str(one).partition(",")[0])
def test_what_docs_imported_is_there(module: str, names: str) -> None:
    check(module, names)


@pytest.mark.needs_torch
@pytest.mark.parametrize(("module", "names"), WITH_TORCH.items(), ids=lambda one: str(one).partition(",")[0])
def test_what_docs_imported_of_torch_is_there(module: str, names: str) -> None:
    check(module, names)


@pytest.mark.parametrize(
    "name",
    [
        "facepipe.processors.blends",
        pytest.param("facepipe.learn.photo.fits", marks=pytest.mark.needs_torch),
        "facepipe.photo_option",
    ],
)
def test_what_was_never_there_is_not(name: str) -> None:
    with pytest.raises(ModuleNotFoundError, match=f"No module named '{name}'"):
        importlib.import_module(name)


def test_nothing_of_ours_uses_them() -> None:
    program = "import sys, facepipe, facepipe.cli; facepipe.blend; print([n for n in sys.modules if 'processors' in n])"
    words = [sys.executable, "-W", "error::DeprecationWarning", "-c", program]
    assert subprocess.run(words, capture_output=True, text=True, check=True).stdout == "[]\n"
