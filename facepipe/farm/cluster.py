"""Who does tasks on a Dask cluster: each thread of its workers has a process of its own for them.

Dask (https://distributed.dask.org) gives tasks to workers and to others where a worker is lost; limits of a task, and
faults that end its process, are those of `facepipe.farm.child`, as on one machine.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import threading
from collections.abc import Mapping
from typing import Any

from facepipe.core import __version__
from facepipe.core.errors import InputError
from facepipe.farm.child import Child
from facepipe.farm.engines import LOST, Done, answer
from facepipe.farm.ledger import Record

_PATIENCE = 30.0  # seconds for a scheduler to answer
_WORKERS = 120.0  # seconds for a first worker
_own = threading.local()  # the process of a worker's thread


class Cluster:
    """The workers of a scheduler."""

    def __init__(self, address: str, setting: Mapping[str, Any]) -> None:
        """
        :param address: ``tcp://HOST:PORT`` of a scheduler, or ``ssh://HOST,HOST`` to start one on the first host and a
            worker on each
        :raises InputError: Dask is not installed, no scheduler answers, none has a worker, or one of another facepipe
        """
        try:
            from distributed import Client
        except ImportError:
            raise InputError("--cluster", "needs Dask: pip install 'facepipe[farm]'") from None
        self._setting = dict(setting)
        self._ends = contextlib.ExitStack()
        try:
            target: Any = self._ends.enter_context(_over_ssh(address)) if address.startswith("ssh://") else address
            self._client = self._ends.enter_context(Client(target, timeout=_PATIENCE, set_as_default=False))
            self._client.wait_for_workers(1, timeout=_WORKERS)
            _check_versions(self._client.run(_version))
        except (OSError, TimeoutError, ValueError, RuntimeError) as error:
            self._ends.close()
            raise InputError(f"--cluster {address}", f"can't be used: {' '.join(str(error).split())[:200]}") from None
        except BaseException:
            self._ends.close()
            raise

    @property
    def dashboard(self) -> str:
        """Where Dask shows what is going on."""
        return str(self._client.dashboard_link or "")

    def submit(self, request: Mapping[str, Any], order: tuple[int, ...], done: Done) -> None:
        """Do a task, before those of a higher order."""
        said = json.dumps([request, self._setting], sort_keys=True).encode()
        key = f"facepipe-{request['task']}-{hashlib.sha256(said).hexdigest()[:32]}"
        settings: Any = {"key": key, "pure": False, "priority": -order[0]}
        future = self._client.submit(_do, dict(request), self._setting, **settings)

        def ended(future: Any) -> None:
            done(_answer_of(future, request))

        future.add_done_callback(ended)

    def close(self) -> None:
        """End; what is being done is lost."""
        self._ends.close()


def _answer_of(future: Any, request: Mapping[str, Any]) -> Record:
    record: Record = {"task": request["task"], "words": request["words"], "status": LOST}
    if future.status == "finished":
        try:
            found: Record = future.result(timeout=_PATIENCE)
            return found
        except Exception as error:  # gathering it found no worker
            return {**record, "error": f"{request['task']}: its worker was lost ({type(error).__name__})"}
    if future.status == "cancelled":
        return {**record, "error": f"{request['task']}: the cluster is gone", "gone": True}
    return {**record, "error": f"{request['task']}: its workers were lost ({type(future.exception()).__name__})"}


def _do(request: Mapping[str, Any], setting: Mapping[str, Any]) -> Record:
    """Do a task in the process of this thread."""
    child = getattr(_own, "child", None)
    if child is None or _own.setting != setting:
        if child is not None:
            child.end()
        _own.child, _own.setting = Child(setting), dict(setting)
    return answer(_own.child, request)


def _version() -> str:
    return __version__


def _check_versions(found: Mapping[str, str]) -> None:
    """:raises InputError: a worker of another facepipe"""
    for worker, version in found.items():
        if version != __version__:
            raise InputError(worker, f"has facepipe {version}, expected {__version__}")


@contextlib.contextmanager
def _over_ssh(address: str) -> Any:
    from distributed import SSHCluster

    hosts = [one for one in address.removeprefix("ssh://").split(",") if one]
    if not hosts:
        raise InputError(f"--cluster {address}", "no host, expected ssh://HOST,HOST")
    with SSHCluster([hosts[0], *hosts], worker_options={"nthreads": 1}) as cluster:
        yield cluster
