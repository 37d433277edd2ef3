"""Examples of a rig: what its controls were set to, and where the points went."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray, require_finite
from facepipe.core.errors import InputError, TopologyError
from facepipe.processors.database import Topology
from facepipe.rig import Rig
from facepipe.rig.neural_rig import Control

_OUTSIDE = 1e-6  # of a control's range: what rounding may take a value beyond its limits


@dataclass(frozen=True, kw_only=True)
class Motion:
    """f frames of c controls and n whole points; frames of one block follow one another, and are kept together.

    :raises InputError: no frame, NaN or infinity, values out of a control's range, or two controls of one name
    :raises TopologyError: numbers of frames, controls or points that don't fit
    """

    where: str
    topology: Topology
    controls: tuple[Control, ...]
    values: FloatArray  # (f, c)
    points: FloatArray  # (f, n, 3) millimetres
    rest: FloatArray  # (n, 3) millimetres, of all controls at their defaults
    blocks: IntArray  # (f,)
    bones: Rig | None = None  # in millimetres, without shapes; None: nothing is known of joints
    coefficients: FloatArray | None = None  # (f, j, 9) of the bones, translations in millimetres
    source: str = "rig"  # of the frames: facepipe's own rig, "rig and clips", or "samples" of a stage
    between: int = 0  # other frames, left out where clips were cut into blocks
    warnings: tuple[str, ...] = ()  # on what of them was left out

    def __post_init__(self) -> None:
        self._check_sizes()
        names = [control.name for control in self.controls]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InputError(f"{self.where} -> {twice}", "two controls of this name, expected one")
        for values, what in ((self.values, "controls"), (self.points, "points"), (self.rest, "rest")):
            require_finite(values, self.where, what)
        if self.coefficients is not None:
            require_finite(self.coefficients, self.where, "bone coefficients")
        for number, control in enumerate(self.controls):
            _check_range(self.where, control, self.values[:, number])

    def _check_sizes(self) -> None:
        frames, count = len(self.values), self.topology.point_count
        if not frames or not self.controls:
            raise InputError(self.where, f"{frames} frames of {len(self.controls)} controls, expected some")
        for what, values, shape in (
            ("controls", self.values, (frames, len(self.controls))),
            ("points", self.points, (frames, count, 3)),
            ("rest", self.rest, (count, 3)),
            ("blocks", self.blocks, (frames,)),
            *self._bone_sizes(frames),
        ):
            if values is None or values.shape != shape:
                found = None if values is None else values.shape
                raise TopologyError(f"{self.where} -> {what}", f"shape {found}, expected {shape}")

    def _bone_sizes(self, frames: int) -> list[tuple[str, FloatArray | None, tuple[int, ...]]]:
        joints = () if self.bones is None else (frames, len(self.bones.joints), 9)
        return [("bone coefficients", self.coefficients, joints)] if joints or self.coefficients is not None else []

    def morphed(self, frame: int) -> FloatArray:
        """(n, 3) points of a frame before its bones moved them; those of the frame itself where there are none."""
        points = np.asarray(self.points[frame], dtype=np.float64)
        if self.bones is None or self.coefficients is None:
            return points
        local = self.bones.local_transforms(self.coefficients[frame])
        return self.bones.unskin(points, self.bones.skinning_matrices(local))

    @property
    def constant(self) -> tuple[str, ...]:
        """Controls that no frame moves: nothing can be learned of them."""
        still = np.ptp(self.values, axis=0) == 0.0
        return tuple(control.name for control, one in zip(self.controls, still, strict=True) if one)

    def without(self, names: Sequence[str]) -> Motion:
        """The same without some controls."""
        kept = [number for number, control in enumerate(self.controls) if control.name not in names]
        return replace(self, controls=tuple(self.controls[number] for number in kept), values=self.values[:, kept])

    def frames(self, chosen: IntArray) -> Motion:
        """Some of the frames."""
        coefficients = None if self.coefficients is None else self.coefficients[chosen]
        return replace(
            self,
            values=self.values[chosen],
            points=self.points[chosen],
            blocks=self.blocks[chosen],
            coefficients=coefficients,
        )

    def split(self, held_out: float, seed: int) -> tuple[Motion, Motion]:
        """Frames to learn from, and about a share `held_out` of them to check on: whole blocks, drawn by `seed`.

        Neighbouring frames of a clip are nearly the same; held out one by one, they would have been learned.

        :raises InputError: a single block
        """
        blocks = np.random.default_rng(seed).permutation(np.unique(self.blocks))
        if len(blocks) < 2:
            raise InputError(self.where, "one block of frames, expected two or more: one to learn from, one to check")
        sizes = np.array([np.count_nonzero(self.blocks == block) for block in blocks])
        taken = int(np.searchsorted(np.cumsum(sizes), held_out * sizes.sum(), side="right"))
        checked = np.isin(self.blocks, blocks[: min(max(taken, 1), len(blocks) - 1)])
        return self.frames(np.flatnonzero(~checked)), self.frames(np.flatnonzero(checked))


def _check_range(where: str, control: Control, values: FloatArray) -> None:
    low, high = control.minimum, control.maximum
    if not low < high:
        raise InputError(f"{where} -> {control.name}", f"from {low:g} to {high:g}, expected a range")
    room = _OUTSIDE * (high - low)
    out = np.flatnonzero((values < low - room) | (values > high + room))
    if len(out):
        what = f"{values[out[0]]:g} in frame {out[0]}, expected {low:g} to {high:g}"
        raise InputError(f"{where} -> {control.name}", what)
