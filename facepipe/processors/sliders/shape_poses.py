"""The poses of all shapes that sliders are made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from facepipe.core.arrays import FloatArray
from facepipe.processors.sliders.shape_fits import ShapeFits, ShapePose
from facepipe.processors.sliders.shape_names import ShapeSlider


def fit_poses(
    fits: ShapeFits,
    sliders: Sequence[ShapeSlider],
    targets: Mapping[str, FloatArray],
    done: Callable[[], object] = lambda: None,
) -> dict[str, ShapePose]:
    """Shape -> its pose; of a slider and its mirror the first is fitted, and the other is its mirror image.

    :param targets: shape -> (n, 3) points
    :param done: called after every shape
    """
    twins = _twins(sliders) if fits.mirror is not None else {}
    sides = [shape for shape in targets if shape in twins]
    middle = [shape for shape in targets if shape not in twins and shape not in twins.values()]
    poses = dict(zip(middle, fits.middle([targets[shape] for shape in middle], done), strict=True))
    poses |= zip(sides, fits.side([targets[shape] for shape in sides], done), strict=True)
    for shape in sides:
        poses[twins[shape]] = fits.mirrored(poses[shape])
        done()
    return poses


def _twins(sliders: Sequence[ShapeSlider]) -> dict[str, str]:
    """Shape of the first slider of a pair -> that of its mirror."""
    by_name = {one.name: one for one in sliders}
    twins: dict[str, str] = {}
    for slider in sliders:
        if slider.mirror is not None and slider.ends[0][1] not in twins.values():
            twins |= {
                shape: other for (_, shape), (_, other) in zip(slider.ends, by_name[slider.mirror].ends, strict=True)
            }
    return twins
