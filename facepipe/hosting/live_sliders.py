"""A face whose sliders move: read once, then its points, or its person as a payload, for any values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import unknown
from facepipe.parts import FaceParts, Slider
from facepipe.rig import Rig, build, set_points
from facepipe.rig.identity import with_identity
from facepipe.rig.sliders import mode_weights, slide
from facepipe.stage import Face, open_face
from facepipe.verbs.whole_faces import MILLIMETRES, whole_points, world_to_world

if TYPE_CHECKING:
    from facepipe.payload.person_rig import PersonRig
    from facepipe.verbs.person_basis import Basis
    from facepipe.verbs.person_neutral import Beside

_MM = 1e3  # of a metre


class LiveSliders:
    """The sliders of a face stage; values that are not given are those authored there.

    Offsets have what modes do added. The command, and a payload as it writes one, fit lids, joints and cards of hair to
    the new neutral too, half a second: skin, eyes and teeth are the same, hair goes with the skin next to it.
    """

    def __init__(self, path: Path) -> None:
        """:raises SchemaError: a stage without a face"""
        self._face: Face = open_face(path)
        self._where = str(path)
        parts = with_identity(self.base)
        self._rig = build(parts)
        # of the authored neutral, where modes do nothing more
        self._over = tuple(replace(one, modes=()) for one in self.sliders)
        self._authored = mode_weights(self.sliders)
        self._identified: tuple[Mapping[int, float], FaceParts, Rig] = (self._authored, parts, self._rig)

    @cached_property
    def base(self) -> FaceParts:
        """The face as it is authored."""
        return self._face.parts()

    @cached_property
    def _bare(self) -> FaceParts:
        """The face without hair and whatever else no payload has, which would go with its points."""
        names = self._basis.topology.names
        return replace(self.base, meshes=tuple(mesh for mesh in self.base.meshes if mesh.name in names))

    @property
    def sliders(self) -> tuple[Slider, ...]:
        """All sliders of the face."""
        return self._face.sliders

    @cached_property
    def _start(self) -> FloatArray:
        return self._points({})

    def offsets(self, values: Mapping[str, float]) -> FloatArray:
        """(n, 3) millimetres in glTF space from the points that the face is set to, meshes one after another.

        :param values: by slider
        :raises InputError: no such slider, or a value out of its range
        """
        turn = self.base.gltf_axes[:3, :3]
        return (self._points(self._checked(values)) - self._start) @ turn.T * _MM

    def payload(self, values: Mapping[str, float]) -> bytes:
        """The person that the values make, as `facepipe person` writes it.

        :raises InputError: as `offsets` does, or a face without a basis
        """
        from facepipe.verbs.person import encoded_whole

        values = self._checked(values)
        modes = mode_weights(self.sliders, values)
        if modes != self._identified[0]:
            parts = with_identity(self._bare, values)  # which takes twice as long as all else
            self._identified = modes, parts, build(parts)
        _, own, rig = self._identified
        sliders = tuple(replace(one, value=values.get(one.name, one.value)) for one in own.sliders)
        whole = whole_points(
            self._basis.known(set_points(replace(own, sliders=sliders, person=None), rig), self._where)
        )
        return encoded_whole(self._basis, whole, self._where, rig=self._own_rig)[0]

    def _points(self, values: Mapping[str, float]) -> FloatArray:
        """(n, 3) world points of the stage."""
        own, weights = self._driven(values)
        points = self._rig.evaluate(weights, coefficients=own)
        modes = mode_weights(self.sliders, values)
        numbers = modes.keys() | self._authored.keys()
        change = {mode: modes.get(mode, 0.0) - self._authored.get(mode, 0.0) for mode in sorted(numbers)}
        change = {mode: amount for mode, amount in change.items() if amount}
        return points + self._moves(change) if change else points

    def _driven(self, values: Mapping[str, float]) -> tuple[FloatArray, dict[str, float]]:
        """Bone coefficients (j, 9) and shape weights.

        What sliders do adds up: those that are not given need no second look, of 400 that takes 15 ms.
        """
        joints, network = self.base.skeleton.joints, self.base.slider_network
        if network is not None:
            return slide(self._over, joints, values, network)
        moved = tuple(one for one in self._over if one.name in values)
        (own, driven), (now, more), (before, less) = self._set, slide(moved, joints, values), slide(moved, joints)
        changed = {name: driven.get(name, 0.0) + more[name] - less[name] for name in more}
        return own + now - before, {**driven, **changed}

    @cached_property
    def _set(self) -> tuple[FloatArray, dict[str, float]]:
        return slide(self._over, self.base.skeleton.joints)

    def _moves(self, modes: Mapping[int, float]) -> FloatArray:
        """(n, 3) how points go with modes, in the world of the stage."""
        from facepipe.verbs.person_neutral import mode_moves

        moves = self._beside.of_all(mode_moves(self._basis, modes, self._where))
        return moves @ np.linalg.inv(self._to_whole)[:3, :3].T

    @cached_property
    def _basis(self) -> Basis:
        """:raises InputError: a face that is on none"""
        from facepipe.verbs.person_basis import basis_of

        return basis_of(self.base, self._where)

    @cached_property
    def _own_rig(self) -> PersonRig | None:
        from facepipe.verbs.person_basis import head_basis
        from facepipe.verbs.person_rig import rig_of

        return rig_of(self.base) if self._basis is head_basis() else None

    @cached_property
    def _beside(self) -> Beside:
        from facepipe.verbs.person_neutral import Beside

        return Beside.of(self.base, self._basis)

    @cached_property
    def _to_whole(self) -> FloatArray:
        return world_to_world(self.base.meters_per_unit, self.base.up_axis, MILLIMETRES)

    def _checked(self, values: Mapping[str, float]) -> Mapping[str, float]:
        known = {slider.name: slider for slider in self.sliders}
        for name, value in values.items():
            if name not in known:
                raise InputError("sliders", unknown(name, known, "slider"))
            low, high = known[name].minimum, known[name].maximum
            if not (isinstance(value, int | float) and low <= value <= high):  # NaN too
                raise InputError(f"slider {name}", f"value {str(value)[:20]}, expected {low:g} to {high:g}")
        return values
