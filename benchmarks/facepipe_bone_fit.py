"""Child of bone_fit.py: skins a face, or fits its bones to all its shapes on one side; reports times and errors.

usage: facepipe_bone_fit.py prepare ict|sample SOURCE JOINTS ARRAYS REPORT
       facepipe_bone_fit.py facepipe ARRAYS DOF REPORT
       facepipe_bone_fit.py dem-bones ARRAYS SOFT REPORT
       facepipe_bone_fit.py scipy ARRAYS DOF TARGETS REPORT
       facepipe_bone_fit.py bound ARRAYS REPORT
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from bone_fit_bound import bound
from bone_fit_task import Clock, Task, load, prepare, session
from children import Json, write_report
from dem_bones_fit import dem_bones
from scipy_bone_fit import scipy_bounded

if TYPE_CHECKING:
    from facepipe.verbs.fit_bones.bone_fit import BoneFit

FRAME = 0.95  # the neighbouring frame: the shape at this weight
WARM = 10  # about so many targets for warm starts
SIDES = {"plain": {"rounds": 0}, "even": {}}  # least squares alone, and with the rounds that lower the largest distance


def facepipe(arrays: str, dof: str) -> Json:
    """The whole set in one call, fits of one target from rest and from a neighbouring frame, and one linear system."""
    task = load(arrays)
    _imports()
    report: Json = {}
    for name, settings in SIDES.items():
        whole, fit = _whole(task, int(dof), settings)
        report[name] = {**whole, **_cold(fit, task)}
        if name == "plain":
            report[name] |= {**_warm(fit, task), "linear_s": _linear(fit, task)}
    return report


def _imports() -> None:
    """Modules that a session needs: loaded before any clock runs, as the peer's is."""
    import scipy.linalg.lapack
    import scipy.sparse  # noqa: F401

    from facepipe.core.threads import one_thread
    from facepipe.verbs.fit_bones.bone_fit import BoneFit  # noqa: F401

    with one_thread():  # loads threadpoolctl, which looks for the libraries it controls
        pass


def _whole(task: Task, dof: int, settings: dict[str, int]) -> tuple[Json, BoneFit]:
    """All targets in one call; the clock holds what turns the task's arrays into coefficients and points."""
    clock = Clock()
    fit = session(task, dof, **settings)
    prepared, _ = clock.read()
    found = fit.fit_all(list(task.targets))
    seconds, wall = clock.read()
    errors = task.errors(np.stack([one.points for one in found]))
    return {"set_s": seconds, "set_wall_s": wall, "setup_s": prepared, **errors}, fit


def _cold(fit: BoneFit, task: Task) -> Json:
    """Each target by itself from rest, in a session that has fitted before."""
    times = []
    for target in task.targets:
        clock = Clock()
        fit.fit(target)
        times.append(clock.read())
    return _spread_of("cold", times)


def _warm(fit: BoneFit, task: Task) -> Json:
    """Fits that start where the neighbouring frame's ended."""
    times = []
    for target in task.targets[:: max(1, len(task.targets) // WARM)]:
        near = fit.fit(task.points + FRAME * (target - task.points)).coefficients
        clock = Clock()
        fit.fit(target, start=near)
        times.append(clock.read())
    return _spread_of("warm", times)


def _spread_of(name: str, times: list[tuple[float, float]]) -> Json:
    seconds, wall = np.array(times).T
    own = {"s": np.median(seconds), "slowest_s": seconds.max(), "wall_s": np.median(wall)}
    return {f"{name}_{key}": float(value) for key, value in own.items()}


def _linear(fit: BoneFit, task: Task) -> float:
    """Seconds of one boxed linear system, formed of a session's moments and solved, at rest."""
    from facepipe.geometry.bounded_least_squares import BoxedQuadratic
    from facepipe.rig import rest_coefficients
    from facepipe.verbs.fit_bones.skinning import slopes

    tree, variables, target = fit.tree, fit.variables, task.targets[task.hardest()[0]]
    rest, best = rest_coefficients(len(task.joints)), np.inf
    pairs, _ = tree.moments(task.points, fit.weights)
    for _ in range(5):
        clock = Clock()
        goal = tree.goal(target, fit.weights)
        pose = tree.pose(rest)
        gradient = variables.gradient(tree.gradient(pose, slopes(pairs, goal, pose.skinning)))
        normal = tree.normal_matrix(tree.generators(pose), pose, pairs, variables.joints)
        normal = variables.matrix(normal)
        normal[np.diag_indices_from(normal)] *= 1.0 + 1e-3
        own = variables.reduced(rest)
        BoxedQuadratic(normal).minimise(gradient, variables.lower - own, variables.upper - own)
        best = min(best, clock.read()[0])
    return best


def main(arguments: list[str]) -> None:
    """Run the verb, report to the last argument."""
    verb, *rest, report = arguments
    verbs: dict[str, Callable[..., Json]] = {
        "prepare": prepare,
        "facepipe": facepipe,
        "dem-bones": dem_bones,
        "scipy": scipy_bounded,
        "bound": bound,
    }
    write_report(report, verbs[verb](*rest))


if __name__ == "__main__":
    main(sys.argv[1:])
