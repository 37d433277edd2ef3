"""The actor's own shapes from registered expressions (document S16), and how these are read from face stages.

Splitting begins with the weights given, and finds them anew beside the shapes: those that registration found hold how
much more or less than the template the person moves, which is the shapes' own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError, SchemaError, TopologyError
from facepipe.core.names import suggestion
from facepipe.core.threads import one_thread
from facepipe.core.tokens import SCANNED
from facepipe.geometry.example_rigging import Split, SplitOptions, split_shapes
from facepipe.geometry.polygons import flipped_triangles
from facepipe.scanning.rebuild.declared import Judged, SplitExpressionsOptions
from facepipe.scanning.rebuild.register_scans import Composite
from facepipe.scanning.rebuild.template import Template, resolved
from facepipe.stage import open_face
from facepipe.stage.recipes import recipe_of, source_digest
from facepipe.verbs.whole_faces import WholeFace, whole_face

_SAME_MM = 0.01  # neutrals that differ by less are one
_OBSERVED = 0.05  # shapes seen less than this may stay as the template has them
# And these do, if what was found is no more than what registered expressions are off by (mm, mean): with them 3 of 371
# shapes of seven simulated people were worse than the template's, without none.
_HARDLY, _SLIGHT_MM = 0.2, 0.25
_USUAL = SplitExpressionsOptions()


def read_expression(path: Path, personal: Path, base: WholeFace) -> tuple[str, Composite, tuple[str, ...]]:
    """The expression that `facepipe register-scan` has left in `path`, to be split over `base`: its shape's name, what
    it is, and warnings.

    :param personal: file of the personal template, whose face is `base`
    :raises InputError: no file, none of `facepipe register-scan`, or one over another neutral
    :raises TopologyError: other meshes or faces
    :raises SchemaError: a damaged recipe, or no shape of its name
    """
    (recipe, _), where = recipe_of(path, "register-scan"), f"{path} -> recipe"
    options = recipe.options if isinstance(recipe.options, Mapping) else {}
    name, asked = options.get("name"), options.get("weights")
    if not isinstance(name, str) or not isinstance(asked, Mapping) or not asked:
        raise SchemaError(where, "expected the expression's name and weights")
    for shape, weight in asked.items():
        if not isinstance(weight, int | float) or not abs(weight) < 1e300:  # NaN fails, and integers beyond any float
            raise SchemaError(f"{where} -> weights -> {shape}", f"{weight!r:.40}, expected a finite number")
    face = open_face(path)
    whole = whole_face(face.parts(), str(path))
    if whole.topology.digest != base.topology.digest:
        raise TopologyError(path, f"other meshes or faces than {personal}, expected the same")
    off = float(np.linalg.norm(whole.points - base.points, axis=1).max(initial=0.0))
    if off > _SAME_MM:
        raise InputError(path, f"stands on a neutral that is up to {off:.2f} mm from that of {personal}")
    if name not in whole.deltas:
        raise SchemaError(path, f"has no shape '{name}', expected that of its recipe")
    weights = {str(shape): float(weight) for shape, weight in asked.items()}
    composite = Composite(
        points=base.points + whole.deltas[name],
        weights=resolved(weights, tuple(base.deltas), f"{where} -> weights"),
        matched=np.nan_to_num(face.primvar(SCANNED)) > 0.5,
    )
    known = dict(zip(recipe.sources, recipe.digests, strict=True)).get(str(options.get("personal")))
    is_same = known == source_digest(personal)
    return name, composite, () if is_same else (f"{personal.name} is not what {path.name} was registered with",)


@dataclass(frozen=True, kw_only=True)
class ShapeReport:
    """How much the scans show of one shape."""

    observed: float  # 0..1, the rest being the template's
    gain: float  # motion along the template's, over the template's
    change_mm: float  # mean distance from the template's, over what the shape moves
    scans: tuple[str, ...]  # that show it
    alike: tuple[str, ...]  # shapes that the scans can't separate from it


@dataclass(frozen=True, kw_only=True)
class SplitShapesReport(Judged):
    """How expressions were split."""

    shapes: Mapping[str, ShapeReport]
    weights: Mapping[str, Mapping[str, float]]  # scan -> shape -> weight, as it was found
    residual_mean_mm: Mapping[str, float]  # scan -> what the shapes leave of it
    residual_p95_mm: Mapping[str, float]
    rank: int  # of the weights: shapes that scans could separate
    unseen: tuple[str, ...]  # shapes that no scan shows: the template's
    undecided: tuple[str, ...] = ()  # shapes that scans hardly show, or as one with another: the template's
    flipped_triangles: int = 0  # in some shape, where the personal template's has them upright

    of_action: ClassVar[tuple[str, ...]] = ("flipped_triangles",)

    @property
    def seen(self) -> tuple[str, ...]:
        """Shapes that some scan shows; the others are the personal template's to the bit."""
        return tuple(name for name, one in self.shapes.items() if one.scans)


@one_thread()
def split_expressions(
    template: Template,
    neutral: FloatArray,
    shapes: Mapping[str, FloatArray],
    composites: Mapping[str, Composite],
    options: SplitOptions = _USUAL,
) -> tuple[dict[str, FloatArray], SplitShapesReport]:
    """Registered expressions split into the shapes that they are sums of, near the personal template's.

    :param neutral: (n, 3) whole points
    :param shapes: name -> (n, 3) whole deltas of the personal template
    :param composites: by the names of their scans
    :return: name -> (n, 3) whole delta from the neutral, millimetres; and how they were split
    :raises InputError: no composite, or one of shapes that are not there
    """
    if not composites:
        raise InputError(template.where, "no scanned expression, expected one or more beside the neutral")
    names = tuple(shapes)
    weights = np.zeros((len(composites), len(names)))
    for row, (scan, composite) in enumerate(composites.items()):
        for shape, weight in composite.weights.items():
            if shape not in shapes:
                near = suggestion(shape, shapes)
                raise InputError(f"{scan} -> {shape}", f"no such shape in the personal template{near}")
            weights[row, names.index(shape)] = max(weight, 0.0)
        if not weights[row].any():
            raise InputError(scan, "shows none of its shapes, expected a weight above 0")
    templates = np.stack(list(shapes.values()))
    split = split_shapes(
        neutral,
        templates,
        np.stack([composite.points for composite in composites.values()]),
        weights,
        template.topology.triangles,
        options,
        point_weights=np.stack([composite.matched for composite in composites.values()]).astype(np.float64),
        stiff=template.stiff,
        names=names,
    )
    # the split with the templates (e, n, 3) in place of shapes that the scans hardly show to be others
    slight = (split.observed < _HARDLY) & (split.changes < _SLIGHT_MM) & (split.changes > 0.0)
    split = replace(
        split,
        deltas=np.where(slight[:, None, None], templates, split.deltas),
        gains=np.where(slight, 1.0, split.gains),
        changes=np.where(slight, 0.0, split.changes),
        undecided=tuple(sorted({*split.undecided, *np.flatnonzero(slight).tolist()})),
    )
    return dict(zip(names, split.deltas, strict=True)), _report(split, names, tuple(composites))


def turned_over(
    template: Template, neutral: FloatArray, before: Mapping[str, FloatArray], after: Mapping[str, FloatArray]
) -> int:
    """How many triangles some shape of `after` turns over at weight 1 where that of its name `before` does not.

    :param neutral: (n, 3) whole points
    :param before: name -> (n, 3) whole deltas, and `after`
    """
    triangles = template.topology.triangles
    turned = np.zeros(len(triangles), bool)
    for name, delta in after.items():
        turned |= flipped_triangles(neutral + before[name], neutral + delta, triangles)
    return int(turned.sum())


def _report(split: Split, names: tuple[str, ...], scans: tuple[str, ...]) -> SplitShapesReport:
    # Both ways: of two shapes that scans show as one, neither can be said to be seen.
    alike: dict[int, list[str]] = {}
    for first, second in split.together:
        alike.setdefault(first, []).append(names[second])
        alike.setdefault(second, []).append(names[first])
    shapes = {
        name: ShapeReport(
            observed=float(split.observed[number]),
            gain=float(split.gains[number]),
            change_mm=float(split.changes[number]),
            scans=tuple(scan for scan, row in zip(scans, split.weights, strict=True) if row[number] > 0),
            alike=tuple(alike.get(number, ())),
        )
        for number, name in enumerate(names)
    }
    undecided = tuple(names[number] for number in split.undecided)
    return SplitShapesReport(
        shapes=shapes,
        weights={
            scan: {name: float(weight) for name, weight in zip(names, row, strict=True) if weight > 0}
            for scan, row in zip(scans, split.weights, strict=True)
        },
        residual_mean_mm=dict(zip(scans, map(float, split.residual_means), strict=True)),
        residual_p95_mm=dict(zip(scans, map(float, split.residual_p95), strict=True)),
        rank=split.rank,
        unseen=tuple(
            name
            for name, one in shapes.items()
            if one.observed < _OBSERVED and one.change_mm == 0.0 and name not in undecided
        ),
        undecided=undecided,
        warnings=split.warnings,
    )
