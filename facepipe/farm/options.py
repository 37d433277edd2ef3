"""How a plan is run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from facepipe.declare import option


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Limits of tasks, what is done again, and where results are kept."""

    seconds: float = option(3600.0, "a task may take; its process is ended then", 0.1, 1e7, "s")
    memory_mb: float | None = option(None, "a task's process may have (needs psutil)", 50.0, 1e7, "MB")
    failures: int = option(3, "processes or workers that a task may lose before it counts as failed", 0, 1000)
    retry_failed: bool = option(False, "do tasks again that failed, though nothing that they read has changed")
    resume: bool = option(False, "take what is done as it is, whatever has changed since: end a run that was killed")
    local: Path | None = option(None, "folder of each machine for copies of files at URLs (default ~/.cache/facepipe)")
    local_gb: float = option(20.0, "they may have; what was used longest ago goes first", 0.001, 1e6, "GB")
    cache: Path | None = option(None, "folder of results by their content, which plans and runs share")
    cache_gb: float = option(20.0, "the cache may have; what was used longest ago goes first", 0.001, 1e6, "GB")
