"""Gradient descent of photo fits, on losses whose course is known."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from with_torch import torch

from facepipe.photo.descent.descent import Descent, Unknowns, descend
from facepipe.photo.descent.landmark_fit import State
from facepipe.photo.options import PhotoFitOptions
from facepipe.photo.renderer.light import DARK

pytestmark = pytest.mark.needs_torch

Loss = Callable[[Unknowns], dict[str, torch.Tensor]]
NAMES = ("shares", "expressions", "poses", "light", "key", "tint")


def start(seed: int = 0) -> Unknowns:
    rng = np.random.default_rng(seed)
    state = State(
        shares=rng.uniform(0.3, 0.7, 4), expressions=rng.uniform(0.3, 0.7, (2, 3)), poses=rng.normal(size=(2, 7))
    )
    light = [torch.tensor(rng.normal(size=(9, 3)), dtype=torch.float32) for _ in range(2)]
    lamps = [torch.tensor((*rng.normal(size=3), *rng.uniform(0.3, 0.7, 4), 3.0), dtype=torch.float32) for _ in range(2)]
    return Unknowns.from_state(state, light, torch.tensor(rng.normal(size=(2, 3)), dtype=torch.float32), lamps)


def test_without_lamps_they_are_dark() -> None:
    own = start()
    bare = Unknowns.from_state(own.state(), list(own.light), own.tint)
    assert bare.key.tolist() == torch.tensor([DARK, DARK]).tolist()


def bowl(at: Unknowns, goal: float = 0.5, width: float = 1.0) -> dict[str, torch.Tensor]:
    """Half the squared distance to one value everywhere."""
    total = sum(((getattr(at, name).double() - goal) ** 2).sum() for name in NAMES)
    return {"total": 0.5 * width * total}


def run(loss: Loss, own: Unknowns | None = None, **options: object) -> Descent:
    return descend(loss, own or start(), PhotoFitOptions(**options))  # type: ignore[arg-type]


def test_plain_descent_is_the_documents_update() -> None:
    """[0175]-[0177]: the rate times the slope off, one rate for sliders and expressions, its own for the others."""
    own, before = start(), start()

    def loss(at: Unknowns) -> dict[str, torch.Tensor]:
        wavy = sum((getattr(at, name).double() * 3).sin().sum() for name in NAMES)
        return {"total": wavy + at.shares.prod().double()}

    terms = loss(before)
    slopes = dict(zip(NAMES, torch.autograd.grad(terms["total"], before.tensors()), strict=True))
    descend(loss, own, PhotoFitOptions(optimiser="gradient-descent", rate=1e-3, iterations=1))
    for name in NAMES:
        moved = (getattr(before, name) - getattr(own, name)).detach()
        rate = ((moved * slopes[name]).sum() / (slopes[name] ** 2).sum()).item()
        np.testing.assert_allclose(moved, rate * slopes[name], atol=2e-7)
        if name in ("shares", "expressions"):
            assert rate == pytest.approx(1e-3, rel=1e-3)
        assert 1e-4 <= rate <= 1.001e-3


def test_plain_descent_keeps_its_rate() -> None:
    """On a bowl each step leaves the same share of the distance."""
    found = run(bowl, optimiser="gradient-descent", rate=0.1, iterations=20).best
    expected = 0.5 + 0.9**20 * (start().shares.detach() - 0.5)
    np.testing.assert_allclose(found.shares, expected, atol=1e-6)


@pytest.mark.parametrize(("steps", "memory", "rise"), [(60, 0.9, 12), (12, 2 / 3, 3.6)])
def test_adam_is_that_of_torch_with_steps_that_shrink(steps: int, memory: float, rise: float) -> None:
    """Few steps remember less."""
    own, peer = start(), start()

    def loss(at: Unknowns) -> dict[str, torch.Tensor]:
        rough = sum(((getattr(at, name).double() - 0.5).abs() + 0.1).log().sum() for name in NAMES)
        return {"total": rough + 1000.0}

    rate = 0.12 / steps
    run(loss, own, rate=rate, iterations=steps)
    optimiser = torch.optim.Adam([peer.shares, peer.expressions], lr=rate, betas=(memory, 0.99))
    for step in range(steps):
        falling = 0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * step / steps))
        optimiser.param_groups[0]["lr"] = rate * falling * min(1, (step + 1) / rise)
        optimiser.zero_grad()
        loss(peer)["total"].backward()
        optimiser.step()
    np.testing.assert_allclose(own.shares.detach(), peer.shares.detach(), atol=1e-5)
    np.testing.assert_allclose(own.expressions.detach(), peer.expressions.detach(), atol=1e-5)


def test_a_first_step_moves_heads_less_than_sliders() -> None:
    own, before = start(), start()
    run(bowl, own, rate=0.01, iterations=1)
    moved = {name: (getattr(own, name) - getattr(before, name)).detach().abs() for name in NAMES}
    np.testing.assert_allclose(moved["shares"], 0.01, rtol=1e-3)
    steps = moved["poses"].numpy() / 0.01
    assert (steps[:, 3:6] < 0.1).all(), "place and size, which move every pixel"
    assert (steps[:, :3] < 0.5).all()
    np.testing.assert_allclose(steps[0], steps[1], rtol=1e-6)


@pytest.mark.parametrize("optimiser", ["adam", "gradient-descent"])
def test_a_bowls_bottom_is_found(optimiser: str) -> None:
    descent = run(bowl, optimiser=optimiser, rate=0.3, iterations=300)
    assert descent.stopped == "iterations"
    assert len(descent.history) == 301
    assert descent.history[-1]["total"] < 1e-2 * descent.history[0]["total"]
    assert (descent.best.shares - 0.5).abs().max() < 1e-2


@pytest.mark.parametrize(("goal", "end"), [(-3.0, 0.0), (7.0, 1.0)])
@pytest.mark.parametrize("optimiser", ["adam", "gradient-descent"])
def test_sliders_and_expressions_never_leave_their_ranges(optimiser: str, goal: float, end: float) -> None:
    seen = []

    def loss(at: Unknowns) -> dict[str, torch.Tensor]:
        seen.append(torch.cat([at.shares.detach(), at.expressions.detach().ravel()]))
        return bowl(at, goal)

    best = run(loss, optimiser=optimiser, rate=0.2, iterations=30).best
    values = torch.stack(seen)
    assert values.min() >= 0
    assert values.max() <= 1
    assert (best.shares == end).all()
    assert (best.expressions == end).all()
    assert (best.poses - goal).abs().max() < (start().poses - goal).abs().max(), "others have no range"


def test_the_best_of_all_steps_is_kept() -> None:
    """A loss that turns at the third step, whatever the unknowns do."""
    visited: list[torch.Tensor] = []

    def loss(at: Unknowns) -> dict[str, torch.Tensor]:
        visited.append(at.shares.detach().clone())
        return {"total": at.shares.sum().double() * 1e-6 + abs(len(visited) - 4)}

    descent = run(loss, iterations=10)
    assert [round(terms["total"]) for terms in descent.history] == [3, 2, 1, 0, 1, 2, 3, 4, 5, 6, 7]
    assert (descent.best.shares == visited[3]).all()
    assert descent.kept == 3
    assert (visited[3] != visited[-1]).any()


@pytest.mark.parametrize("broken", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("after", [0, 5])
def test_a_loss_that_is_not_finite_ends_it_with_the_best_before(broken: float, after: int) -> None:
    visited: list[torch.Tensor] = []

    def loss(at: Unknowns) -> dict[str, torch.Tensor]:
        visited.append(at.shares.detach().clone())
        return bowl(at) if len(visited) <= after else {"total": bowl(at)["total"] * broken}

    descent = run(loss, iterations=50)
    assert descent.stopped == "not-finite"
    assert len(visited) == after + 1
    assert (descent.best.shares == visited[max(after - 1, 0)]).all()
    assert all(bool(getattr(descent.best, name).isfinite().all()) for name in NAMES)


def test_a_slope_that_is_not_finite_ends_it_too() -> None:
    own = start()
    with torch.no_grad():
        own.tint.zero_()
    descent = run(lambda at: {"total": bowl(at)["total"] + at.tint.abs().sqrt().sum()}, own, iterations=5)
    assert descent.stopped == "not-finite"
    assert len(descent.history) == 1
    assert all(bool(getattr(descent.best, name).isfinite().all()) for name in NAMES)


def test_it_stops_below_a_threshold() -> None:
    whole = run(bowl, rate=0.02, iterations=60)
    bound = whole.history[17]["total"] * (1 + 1e-9)
    descent = run(bowl, rate=0.02, iterations=60, loss_threshold=bound)
    assert descent.stopped == "loss-threshold"
    assert [terms["total"] for terms in descent.history] == [terms["total"] for terms in whole.history[:18]]
    assert bowl(descent.best)["total"].item() < bound
    at_once = run(bowl, iterations=60, loss_threshold=1e6)
    assert (at_once.stopped, len(at_once.history)) == ("loss-threshold", 1)
    assert (at_once.best.shares == start().shares).all()


def test_every_step_is_told_and_none_is_made_without_iterations() -> None:
    told: list[float] = []
    found = descend(bowl, start(), PhotoFitOptions(iterations=7), lambda at: told.append(bowl(at)["total"].item()))
    assert len(told) == 7
    assert told[-1] == pytest.approx(found.history[-1]["total"])  # where it stands then
    still = run(bowl, iterations=0)
    assert (still.stopped, len(still.history)) == ("iterations", 1)
    for name in NAMES:
        assert (getattr(still.best, name) == getattr(start(), name)).all()


@pytest.mark.parametrize("optimiser", ["adam", "gradient-descent"])
def test_what_no_loss_depends_on_stays(optimiser: str) -> None:
    best = run(lambda at: {"total": at.shares.sum().double()}, optimiser=optimiser, iterations=5).best
    assert (best.shares < start().shares).all()
    for name in NAMES[1:]:
        assert (getattr(best, name) == getattr(start(), name)).all()


def test_terms_are_all_remembered() -> None:
    def loss(at: Unknowns) -> dict[str, torch.Tensor]:
        one, other = at.shares.sum(), (at.poses**2).sum()
        return {"one": one, "other": other, "total": one.double() + other}

    for terms in run(loss, iterations=3).history:
        assert list(terms) == ["one", "other", "total"]
        assert terms["total"] == pytest.approx(terms["one"] + terms["other"])


def test_unknowns_are_numbers_of_their_own() -> None:
    own = start()
    copy = own.copy()
    with torch.no_grad():
        own.shares.add_(5.0)
        own.expressions.sub_(5.0)
        own.key.sub_(5.0)
    assert (copy.shares == start().shares).all()
    assert not copy.shares.requires_grad
    own.clamp()
    assert own.shares.tolist() == [1.0] * 4
    assert own.expressions.unique().tolist() == [0.0]
    assert own.key[:, 3:7].unique().tolist() == [0.0]
    assert own.key[:, [0, 1, 2, 7]].max() < 0, "directions and exponents go anywhere"
    state = copy.state()
    assert state.poses.dtype == state.shares.dtype == np.float64
    again = Unknowns.from_state(state, list(copy.light), copy.tint, list(copy.key))
    for name in NAMES:
        assert (getattr(again, name) == getattr(copy, name)).all()
        assert getattr(again, name).requires_grad
