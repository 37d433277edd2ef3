"""How a plan is run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from facepipe.declare import option


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Limits of tasks, what is done again, and where results are kept."""

    seconds: float = option(3600.0, "limit on the time of a task; its process is ended then", 0.1, 1e7, "s")
    memory_mb: float | None = option(None, "limit on the memory of a task's process (needs psutil)", 50.0, 1e7, "MB")
    failures: int = option(3, "processes or workers that a task may lose before it counts as failed", 0, 1000)
    retry_failed: bool = option(False, "do failed tasks again, even if nothing that they read has changed")
    resume: bool = option(False, "take finished tasks as they are, whatever has changed since: ends a killed run")
    verify: bool = option(False, "compare the digests of all that is kept; what differs is done again")
    local: Path | None = option(None, "folder on each machine for copies of files at URLs (default ~/.cache/facepipe)")
    local_gb: float = option(20.0, "limit on these copies; the least recently used go first", 0.001, 1e6, "GB")
    cache: Path | None = option(None, "folder of results by content, shared by plans and runs")
    cache_gb: float = option(20.0, "limit on the cache; the least recently used go first", 0.001, 1e6, "GB")
