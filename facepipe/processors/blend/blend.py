"""Blends faces of one topology in the gradient domain, with regions, expressions and rig."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from facepipe.core.errors import InputError
from facepipe.core.threads import one_thread
from facepipe.core.tokens import SEAM_RESIDUAL
from facepipe.parts import Recipe
from facepipe.processors.blend.options import BlendOptions
from facepipe.processors.blend.quality import BlendReport, measure
from facepipe.processors.blend.result import result_parts
from facepipe.processors.blend.session import BlendSession
from facepipe.processors.blend.weights import Weights
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes


@dataclass(frozen=True, kw_only=True)
class Blend:
    """Edge vectors of K faces, mixed by region, and the points that fit them best.

    Source: the gradient-domain face blending document, claims 1-10, S601-S606'. Its incidence matrix holds 1 at both
    ends of an edge, which can't satisfy ``M x = D``; here rows hold -1 and +1.

    >>> weights = Weights(regions={"eyes": (0.8, 0.2)})
    >>> with sources[0].deriving("blended.usda") as face:
    ...     report = Blend(weights=weights)(face, sources)

    :raises InputError: weights or options of another type
    """

    weights: Weights = field(default_factory=Weights)
    options: BlendOptions = field(default_factory=BlendOptions)

    def __post_init__(self) -> None:
        for name, value, kind in (("weights", self.weights, Weights), ("options", self.options, BlendOptions)):
            if not isinstance(value, kind):
                raise InputError(f"Blend -> {name}", f"{type(value).__name__}, expected {kind.__name__}(...)")

    @one_thread()
    def __call__(
        self,
        face: Face,
        sources: Sequence[Face] | BlendSession,
        *,
        recipe: Recipe | None = None,
        done: Callable[[], object] = lambda: None,
    ) -> BlendReport:
        """Blend and author the result on `face`, which stands over the first source.

        :param sources: the faces, or a session over them, whose options win
        :param recipe: authored with the result ; without, the result has none, whatever the
            first source has
        :param done: called after every sculpt
        :raises InputError, TopologyError: sources, weights or options that can't be blended; nothing is authored then
        """
        start = time.perf_counter()
        session = sources if isinstance(sources, BlendSession) else BlendSession(sources, self.options, live=False)
        solution = session.solve(self.weights, done)
        report, residual = measure(session, solution)
        parts = replace(result_parts(session, solution), recipe=recipe)
        authored = author_changes(face, parts, primvars={SEAM_RESIDUAL: residual})
        return replace(report, authored=authored, seconds=time.perf_counter() - start)
