"""Plans, their ledgers, caches of results and project files, damaged, and the commands that work with them.

A batch does its tasks in this process instead of others, which take half a second to start: the engine below does what
`facepipe.tasks.program` does there.
"""

from __future__ import annotations

import json
import os
import random
import re
import shutil
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import fuzz_damage as damage
import obj_files
from fuzzing import Format, Line
from small_sources import made

from facepipe.cli import main
from facepipe.core.policy.paths import Trust, trusting
from facepipe.farm import batch
from facepipe.stage import save_parts
from facepipe.stage.files import naming
from facepipe.tasks.contents import Contents
from facepipe.tasks.mirror import mirror
from facepipe.tasks.program import read_line, work

Rng = random.Random

PLACES = [
    "../x", "../../x", "../../../../../../etc/passwd", "/etc/passwd", "/etc", "/", "/dev/zero", "/dev/stdin", ".", "",
    "built", "built/../../x", "heads/ada.usda", "heads", "show_batch/tasks.jsonl", "cache", "plan.toml", "~/x",
    "built/*", "http://127.0.0.1:9/x", "https://user:word@127.0.0.1:9/x", "file:///etc/passwd", "s3://bucket/x",
    "gs://bucket/x", "memory://b/x", "memory://../x", "github://a:b@c/x", "simplecache::memory://b/x", "x://",
    "built/ada.usda\0",
]  # fmt: skip
STATUSES = ["made", "kept", "cached", "failed", "skipped", "lost", "", "x"]
MOST_TASKS = 30  # of a case: a plan may ask for millions, which take as long as they take


# ---- the engine


class AtOnce:
    """Does each task where it is given out."""

    def __init__(self, count: int, setting: Mapping[str, Any]) -> None:
        self._setting, self._contents, self._done = json.loads(json.dumps(setting)), Contents(), 0

    def submit(self, request: Mapping[str, Any], order: tuple[int, ...], done: Callable[[Any], object]) -> None:
        """Do a task; a fault of ours, which a record would only name, is raised."""
        self._done += 1
        if self._done > MOST_TASKS:
            done({"task": request["task"], "gone": "this is enough"})
            return
        setting, request = self._setting, json.loads(json.dumps(request))
        before = Path.cwd()
        os.chdir(setting["folder"])
        try:
            with mirror(setting["urls"], setting["local"], setting["local_bytes"]) as copies:
                roots = (*map(Path, setting["roots"]), *copies.roots)
                with trusting(Trust(roots=roots, models=setting["models"], confined=True)), naming(copies.name):
                    record = work(request, read_line, self._contents, copies)
        finally:
            os.chdir(before)
        fault = re.match(r"\w+: ", str(record.get("error")).removeprefix(f"{request['task']}: "))
        if record["status"] == "failed" and not record["passing"] and fault and "Error" in fault[0]:
            raise AssertionError(record["error"])
        done(json.loads(json.dumps(record)))

    def close(self) -> None:
        """Nothing is left."""


PLAN = ["batch", "show.toml", "--processes", "1", "--thumbnails", "0"]
OPTIONS = ("--resume", "--retry-failed", "--verify", "--json")


def run_plan(rng: Rng, *words: str) -> list[Line]:
    """The command that runs the plan in this process, with some of its options."""
    batch.Processes = AtOnce  # type: ignore[misc, assignment]
    return [[*PLAN, *words, *(one for one in OPTIONS if rng.random() < 0.2)]]


# ---- a plan that was run


STEPS = """
[steps.copy]
run = "import obj {face}"
out = "{name}.usda"

[steps.check]
run = "inspect {copy}"
seconds = 60

[steps.sheet]
run = "import usd {copy}"
once = true
out = "all/sheet.usda"
priority = 2
"""


def put_heads(*names: str) -> None:
    Path("heads").mkdir()
    for name in names:
        Path("heads", f"{name}.obj").write_text(obj_files.NEUTRAL)


CACHE = {"run": ("--cache", "cache"), "store": ("--root", "memory://b", "--root", ".", "--local", "cache")}


def put_run(part: str = "run") -> None:
    """A plan with its results, its state, and a cache: of results, or of copies of what a store has."""
    put_heads("ada")
    table = TABLES["glob"]
    if part == "store":
        fill_store()
        table = table.replace("heads", "memory://b/heads")
    Path("show.toml").write_text(f'out = "built"\n[faces]\n{table}\n{STEPS}')
    batch.Processes, processes = AtOnce, batch.Processes  # type: ignore[misc, assignment]
    try:
        assert main([*PLAN, *CACHE[part]]) == 0
    finally:
        batch.Processes = processes  # type: ignore[misc]


def fill_store() -> None:
    """The head in the memory of this process, of one age in all processes: what is copied has that in its key."""
    import fsspec

    files = fsspec.filesystem("memory")
    files.store.clear()
    files.pipe_file("/b/heads/ada.obj", obj_files.NEUTRAL.encode())
    files.store["/b/heads/ada.obj"].created = datetime(2026, 1, 1, tzinfo=UTC)


def misplaced(rng: Rng, holder: Any) -> Any:
    """A record whose files are in other places, have another state, or another digest."""
    if not isinstance(holder, dict):
        return holder
    for key in ("reads", "writes"):
        files = holder.get(key)
        if isinstance(files, dict) and files and rng.random() < 0.7:
            name = rng.choice(sorted(files))
            value = files[name] if rng.random() < 0.4 else files.pop(name)
            files[rng.choice([*PLACES, *damage.NAMES])] = rng.choice([value, value, value, *damage.VALUES])
    return holder


def damaged_ledger(rng: Rng, data: bytes) -> bytes:
    """Lines with other values or other places, more lines, or bytes."""
    way = rng.random()
    if way < 0.1:
        return damage.damaged_text(rng, data)
    if way < 0.13:
        return data + rng.choice([b"\0" * 100_000, b"[" * 100_000, b"{" * 300, b'"' + b"a" * 1_000_000, b"\xff\xfe"])
    lines = data.splitlines()
    for _ in range(damage.some(rng)):
        at = rng.randrange(len(lines))
        try:
            record = json.loads(lines[at])
        except (ValueError, RecursionError):  # damaged before
            continue
        way = rng.random()
        if way < 0.45:
            record = misplaced(rng, record)
        elif way < 0.55 and isinstance(record, dict):
            record[rng.choice(["status", "task", "version"])] = rng.choice([*STATUSES, *PLACES])
        else:
            record = damage.damaged_value(rng, record)
        line = damage.json_text(rng, record)
        lines[at : at + rng.choice([0, 1, 1, 1])] = [line] * rng.choice([1, 1, 1, 2, 200 if len(line) < 9000 else 1])
    return b"\n".join(lines) + rng.choice([b"", b"\n", b"\n"])


def damage_ledger(rng: Rng, part: str) -> list[Line]:
    file = Path("show_batch/tasks.jsonl")
    if rng.random() < 0.1:
        replace_by_another(rng, file)
    else:
        file.write_bytes(damaged_ledger(rng, file.read_bytes()))
    _without(rng, "built")
    if rng.random() < 0.2:
        Path("heads/ada.obj").write_text(obj_files.NEUTRAL + "# another\n")
    return run_plan(rng)


def replace_by_another(rng: Rng, path: Path) -> None:
    """Something else of the name: a folder, a pipe, a link, nothing. Links that lead out end in folders of the case."""
    outside = Path("../../outside")
    outside.mkdir(exist_ok=True)
    (outside / "private").write_text("private")
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    way = rng.randrange(5)
    if way == 0:
        path.mkdir()
    elif way == 1 and hasattr(os, "mkfifo"):
        os.mkfifo(path)
    elif way < 4:
        inside = [path.name, ".", "heads", "gone", "face.usda"]
        path.symlink_to(rng.choice([*inside, *map(os.path.abspath, (outside, outside / "private", outside / "gone"))]))


def _without(rng: Rng, folder: str) -> None:
    """Some of the results are gone or are others."""
    for path in sorted(Path(folder).rglob("*.usd*")):
        way = rng.random()
        if way < 0.3:
            path.unlink()
        elif way < 0.4:
            path.write_text("#usda 1.0\n")


def damage_cache(rng: Rng, part: str) -> list[Line]:
    folder = Path("cache/copies" if part == "store" else "cache")
    if part == "store":
        fill_store()
    entry = rng.choice(sorted(folder.iterdir()))
    files = sorted(entry.iterdir())
    way = rng.random()
    if way < 0.12:
        replace_by_another(rng, rng.choice([*files, entry, folder]))
    elif way < 0.3:
        file = rng.choice(files)
        file.write_bytes(damage.damaged_bytes(rng, file.read_bytes()))
    else:
        file = entry / "record.json"
        data = damage.damaged_json(rng, file.read_bytes())
        if way < 0.7:
            data = damage.json_text(rng, misplaced(rng, json.loads(file.read_bytes())))
        file.write_bytes(data)
    if rng.random() < 0.7:
        shutil.rmtree("show_batch")
    for path in Path("built").rglob("*.usda"):
        path.unlink()
    return run_plan(rng, *CACHE[part])


# ---- plans


CSV = "name,face,note\nada,heads/ada.obj,x\nb,heads/b.obj,\n"
TABLES = {
    "glob": 'glob = "heads/*.obj"',
    "csv": 'csv = "faces.csv"',
    "rows": 'rows = [{ name = "ada", face = "heads/ada.obj", age = 7 }, { name = "b", face = "heads/b.obj", age = 1 }]',
    "range": "range = { seed = [1, 2] }",
}


def put_plan(table: str) -> Callable[[], None]:
    def put() -> None:
        put_heads("ada", "b")
        Path("faces.csv").write_text(CSV)
        steps = STEPS.replace("{face}", "heads/ada.obj") if table == "range" else STEPS
        Path("show.toml").write_text(f'out = "built"\n[faces]\n{TABLES[table]}\n{steps}')

    return put


def damage_plan(rng: Rng, part: str) -> list[Line]:
    if rng.random() < 0.1:
        replace_by_another(rng, Path(rng.choice(["heads/ada.obj", "heads", "faces.csv", "show.toml"])))
        return run_plan(rng)
    if part == "csv" and rng.random() < 0.5:
        file = Path("faces.csv")
        file.write_bytes(_elsewhere(rng, damage.damaged_text(rng, file.read_bytes()), b"heads/ada.obj"))
        return run_plan(rng)
    file = Path("show.toml")
    if rng.random() < 0.4:
        old = rng.choice([b"heads/*.obj", b"faces.csv", b"heads/ada.obj", b"built", b"{name}.usda", b"all/sheet.usda"])
        file.write_bytes(_elsewhere(rng, file.read_bytes(), old))
    else:
        file.write_bytes(damage.damaged_toml(rng, file.read_bytes()))
    return run_plan(rng)


def _elsewhere(rng: Rng, data: bytes, old: bytes) -> bytes:
    """Another path in place of one of a text."""
    new = rng.choice([*PLACES, *damage.NAMES]).replace("\\", "\\\\").replace('"', '\\"')
    return data.replace(old, new.encode("utf-8", "surrogatepass"), 1)


# ---- project files


PROJECT = """
roots = ["lib", "../library"]

[names]
studio = "tables/names.csv"

[defaults.export]
engine = "unity"
rename = "studio"
influences = 4
quantize = true

[defaults.render]
size = 16

[defaults.sliders]
residual = true

[defaults.animate]
fps = 30

[defaults.validate]
json = true

[defaults.batch]
resume = true
seconds = 60
thumbnails = 0

[defaults.inspect]
json = false
"""
PROJECT_LINES = [
    ["inspect", "face.usda"],
    ["validate", "face.usda"],
    ["sliders", "face.usda", "--from-shapes", "jawOpen", "-o", "out.usda"],
    ["export", "face.usda", "-o", "out.glb"],
    ["export", "face.usda", "-o", "out.onnx"],
    ["animate", "face.usda", "talk.csv", "-o", "out.usda"],
    ["render", "face.usda", "-o", "out.png"],
    ["batch", "show.toml", "--state", "out_state"],
]


def put_project_file() -> None:
    save_parts(made(0), Path("face.usda"))
    Path("talk.csv").write_text("jawOpen\n0\n0.25\n1\n")
    Path("tables").mkdir()
    Path("tables/names.csv").write_text("old,new\njawOpen,open\n")
    step = '[steps.game]\nrun = "export face.usda"\nout = "{seed}.glb"\n'
    Path("show.toml").write_text(f'out = "out"\n[faces]\n{TABLES["range"]}\n{step}')
    Path("facepipe.toml").write_text(PROJECT)


def damage_project_file(rng: Rng, part: str) -> list[Line]:
    file = Path("facepipe.toml")
    way = rng.random()
    if way < 0.1:
        replace_by_another(
            rng, rng.choice([file, Path("tables/names.csv"), Path("tables"), Path("face.usda"), Path("talk.csv")])
        )
    elif way < 0.3:
        old = rng.choice([b"tables/names.csv", b"../library", b'"studio"', b"lib"])
        file.write_bytes(_elsewhere(rng, file.read_bytes(), old))
    else:
        file.write_bytes(damage.damaged_toml(rng, file.read_bytes()))
    batch.Processes = AtOnce  # type: ignore[misc, assignment]
    return [rng.choice(PROJECT_LINES)]


FARM: dict[str, Format] = {
    "ledgers": Format({"run": put_run}, damage_ledger, writes=("built", "show_batch"), keeps=("built", "show_batch")),
    "caches": Format(
        {"run": put_run, "store": lambda: put_run("store")},
        damage_cache,
        writes=("",),  # where links lead, below the roots
        keeps=("built", "show_batch", "cache"),
    ),
    "plans": Format({table: put_plan(table) for table in TABLES}, damage_plan, writes=("",), keeps=("show_batch",)),
    "project files": Format({"project": put_project_file}, damage_project_file, keeps=("out_state",)),
}
