"""Splits of composites of actors whose own shapes are known."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from scan_actors import COMPOSITES, Actor, ict
from smooth_fields import smooth_field

from facepipe.geometry.example_rigging import split_shapes

ERROR = 0.2  # mm, mean over the face
KINDS = {"exact": 0.5, "smooth": 0.65, "white": 0.65}  # largest ratio of errors: personal over generic transfer


@dataclass(frozen=True)
class Known:
    neutral: np.ndarray
    generic: np.ndarray  # (53, n, 3) transferred deltas
    own: np.ndarray  # (53, n, 3) the truth

    def errors(self, deltas: np.ndarray) -> np.ndarray:
        """(53,) mm, mean over the face."""
        face = slice(0, ict().full_face)
        return np.asarray(np.linalg.norm(deltas[:, face] - self.own[:, face], axis=2).mean(axis=1))


@functools.lru_cache(maxsize=1)
def known(seed: int) -> Known:
    actor, names = Actor(seed), ict().names
    return Known(
        actor.neutral,
        np.stack([actor.transferred(name) for name in names]),
        np.stack([actor.shape(name) for name in names]),
    )


def weights() -> np.ndarray:
    return np.array([[shown.get(name, 0.0) for name in ict().names] for shown in COMPOSITES.values()])


def composites(actor: Known, kind: str, seed: int) -> np.ndarray:
    """(15, n, 3): exact, or with an error of 0.2 mm mean over the face, as smooth as those of registration or white."""
    points = actor.neutral + np.tensordot(weights(), actor.own, axes=1)
    rng = np.random.default_rng([seed, 9])
    for one in points:
        if kind != "exact":
            added = smooth_field(ict().neutral, 60.0, 3, rng) if kind == "smooth" else rng.standard_normal(one.shape)
            one += added * ERROR / np.linalg.norm(added[: ict().full_face], axis=1).mean()
    return points


def whole(actor: Known) -> dict[str, Any]:
    """Scans without holes, no stiff piece."""
    count = len(actor.neutral)
    return {"point_weights": np.ones((len(COMPOSITES), count)), "stiff": np.full(count, -1), "names": ict().names}


def ratios(seed: int, kind: str) -> tuple[float, float, int]:
    """Summed error over that of the generic shapes, of all shapes and of the excited ones, and how many are worse."""
    actor = known(seed)
    found = split_shapes(
        actor.neutral, actor.generic, composites(actor, kind, seed), weights(), ict().triangles, **whole(actor)
    )
    own, generic, excited = actor.errors(found.deltas), actor.errors(actor.generic), weights().any(axis=0)
    assert (found.deltas[~excited] == actor.generic[~excited]).all()
    return (
        own.sum() / generic.sum(),
        own[excited].sum() / generic[excited].sum(),
        int((own > generic * (1.0 + 1e-9)).sum()),
    )
