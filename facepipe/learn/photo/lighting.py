"""The light that photos show on a face of known shape: harmonics, a lamp, shadows, tints of the face's colours."""

from __future__ import annotations

import torch
from torch import Tensor

from facepipe.learn.key_light import DARK
from facepipe.learn.light import basis
from facepipe.learn.photo.find_key import find_key
from facepipe.learn.photo.joint_loss import JointLoss, single
from facepipe.learn.photo.landmark_fit import State
from facepipe.learn.photo.relight import relight
from facepipe.learn.photo.seen_surface import SeenSurface
from facepipe.learn.photo.shadows import Shadows, shadows_of_harmonics, shadows_of_lamp
from facepipe.learn.photo.unknowns import Unknowns


def lit(loss: JointLoss, state: State) -> Unknowns:
    """The unknowns of a state in the light that its photos show, with the shadows that the face casts on itself."""
    found = [_of_photo(loss, state, view) for view in range(len(loss.photos))]
    lights, keys, tints = zip(*found, strict=True)
    return Unknowns.of(state, lights, torch.stack(tints).mean(dim=0), keys)


def renew_shadows(loss: JointLoss, at: Unknowns) -> None:
    """The shadows of the face as it is by now."""
    with torch.no_grad():
        for view in range(len(loss.photos)):
            points = loss.model.rig(loss.sliders(at.shares), loss.weights(at.expressions[view]))
            loss.shadows[view] = Shadows.of(loss.model, points, loss.look(at, view).camera, at.key[view])


def _of_photo(loss: JointLoss, state: State, view: int) -> tuple[Tensor, Tensor, Tensor]:
    """Light (9, 3), lamp (8,) and logarithms of tints (materials, 3)."""
    model, photo = loss.model, loss.photos[view]
    with torch.no_grad():
        sliders = loss.sliders(torch.as_tensor(state.shares, dtype=torch.float32))
        weights = loss.weights(torch.as_tensor(state.expressions[view], dtype=torch.float32))
        camera = single(photo.camera(loss.fit.spaces[view].camera(torch.as_tensor(state.poses[view]))))
        points, count = model.rig(sliders, weights), len(model.colors.names)
        surface = SeenSurface.of(model, points, camera, photo.size)
        seen = photo.linear.reshape(-1, 3)[surface.raster.pixels]
        transfer, key = shadows_of_harmonics(model, points, camera), photo.linear.new_tensor(DARK)
        shape = basis(surface.normals) + surface.at_pixels(transfer)
        light, tint = relight(surface, seen, shape, count)
        lamp = find_key(surface, camera.to_camera(points), seen, shape, surface.colors * tint[surface.materials])
        key = key if lamp is None else lamp
        arriving = shadows_of_lamp(model, points, camera, key)
        loss.shadows[view] = Shadows(transfer=transfer, arriving=arriving)
        if lamp is not None:
            column = (surface.normals @ lamp[:3]).clamp(min=0) * surface.at_pixels(arriving)
            light, tint = relight(surface, seen, torch.cat([shape, column[:, None]], dim=1), count)
            key[3:6] = light[9].clamp(min=0)
        return light[:9], key, tint.log()
