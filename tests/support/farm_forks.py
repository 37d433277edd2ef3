"""Processes for tasks, forked from one that has loaded what they need: a tenth of a second instead of one."""

from __future__ import annotations

import gc
import multiprocessing
import os
import sys
from collections.abc import Mapping
from multiprocessing.connection import Connection
from typing import IO, Any

from facepipe.core.policy.children import environment

_FORKS: Any = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(["farm_child", "s3fs"])


class Fork:
    """What `facepipe.tasks.child` asks of a process that `children.start` starts, for the program `farm_child`."""

    def __init__(self, words: list[str], more: Mapping[str, str], **pipes: Any) -> None:
        """:param words, pipes: not used: the program and its pipes are always the same"""
        requests, stdin = _FORKS.Pipe(duplex=False)
        stdout, answers = _FORKS.Pipe(duplex=False)
        self._process = _FORKS.Process(target=_run, args=(requests, answers, environment(more)), daemon=True)
        self._process.start()
        self.pid: int = self._process.pid
        self.stdin: IO[bytes] = os.fdopen(os.dup(stdin.fileno()), "wb")
        self.stdout: IO[bytes] = os.fdopen(os.dup(stdout.fileno()), "rb")
        for end in (requests, stdin, stdout, answers):
            end.close()

    def kill(self) -> None:
        """Send SIGKILL."""
        self._process.kill()

    def wait(self) -> int:
        """Its exit code, or a negative signal."""
        self._process.join()
        return int(self._process.exitcode)


def _run(requests: Connection, answers: Connection, variables: Mapping[str, str]) -> None:
    os.environ.clear()
    os.environ.update(variables)
    for end, number in ((requests.fileno(), 0), (answers.fileno(), 1), (os.open(os.devnull, os.O_WRONLY), 2)):
        os.dup2(end, number)
    requests.close(), answers.close()
    sys.stdin = os.fdopen(0)  # that of a forked process is closed
    gc.freeze()  # what was loaded before is never garbage: each task looks for some
    import farm_child

    farm_child.main(farm_child.read_line)
