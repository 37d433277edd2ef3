"""What killed runs leave beside files, as somebody may send it: hidden folders with journals that the next run ends."""

from __future__ import annotations

import json
import random
from pathlib import Path

import fuzz_damage as damage
from fuzz_farm import PLACES, replace_by_another
from fuzzing import Format, Line
from small_sources import made

from facepipe.core.placing import identity
from facepipe.stage import save_parts

HIDDEN = ".facepipe-0123456789abcdef"
JOURNAL, JOINED = Path(HIDDEN, ".facepipe-journal"), Path("sub", HIDDEN, ".facepipe-joined")


def put_remains() -> None:
    """New files that wait in two folders, and what they are to replace."""
    save_parts(made(0), Path("face.usda"))
    for folder, names in ((Path(), ("main", "beside", "stale")), (Path("sub"), ("fresh",))):
        (folder / HIDDEN).mkdir(parents=True)
        (folder / HIDDEN / ".facepipe-lock").touch()
        for name in names:
            (folder / HIDDEN / name).write_text("new")
            (folder / name).write_text("old")
    Path("sub/fresh").unlink()


def damage_remains(rng: random.Random, part: str) -> list[Line]:
    """Another journal, or other things of its name; what it says of files is true at first."""
    moves = [[0, name, identity(Path(name)), role] for name, role in {"main": "main", "beside": "beside"}.items()]
    moves += [[1, "fresh", None, "main"], [0, "stale", identity(Path("stale")), "stale"]]
    journal = json.dumps({"folders": [".", "sub"], "moves": moves}).encode()
    JOURNAL.write_bytes(damage.damaged_json(rng, journal))
    JOINED.write_text("..")
    way = rng.random()
    if way < 0.2:
        JOURNAL.write_bytes(journal)
        JOINED.write_bytes(rng.choice([*PLACES, *damage.NAMES]).encode("utf-8", "surrogatepass"))
    elif way < 0.4:
        JOURNAL.write_bytes(journal)
        lock = Path(HIDDEN, ".facepipe-lock")
        replace_by_another(
            rng, rng.choice([JOURNAL, JOINED, lock, Path(HIDDEN, "main"), Path("main"), Path("sub", HIDDEN)])
        )
    return [["import", "usd", "face.usda", rng.choice(["out.usda", "sub/out.usda"])]]


REMAINS = {
    "remains": Format(
        {"folders": put_remains},
        damage_remains,
        writes=("out", "sub", "main", "beside", "stale", HIDDEN),
        keeps=("sub", "main", "beside", "stale", HIDDEN),
        hidden=True,
    )
}
