"""One fit to one portrait of a known person, timed and measured."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import support_modules  # noqa: F401  (finds the modules of tests/support)
from recovery_measures import Recovery, recovery
from recovery_targets import RecoveryTarget, sample, target

from facepipe.photo.descent.fit import fit_photos
from facepipe.photo.options import PhotoFitOptions


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """What became of a target."""

    number: int
    figures: Recovery
    seconds: float  # wall time of the fit alone
    processor: float  # of all threads
    steps: int
    stopped: str
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Task:
    """A target to make and to fit."""

    number: int
    seed: int
    size: int = 256
    expressions: bool = True
    sparse: bool = True  # False: neither sliders nor expressions are drawn to their defaults by L1 terms
    noise: float = 1.0
    iterations: int | None = None  # None: the default
    networks: bool = True  # False: no terms of feature networks


def run(task: Task) -> Fitted:
    """Make the portrait and fit it."""
    made = target(task.number, task.seed, size=task.size, expressions=task.expressions, noise=task.noise)
    options = PhotoFitOptions()
    if not task.sparse:
        options = replace(options, sparsity=0.0, expression_sparsity=0.0)
    if not task.networks:
        options = replace(options, content=0.0, identity=0.0, attributes=0.0)
    if task.iterations is not None:
        options = replace(options, iterations=task.iterations)
    return fitted(made, options)


def fitted(made: RecoveryTarget, options: PhotoFitOptions | None = None) -> Fitted:
    """Fit a portrait from nothing but its image and noisy landmarks."""
    face = sample()
    image = made.image.astype(np.float32) / 255
    began = time.perf_counter(), time.process_time()
    options = options or PhotoFitOptions()
    none = None if options.content or options.identity or options.attributes else {}
    fit = fit_photos(face.parts, [image], [made.landmarks], options, extractors=none)
    seconds, processor = time.perf_counter() - began[0], time.process_time() - began[1]
    return Fitted(
        number=made.number,
        figures=recovery(face.parts, face.rig, made, fit),
        seconds=seconds,
        processor=processor,
        steps=fit.steps,
        stopped=fit.stopped,
        warnings=fit.warnings,
    )
