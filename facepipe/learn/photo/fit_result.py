"""What a descent found, in the words of the face."""

from __future__ import annotations

import numpy as np
import torch

from facepipe.core.arrays import FloatArray
from facepipe.learn.key_light import DARK
from facepipe.learn.photo.descent import Descent
from facepipe.learn.photo.joint_loss import JointLoss
from facepipe.learn.photo.landmark_fit import State
from facepipe.learn.photo.result import FittedCamera, FittedView, PhotoFit
from facepipe.learn.photo.unknowns import Unknowns

_NOT_FINITE = "the loss was not finite at step {}: the best of the steps before is kept"


def fit_result(loss: JointLoss, descent: Descent) -> PhotoFit:
    """The best of a descent as sliders, expressions, cameras and light."""
    subject, best = loss.fit.subject, descent.best
    state = best.state()
    values = np.asarray(subject.slider_values(state.shares), dtype=np.float32)
    names = loss.model.colors.names
    warnings = () if descent.stopped != "not-finite" else (_NOT_FINITE.format(len(descent.history) - 1),)
    return PhotoFit(
        sliders={subject.parts.sliders[i].name: float(values[i]) for i in subject.sliders},
        views=tuple(_view(loss, best, state, view) for view in range(len(loss.photos))),
        tint={name: _color(factor) for name, factor in zip(names, best.tint.exp(), strict=True) if name},
        history=descent.history,
        kept=descent.kept,
        steps=max(len(descent.history) - 1, 0),
        stopped=descent.stopped,
        warnings=warnings,
    )


def _view(loss: JointLoss, best: Unknowns, state: State, view: int) -> FittedView:
    fit = loss.fit
    camera = fit.spaces[view].camera(torch.as_tensor(state.poses[view]))
    shapes = fit.subject.rig.shapes
    weights = zip(fit.subject.expressions, state.expressions[view], strict=True)
    return FittedView(
        expressions={shapes[i]: float(np.float32(weight)) for i, weight in weights},
        camera=FittedCamera(
            rotation=camera.rotation.numpy(),
            translation=camera.translation.numpy(),
            focal=float(camera.focal),
            center=(float(camera.center[0]), float(camera.center[1])),
        ),
        light=best.light[view].numpy().astype(np.float64),
        key=_lamp(best.key[view].numpy().astype(np.float64)),
        landmarks=fit.landmarks(state)[view],
        targets=fit.targets[view],
        landmark_error=float(fit.errors(state)[view].mean()),
    )


def _lamp(key: FloatArray) -> FloatArray:
    """(8,) as `KeyLight` takes it: a unit direction, colour and shine of 0 or more."""
    length = float(np.linalg.norm(key[:3]))
    if not length > 0:
        return np.array(DARK)
    return np.concatenate([key[:3] / length, np.maximum(key[3:7], 0.0), key[7:]])


def _color(factor: torch.Tensor) -> tuple[float, float, float]:
    red, green, blue = map(float, factor)
    return red, green, blue
