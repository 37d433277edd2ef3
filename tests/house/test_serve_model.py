"""The queues of `benchmarks/serve_model.py` wait as long as queueing theory says, and lose nothing."""

from __future__ import annotations

import math

import benchmark_modules  # noqa: F401  (lets the next line find it)
import numpy as np
import pytest
import serve_model
from serve_model import Habits, Machines, Measured

COUNT = 200_000


def erlang_c(servers: int, load: float) -> float:
    """The share of those who wait in M/M/c, of `load` busy servers."""
    full = load**servers / math.factorial(servers) * servers / (servers - load)
    return full / (sum(load**one / math.factorial(one) for one in range(servers)) + full)


@pytest.mark.parametrize(("servers", "share"), [(1, 0.5), (1, 0.8), (4, 0.7), (16, 0.8)])
def test_waits_are_those_of_erlang(servers: int, share: float) -> None:
    """Mean wait C(c, a) s / (c - a), and C(c, a) of all wait."""
    rng, mean = np.random.default_rng(3), 2.0
    arrivals = np.cumsum(rng.exponential(mean / (servers * share), COUNT))
    waits = serve_model.many_servers(arrivals.tolist(), rng.exponential(mean, COUNT).tolist(), servers)
    wait = erlang_c(servers, servers * share)
    assert waits.mean() == pytest.approx(wait * mean / (servers * (1.0 - share)), rel=0.1)
    assert (waits > 0.0).mean() == pytest.approx(wait, rel=0.05)


def test_waits_of_even_services_are_those_of_pollaczek_and_khinchine() -> None:
    rng, share = np.random.default_rng(4), 0.8
    arrivals = np.cumsum(rng.exponential(1.0 / share, COUNT))
    waits = serve_model.one_server(arrivals, np.ones(COUNT))
    assert waits.mean() == pytest.approx(share / (2.0 * (1.0 - share)), rel=0.05)


def test_one_server_is_the_first_of_many() -> None:
    rng = np.random.default_rng(5)
    arrivals, services = np.cumsum(rng.exponential(1.0, 5000)), rng.gamma(2.0, 0.45, 5000)
    waits = serve_model.many_servers(arrivals.tolist(), services.tolist(), 1)
    np.testing.assert_allclose(serve_model.one_server(arrivals, services), waits, atol=1e-8)


def test_lost_workers_lose_no_job_and_cost_what_they_had_done() -> None:
    """With so many workers that nobody waits for one, a wait is that for the last start: of attempts of s seconds that
    are lost at a rate r, e^(rs) - 1 are lost, each after 1/r - s / (e^(rs) - 1) seconds and the notice."""
    machines = Machines(servers=1, session_cores=1, sessions=1, workers=0, mtbf=20.0, notice=3.0, away=5.0)
    rng, service = np.random.default_rng(6), 10.0
    arrivals = 100.0 * np.arange(20_000.0)
    waits = serve_model.many_servers(arrivals.tolist(), [service] * len(arrivals), 50, rng, machines)
    lost = math.expm1(service / machines.mtbf)
    expected = lost * (machines.mtbf - service / lost + machines.notice)
    assert waits.mean() == pytest.approx(expected, rel=0.05)


def test_sessions_are_cold_once_while_there_is_room_and_again_where_there_is_none() -> None:
    owners = np.tile(np.arange(10), 20)
    assert serve_model.is_cold(owners, 10).sum() == 10
    assert serve_model.is_cold(owners, 9).all()


def test_machines_that_are_bought_hold_their_day_and_twice_the_players_break_them() -> None:
    measured, habits, players = Measured(session_edit=0.05), Habits(), 20_000
    machines = serve_model.bought(measured, habits, players, 0.6)
    day = serve_model.simulate(measured, habits, machines, players, range(24))
    assert day["players"] == pytest.approx(players, rel=0.05)
    assert len(day["seconds"]["payload"]) == habits.payloads * day["players"]
    assert all(0.0 < busy < 0.6 for busy in day["busy"].values())
    peak = int(np.argmax(serve_model.DAY))
    more = serve_model.simulate(measured, habits, machines, 3 * players, range(peak - 1, peak + 2))
    assert "photo" in serve_model.missed(more)
    assert max(more["busy"].values()) > 1.0
