"""The sessions that fit one face: one for each set of points that targets know."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray
from facepipe.processors.fit_bones.half_scales import HalfScales
from facepipe.processors.fit_bones.options import FitBonesOptions
from facepipe.processors.fit_bones.session import BoneFit
from facepipe.rig import Rig

STRICTER = 0.99  # of the threshold: what solves stop at leaves room for the rounding of what is authored


@dataclass(frozen=True)
class Session:
    """A session, with what it starts from."""

    fit: BoneFit
    start: FloatArray  # (m, 9) inside its limits

    @cached_property
    def counts(self) -> npt.NDArray[np.bool_]:
        """(n,) points that count."""
        return np.asarray(self.fit.weights > 0)

    @cached_property
    def half_scales(self) -> HalfScales:
        """For poses that get a residual."""
        return HalfScales(self.fit)


class Sessions:
    """Sessions over one rig, made where they are needed.

    :param lower: (m, 9) limits
    :param upper: (m, 9)
    :param weights: (n,) of points
    :param initial: (m, 9) to start from
    :param mm: millimetres in a stage unit
    """

    def __init__(
        self,
        rig: Rig,
        options: FitBonesOptions,
        *,
        lower: FloatArray,
        upper: FloatArray,
        weights: FloatArray,
        initial: FloatArray,
        mm: float,
    ) -> None:
        self._rig, self._options, self._mm = rig, options, mm
        self._lower, self._upper, self._weights, self._initial = lower, upper, weights, initial
        self._made: dict[bytes, Session] = {}

    def of(self, known: npt.NDArray[np.bool_] | None) -> Session:
        """The session whose points count where a target knows them.

        :raises InputError: limits or joints that a symmetric fit can't have
        """
        key = b"" if known is None or known.all() else np.packbits(known).tobytes()
        if key not in self._made:
            self._made[key] = self._session(self._weights if known is None else self._weights * known)
        return self._made[key]

    def _session(self, weights: FloatArray) -> Session:
        options = self._options
        fit = BoneFit(
            self._rig,
            lower=self._lower,
            upper=self._upper,
            weights=weights,
            threshold=STRICTER * options.threshold_mm / self._mm,
            steps=options.max_iterations,
            rounds=options.evening,
            regularise=options.regularise,
            sparsity=options.sparsity,
            symmetric=options.symmetric,
        )
        return Session(fit, np.clip(self._initial, fit.lower, fit.upper))
