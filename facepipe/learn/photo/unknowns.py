"""What gradient descent moves, as tensors with gradients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from facepipe.learn.light import DARK
from facepipe.learn.photo.landmark_fit import State


@dataclass(frozen=True, kw_only=True)
class Unknowns:
    """Sliders alpha, expressions beta and what makes up the camera parameters p ([0120]), of v photos."""

    shares: Tensor  # (f,) 0..1 of the free sliders' ranges
    expressions: Tensor  # (v, e) 0..1
    poses: Tensor  # (v, 7) as `PoseSpace`
    light: Tensor  # (v, 9, 3)
    key: Tensor  # (v, 8) as `KeyLight`
    tint: Tensor  # (materials, 3) logarithms of factors

    @classmethod
    def from_state(
        cls, state: State, light: Sequence[Tensor], tint: Tensor, key: Sequence[Tensor] | None = None
    ) -> Unknowns:
        """Free tensors in float32, poses in float64.

        :param key: None: no lamps
        """
        numbers = {
            "shares": torch.as_tensor(state.shares, dtype=torch.float32),
            "expressions": torch.as_tensor(state.expressions, dtype=torch.float32),
            "poses": torch.as_tensor(state.poses, dtype=torch.float64),
            "light": torch.stack(list(light)),
            "key": torch.stack(list(key) if key is not None else [torch.tensor(DARK)] * len(light)),
            "tint": tint,
        }
        return cls(**{name: value.detach().clone().requires_grad_() for name, value in numbers.items()})

    @classmethod
    def names(cls) -> list[str]:
        """What they are called, in order."""
        return [field.name for field in fields(cls)]

    def tensors(self) -> list[Tensor]:
        """All of them, in order."""
        return [getattr(self, name) for name in self.names()]

    def copy(self) -> Unknowns:
        """The same values, held."""
        return Unknowns(**{field.name: getattr(self, field.name).detach().clone() for field in fields(self)})

    def clamp(self) -> None:
        """Put sliders and expressions back into their ranges, and lamps to no less than nothing."""
        with torch.no_grad():
            self.key[:, 3:7].clamp_(min=0)
            self.shares.clamp_(0, 1)
            self.expressions.clamp_(0, 1)

    def state(self) -> State:
        """As numbers, what stage one seeks."""
        shares, expressions, poses = (
            one.detach().numpy().astype(np.float64) for one in (self.shares, self.expressions, self.poses)
        )
        return State(shares=shares, expressions=expressions, poses=poses)
