"""Where to start a photo fit, by a network that `facepipe train-photo` made ([0180])."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.networks.onnx_file import onnx_session, properties, read_model
from facepipe.photo.amortised.network import COUNT, KEY, KIND, SIZE, controls
from facepipe.photo.amortised.pictures import Picture
from facepipe.photo.descent.landmark_fit import State
from facepipe.photo.descent.subject import NUMBERS, PoseSpace, Subject
from facepipe.photo.features.onnx_module import OnnxModule

_OTHER = "other inputs or outputs, expected those of `facepipe train-photo`"


@dataclass(frozen=True, kw_only=True)
class Guess:
    """A network of one subject in onnxruntime."""

    path: Path
    subject: Subject
    metadata: Mapping[str, Any]
    sliders: IntArray  # (f,) which of the file's each of the subject's is
    expressions: IntArray  # (e,)
    session: Any = field(repr=False)

    def __call__(self, photo: FloatArray, landmarks: FloatArray, space: PoseSpace) -> State:
        """Sliders, expression and pose of the person in a photo (h, w, 3) sRGB 0..1 with landmarks (68, 2).

        :raises InputError: landmarks that are nothing like a face's, or a network that gives no numbers
        """
        crop = Picture.from_photo(photo, landmarks, space).crop(landmarks)
        fed = {"image": crop.image.numpy()[None], "landmarks": crop.landmarks.numpy()[None]}
        names = [output.name for output in self.session.get_outputs()]
        values = [np.asarray(one[0], np.float64) for one in self.session.run(None, fed)]
        if not all(np.isfinite(value).all() for value in values):
            raise InputError(self.path, "gives NaN or infinity, expected numbers")
        outputs = dict(zip(names, values, strict=True))
        poses = crop.space(space, self.subject.parts.up_axis)
        pose = poses.to_photo(torch.as_tensor(outputs["pose"])).numpy()
        return State(
            shares=outputs["shares"][self.sliders],
            expressions=outputs.get("expressions", np.zeros(0))[self.expressions][None],
            poses=pose[None],
        )

    def together(
        self, photos: Sequence[FloatArray], landmarks: Sequence[FloatArray], spaces: Sequence[PoseSpace]
    ) -> State:
        """One person in several photos: the mean of the sliders, each photo's own expression and pose."""
        guesses = [self(*each) for each in zip(photos, landmarks, spaces, strict=True)]
        return State(
            shares=np.mean([guess.shares for guess in guesses], axis=0),
            expressions=np.concatenate([guess.expressions for guess in guesses]),
            poses=np.concatenate([guess.poses for guess in guesses]),
        )


def load_start(path: Path, subject: Subject) -> Guess:
    """The network in a file. Sliders and expressions go by their names: files of a face may order them otherwise.

    :raises InputError: no such network, a damaged one, or one of a face with other sliders or expressions
    """
    model = read_model(path)
    try:
        metadata = json.loads(properties(model).get(KEY, ""))
    except json.JSONDecodeError:
        metadata = None
    if not isinstance(metadata, dict) or metadata.get("kind") != KIND:
        raise InputError(path, f"no metadata '{KEY}', expected a network of `facepipe train-photo`")
    expected = controls(subject)
    if metadata.get("up_axis") != expected["up_axis"]:
        raise InputError(path, f"made for a face with another up axis, expected {expected['up_axis']}")
    # run it in torch, which counts what its nodes make beforehand: onnxruntime folds constants as it loads
    module = OnnxModule(model, None, path)
    zeros = {"image": torch.zeros(1, 3, SIZE, SIZE), "landmarks": torch.zeros(1, COUNT, 2)}
    if set(module.inputs) != set(zeros):
        raise InputError(path, _OTHER)
    with torch.no_grad():
        module(*[zeros[name] for name in module.inputs])
    try:
        session = onnx_session(model.SerializeToString())
    except Exception as error:  # onnxruntime's own classes share no other base
        raise InputError(path, f"can't be run: {str(error)[:120]}") from None
    guess = Guess(
        path=path,
        subject=subject,
        metadata=metadata,
        sliders=_places(path, "slider", metadata.get("sliders"), expected["sliders"]),
        expressions=_places(path, "expression", metadata.get("expressions"), expected["expressions"]),
        session=session,
    )
    counts = {"shares": len(subject.sliders), "expressions": len(subject.expressions), "pose": NUMBERS}
    inputs = {one.name: tuple(one.shape[1:]) for one in guess.session.get_inputs()}
    outputs = {output.name: output.shape[-1] for output in guess.session.get_outputs()}
    given = {"image": (3, SIZE, SIZE), "landmarks": (COUNT, 2)}
    if inputs != given or outputs != {name: count for name, count in counts.items() if count}:
        raise InputError(path, _OTHER)
    return guess


def _places(path: Path, kind: str, theirs: Any, controls: list[Any]) -> IntArray:
    """Where the file has each of the subject's own controls.

    :raises InputError: the file has others
    """
    if not isinstance(theirs, list):
        raise InputError(path, f"damaged metadata, expected a list of {kind}s")
    names = [one["name"] if isinstance(one, dict) else one for one in controls]
    for control, name in zip(controls, names, strict=True):
        if control not in theirs:
            raise InputError(path, f"made for another face: without {kind} {name} as this one has it")
    if len(theirs) != len(controls):
        raise InputError(
            path, f"made for another face: {len(theirs)} {kind}s, expected the {len(controls)} of this one"
        )
    return np.array([theirs.index(one) for one in controls], dtype=np.int64)
