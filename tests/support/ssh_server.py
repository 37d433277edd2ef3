"""A server of ssh for this user on a port of its own, and a home whose `.ssh` reaches it as localhost."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from getpass import getuser
from pathlib import Path

from farm_cluster import until

SSHD = shutil.which("sshd", path=os.pathsep.join((os.environ["PATH"], "/usr/sbin")))


@contextmanager
def ssh_server(folder: Path) -> Iterator[Path]:
    """A server while the block runs: the home from which it is reached."""
    home = folder / "home"
    own = home / ".ssh"
    own.mkdir(parents=True, mode=0o700)
    for path in (own / "id_ed25519", folder / "host"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", path], check=True)
    shutil.copy(own / "id_ed25519.pub", own / "authorized_keys")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (own / "config").write_text(f"Host localhost\n  HostName 127.0.0.1\n  Port {port}\n  User {getuser()}\n")
    (own / "known_hosts").write_text(f"[127.0.0.1]:{port} {(folder / 'host.pub').read_text()}")
    if os.geteuid() == 0:  # where root's sshd leaves its rights
        Path("/run/sshd").mkdir(exist_ok=True)
    settings = {
        "ListenAddress": f"127.0.0.1:{port}",
        "HostKey": folder / "host",
        "AuthorizedKeysFile": own / "authorized_keys",
        "PasswordAuthentication": "no",
        "PidFile": "none",
        "StrictModes": "no",
        "UsePAM": "no",
    }
    (folder / "sshd_config").write_text("".join(f"{key} {value}\n" for key, value in settings.items()))
    server = subprocess.Popen([str(SSHD), "-D", "-e", "-f", folder / "sshd_config"], stderr=(folder / "log").open("w"))
    try:
        until(lambda: "listening" in (folder / "log").read_text())
        yield home
    finally:
        server.terminate()
        server.wait()
