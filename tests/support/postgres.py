"""A server of PostgreSQL for tests, where it is installed."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
from contextlib import closing
from pathlib import Path
from typing import Any


def program(name: str) -> str | None:
    found = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"))
    return str(found[-1]) if found else shutil.which(name)


class Postgres:
    """A server of PostgreSQL in a folder, which can be ended and started again."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._as = folder, {"user": "nobody", "group": "nogroup"} if os.getuid() == 0 else {}
        with closing(socket.socket()) as one:
            one.bind(("127.0.0.1", 0))
            self.port = one.getsockname()[1]
        if self._as:
            shutil.chown(folder, "nobody", "nogroup")
        self._run("initdb", "-D", str(folder / "data"), "-U", "facepipe", "--auth", "trust", "-E", "UTF8")
        self.start()
        self.url = f"postgresql+psycopg://facepipe@127.0.0.1:{self.port}/postgres"

    def start(self) -> None:
        """Start it, and wait until it answers."""
        options = f"-p {self.port} -k {self._folder} -c listen_addresses=127.0.0.1 -c fsync=off"
        self._run("pg_ctl", "-D", str(self._folder / "data"), "-w", "-o", options, "-l", "/dev/null", "start")

    def stop(self) -> None:
        """End it at once."""
        self._run("pg_ctl", "-D", str(self._folder / "data"), "-m", "immediate", "stop")

    def _run(self, name: str, *words: str) -> None:
        found = program(name)
        assert found
        own: Any = {**self._as, "cwd": self._folder, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        done = subprocess.run([found, *words], check=False, **own)
        assert done.returncode == 0, done.stderr.decode()
