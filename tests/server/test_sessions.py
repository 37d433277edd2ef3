"""Warm sessions in real processes: what they answer is what the commands make, however often they are ended."""

from __future__ import annotations

import asyncio
import shutil
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from command_line import Capsys, done
from slider_faces import sample_with_sliders

import facepipe
from facepipe.server.library import Version
from facepipe.server.sessions import Answer, BusyError, Opening, SessionError, Sessions
from facepipe.stage import save_parts

pytestmark = [pytest.mark.gate, pytest.mark.slow]

T = TypeVar("T")
WEIGHTS = {"regions": {"mouth": [0.1, 0.9], "neck": [1.0, 0.0]}, "default": [0.5, 0.5]}
SETS = ("--set", "mouth=0.1,0.9", "--set", "neck=1,0", "--default", "0.5,0.5")
HALF_PRECISION = 2.0**-11


def laid(tenant: str, version: Version, folder: Path) -> Path:
    """A copy of a file; the tenant of these tests is the folder that it lies in."""
    return Path(shutil.copy(Path(tenant) / version.face, folder / f"{version.number}-{version.face}"))


def with_sessions(work: Callable[[Sessions], Awaitable[T]], folder: Path, **limits: Any) -> T:
    """What work on the sessions of a folder gives; no process outlives it, and no copy of a face."""

    async def main() -> T:
        sessions = Sessions(folder / "sessions", laid, **limits)
        try:
            return await work(sessions)
        finally:
            sessions.close()
            until = time.monotonic() + 60
            while any((folder / "sessions").iterdir()) and time.monotonic() < until:
                await asyncio.sleep(0.05)

    found = asyncio.run(main())
    assert not list((folder / "sessions").iterdir())
    return found


def opening(kind: Any, folder: Path, *names: str) -> Opening:
    return Opening(kind, tuple(Version(name, 1 + number) for number, name in enumerate(names)), str(folder))


def offsets(answer: Answer) -> np.ndarray:
    return np.frombuffer(answer.body, "<f2").reshape(-1, 3).astype(np.float64)


async def settled(sessions: Sessions, blend: Opening, request: dict[str, Any]) -> Answer:
    """The last answer to a request."""
    found: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
    first = await sessions.ask(blend, request, found.set_result)
    return first if first.settled else await asyncio.wait_for(found, 60)


@pytest.fixture
def blend(folder: Path) -> Opening:
    return opening("blend", folder, "a.usda", "b.usda")


@pytest.fixture
def person(tmp_path: Path) -> Path:
    save_parts(sample_with_sliders(), tmp_path / "sample.usdc")
    return tmp_path / "sample.usdc"


def moved_by(before: Path, after: Path) -> np.ndarray:
    """(n, 3) millimetres in glTF space that a command has moved points by."""
    one, other = facepipe.open(before), facepipe.open(after)
    parts = one.parts()
    return (other.evaluate(pose="set") - one.evaluate(pose="set")) @ parts.gltf_axes[:3, :3].T * 1e3


def test_a_blend_is_that_of_the_command(folder: Path, blend: Opening, capsys: Capsys) -> None:
    """Settled to the precision of float16; before that within a thousandth of the head's height."""
    done(capsys, "blend", "a.usda", "b.usda", *SETS, "-o", "c.usda")
    expected = moved_by(folder / "a.usda", folder / "c.usda")

    async def work(sessions: Sessions) -> tuple[dict[str, Any], Answer, Answer]:
        opened = await sessions.opened(blend)
        first = await sessions.ask(blend, {"weights": WEIGHTS})
        return opened, first, await settled(sessions, blend, {"weights": WEIGHTS})

    opened, first, last = with_sessions(work, folder)
    assert opened["regions"] == ["mouth", "neck"]
    assert sum(mesh["points"] for mesh in opened["meshes"]) == len(expected)
    height = facepipe.open(folder / "a.usda").head_height * facepipe.open(folder / "a.usda").meters_per_unit * 1e3
    assert np.abs(offsets(first) - expected).max() < 1e-3 * height
    assert np.abs(offsets(last) - expected).max() <= 1e-5 * height + HALF_PRECISION * np.abs(expected).max()
    assert last.settled
    assert np.abs(expected).max() > 0.01 * height


def test_sliders_are_those_of_the_command(person: Path, capsys: Capsys) -> None:
    values = {"curved": -0.5, "blink": 0.5}
    words = [word for name, value in values.items() for word in ("--set", f"{name}={value}")]
    done(capsys, "sliders", person, *words, "-o", person.with_name("set.usda"))
    asked = opening("sliders", person.parent, person.name)

    async def work(sessions: Sessions) -> tuple[Answer, Answer]:
        return await sessions.ask(asked, {"values": values}), await sessions.ask(asked, {"values": {}})

    moved, still = with_sessions(work, person.parent)
    expected = moved_by(person, person.with_name("set.usda"))
    assert np.abs(offsets(moved) - expected).max() <= 1e-3 + HALF_PRECISION * np.abs(expected).max()
    assert np.abs(expected).max() > 1.0
    assert not offsets(still).any()


def test_a_payload_is_that_of_the_command(tmp_path: Path, capsys: Capsys) -> None:
    """Of measures, and of an identity slider, which moves the neutral itself."""
    head, values = tmp_path / "head.usdc", {"noseWidth": 0.5, "identity004": 0.75}
    done(capsys, "sample", head, "--textures", "0")
    words = [word for name, value in values.items() for word in ("--set", f"{name}={value}")]
    done(capsys, "sliders", head, *words, "-o", tmp_path / "set.usda")
    done(capsys, "person", tmp_path / "set.usda", "-o", tmp_path / "set.fpb")
    head_sliders = opening("sliders", tmp_path, "head.usdc")

    async def work(sessions: Sessions) -> tuple[Answer, Answer]:
        asked = [{"values": values, "wanted": wanted} for wanted in ("offsets", "payload")]
        first, second = [await sessions.ask(head_sliders, one) for one in asked]
        return first, second

    moved, payload = with_sessions(work, tmp_path)
    assert payload.body == (tmp_path / "set.fpb").read_bytes()
    expected = moved_by(head, tmp_path / "set.usda")
    assert np.abs(offsets(moved) - expected).max() <= 1e-3 + HALF_PRECISION * np.abs(expected).max()
    assert np.abs(expected).max() > 1.0


def test_weights_that_move_again_are_settled_once(folder: Path, blend: Opening) -> None:
    async def work(sessions: Sessions) -> list[tuple[int, Answer]]:
        found: list[tuple[int, Answer]] = []
        for number in range(6):
            weights = {"default": [1.0 - number / 10, number / 10]}
            await sessions.ask(blend, {"weights": weights}, lambda one, number=number: found.append((number, one)))
        until = time.monotonic() + 60
        while not found and time.monotonic() < until:
            await asyncio.sleep(0.05)
        await sessions.ask(blend, {"weights": weights})  # whatever comes late has come by then
        return found

    found = with_sessions(work, folder)
    assert [number for number, _ in found] == [5]


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        ({"weights": {"mouth": [1]}}, "weights -> mouth: 1 weights, expected 2"),
        ({"weights": {"beard": [0, 1]}}, "weights -> beard: no such region"),
        ({"weights": 3}, "weights: "),
        ({}, "weights: "),
        ({"weights": {"mouth": [float("nan"), 1]}}, "weights -> regions -> mouth -> 0: nan"),
    ],
)
def test_what_makes_no_sense_is_told_and_the_session_stays(
    folder: Path, blend: Opening, request_: dict[str, Any], said: str
) -> None:
    async def work(sessions: Sessions) -> tuple[str, Answer]:
        with pytest.raises(SessionError) as raised:
            await sessions.ask(blend, request_)
        return str(raised.value), await sessions.ask(blend, {"weights": WEIGHTS})

    told, after = with_sessions(work, folder)
    assert told.startswith(said)
    assert offsets(after).any()


def test_files_that_are_no_faces_and_gone_ones(folder: Path) -> None:
    (folder / "no.usda").write_text("#usda 1.0\n", encoding="utf-8")

    async def work(sessions: Sessions) -> list[str]:
        told = []
        for name in ("no.usda", "gone.usda"):
            with pytest.raises(SessionError) as raised:
                await sessions.opened(opening("blend", folder, "a.usda", name))
            told.append(str(raised.value))
        return told

    no_face, gone = with_sessions(work, folder)
    assert no_face.startswith("2-no.usda")
    assert gone == "session: can't be started (No such file or directory)"


def test_sessions_of_a_deleted_face_end(folder: Path, blend: Opening) -> None:
    """With their copies; those of others stay."""
    other = opening("sliders", folder, "b.usda")

    async def work(sessions: Sessions) -> tuple[int, int]:
        await sessions.opened(blend)
        await sessions.opened(other)
        sessions.forget(str(folder), "a.usda")
        until = time.monotonic() + 60
        while len(list((folder / "sessions").iterdir())) > 1 and time.monotonic() < until:
            await asyncio.sleep(0.05)
        return sessions.count, len(list((folder / "sessions").iterdir()))

    assert with_sessions(work, folder) == (1, 1)


def test_the_one_used_least_lately_goes_and_comes_back(folder: Path, blend: Opening) -> None:
    others = [opening("blend", folder, "b.usda", "a.usda"), opening("sliders", folder, "a.usda")]

    async def work(sessions: Sessions) -> tuple[list[int], list[Answer]]:
        counts, answers = [], [await sessions.ask(blend, {"weights": WEIGHTS})]
        for other in others:  # the second one takes the place of the first
            await sessions.opened(other)
            counts.append(sessions.count)
        answers.append(await sessions.ask(blend, {"weights": WEIGHTS}))
        counts.append(sessions.count)
        return counts, answers

    counts, (before, after) = with_sessions(work, folder, most=2)
    assert counts == [2, 2, 2]
    assert before.body == after.body


def test_one_that_has_crashed_is_opened_again(folder: Path, blend: Opening) -> None:
    async def work(sessions: Sessions) -> tuple[Answer, Answer]:
        before = await sessions.ask(blend, {"weights": WEIGHTS})
        process = sessions._open[blend]._process
        assert process is not None
        process.kill()
        process.wait()
        return before, await sessions.ask(blend, {"weights": WEIGHTS})

    before, after = with_sessions(work, folder)
    assert before.body == after.body


def test_no_more_memory_than_allowed(folder: Path, blend: Opening) -> None:
    """Of two that are too much together the one that was not asked goes."""
    other = opening("blend", folder, "b.usda", "a.usda")

    async def work(sessions: Sessions) -> tuple[int, float]:
        await sessions.ask(blend, {"weights": WEIGHTS})
        one = sessions._open[blend].mb
        sessions._most_mb = 1.5 * one
        await sessions.ask(other, {"weights": WEIGHTS})
        return sessions.count, one

    count, mb = with_sessions(work, folder)
    assert count == 1
    assert mb > 10


def test_none_is_taken_from_who_waits_for_it(folder: Path, blend: Opening) -> None:
    other = opening("blend", folder, "b.usda", "a.usda")

    async def work(sessions: Sessions) -> Answer:
        first = asyncio.create_task(sessions.ask(blend, {"weights": WEIGHTS}))
        await asyncio.sleep(0)
        with pytest.raises(BusyError, match="all 1 are being used"):
            await sessions.opened(other)
        return await first

    assert offsets(with_sessions(work, folder, most=1)).any()
