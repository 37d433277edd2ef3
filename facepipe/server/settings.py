"""How a server is run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from facepipe.declare import Ranged, option


@dataclass(frozen=True, kw_only=True)
class Settings(Ranged):
    """How a server is run."""

    host: str = option(
        "127.0.0.1", "address or name to listen at; elsewhere than on this machine every request needs a token"
    )
    port: int = option(8000, "port; 0 takes one that is free", 0, 65535)
    origin: tuple[str, ...] = option((), "address that browsers reach it by, where a proxy has another", metavar="URL")
    tls_cert: Path | None = option(None, "certificate, for HTTPS: browsers give no camera without", metavar="PEM")
    tls_key: Path | None = option(None, "its key", metavar="PEM")
    processes: int | None = option(None, "processes that do jobs (default: a core each)", 1, 1024)
    cluster: str | None = option(None, "do jobs on a Dask cluster: tcp://HOST:PORT of its scheduler", metavar="ADDRESS")
    database: str | None = option(
        None, "rows in PostgreSQL: postgresql+psycopg://... (default: FOLDER/serve.db)", metavar="URL"
    )
    artefacts: str | None = option(
        None, "files in a store: s3://BUCKET/FOLDER (default: FOLDER/artefacts)", metavar="URL"
    )
    retain: bool = option(False, "keep photos after their jobs")
    seconds: float = option(1800.0, "limit on the time of a job", 1.0, 1e6, "s")
    memory_mb: float = option(8000.0, "limit on the memory of a job's process", 200.0, 1e7, "MB")
    sessions: int = option(16, "blends and faces at most that are kept ready for edits", 1, 1000)
    sessions_mb: float = option(8192.0, "limit on the memory of these", 100.0, 1e7, "MB")
    upload_mb: float = option(500.0, "limit on what is sent at once", 1.0, 1e5, "MB")
    quota_gb: float = option(20.0, "limit on what a tenant keeps", 1e-6, 1e6, "GB")
    rate: float = option(50.0, "requests a second that a client may ask for, ten seconds' worth at once", 1.0, 1e6)
