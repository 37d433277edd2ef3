"""Trainings of neural rigs with their encoders that are killed, and go on to the same end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import done
from neural_training import FEW_SAMPLES, FEW_STEPS, KilledError, turning_face

import facepipe
from facepipe.core.errors import InputError
from facepipe.neural import (
    Motion,
    SampleMotion,
    TrainEncoder,
    TrainEncoderOptions,
    TrainNeuralRig,
)
from facepipe.neural.train_encoder import KIND
from facepipe.stage import save_parts
from facepipe.verbs.array_file import read_arrays, write_arrays

pytestmark = pytest.mark.needs_torch
ENCODER = TrainEncoderOptions(points=16, encoder_steps=250)
WORDS = ("--spread", 60, "--sweep", 5, "--together", 20, "--width", 8, "--steps", 130)
WORDS += ("--points", 16, "--encoder-steps", 250)


@pytest.fixture(scope="module")
def face(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("face") / "head.usda"
    save_parts(turning_face(), path)
    return path


@pytest.fixture(scope="module")
def motion(face: Path) -> Motion:
    return SampleMotion(options=FEW_SAMPLES)(facepipe.open(face).parts(), str(face))


def killer(step: int) -> Callable[[], None]:
    """Kills at a step."""
    steps = iter(range(1, step + 1))

    def kill() -> None:
        if next(steps) == step:
            raise KilledError

    return kill


@pytest.fixture(scope="module")
def killed(motion: Motion, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The file of a training whose rig is whole and whose encoder was at step 170."""
    path = tmp_path_factory.mktemp("killed") / "head.training"
    TrainNeuralRig(options=FEW_STEPS)(motion, checkpoint=path)
    with pytest.raises(KilledError):
        TrainEncoder(options=ENCODER)(motion, killer(170), path)
    return path.read_bytes()


def test_a_killed_encoder_goes_on_to_the_same_end(motion: Motion, killed: bytes, tmp_path: Path) -> None:
    kept = tmp_path / "head.training"
    kept.write_bytes(killed)
    rig = {name: one for name, one in read_arrays(kept, KIND).arrays.items() if name.startswith("rig.")}
    assert rig
    with pytest.raises(InputError, match=r"head.training: a training of other frames or options \(encoder\)"):
        TrainEncoder(options=replace(ENCODER, seed=1))(motion, checkpoint=kept)
    writes: list[int] = []  # the file's time at each step
    found = TrainEncoder(options=ENCODER)(motion, lambda: writes.append(kept.stat().st_mtime_ns), kept)
    assert len(writes) == found.report.steps == 250
    assert writes[0] == writes[198] < writes[199]  # from step 100 on: those before are counted at once
    whole = TrainEncoder(options=ENCODER)(motion)
    assert found.report == whole.report
    for name in ("point", "token", "places", "reduce", "last", "straight", "offset"):
        assert np.array_equal(getattr(found.encoder, name), getattr(whole.encoder, name))
    after = read_arrays(kept, KIND).arrays
    assert all(np.array_equal(one, after[name]) for name, one in rig.items())
    ended = kept.stat().st_mtime_ns
    assert TrainEncoder(options=ENCODER)(motion, checkpoint=kept).report == whole.report
    assert kept.stat().st_mtime_ns == ended


def test_the_command_goes_on_in_the_encoder(
    face: Path, killed: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept, plot = tmp_path / "head.training", tmp_path / "curve.svg"
    kept.write_bytes(killed)
    words = ("neural-rig", "train", face, *WORDS)
    done(capsys, *words, "-o", tmp_path / "new.fpnr", "--checkpoint", kept, "--plot", plot)
    assert not kept.exists()
    done(capsys, *words, "-o", tmp_path / "whole.fpnr")
    assert (tmp_path / "new.fpnr").read_bytes() == (tmp_path / "whole.fpnr").read_bytes()


def test_files_that_are_no_such_training_are_reported(motion: Motion, killed: bytes, tmp_path: Path) -> None:
    kept = tmp_path / "head.training"
    kept.write_bytes(b"something else")
    with pytest.raises(InputError, match=r"head.training: is no neural rig training"):
        TrainEncoder(options=ENCODER)(motion, checkpoint=kept)
    (tmp_path / "whole.training").write_bytes(killed)
    found = read_arrays(tmp_path / "whole.training", KIND)
    lacking = {name: one for name, one in found.arrays.items() if name != "encoder.numbers"}
    write_arrays(kept, KIND, found.content, lacking)
    with pytest.raises(InputError, match=r"head.training: lacks encoder.numbers, expected a training"):
        TrainEncoder(options=ENCODER)(motion, checkpoint=kept)
