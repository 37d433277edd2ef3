"""Node programs that the tests call: the Khronos glTF validator, three.js, three-vrm and onnxruntime-web."""

from __future__ import annotations

import functools
import json
import shutil
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

HERE = Path(__file__).parent / "js"
_INSTALLED = HERE / "node_modules" / ".package-lock.json"
_PATIENCE = 900  # seconds


@functools.cache
def node_packages() -> str:
    """The node program, with the packages of tests/support/js/package-lock.json in place.

    Skips the test where node is not installed; fails it where the packages can't be.
    """
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("needs node and npm on the PATH")
    lock = HERE / ".installing"
    for _ in range(_PATIENCE):  # several test processes may come here at once
        if _is_installed():
            return node
        try:
            lock.mkdir()
        except FileExistsError:
            time.sleep(1)
            continue
        try:
            _install(npm)
        finally:
            lock.rmdir()
    pytest.fail(f"node packages were not installed in {_PATIENCE} s; remove {lock} if no test run is under way")


def validate(files: Sequence[Path]) -> dict[Path, dict[str, Any]]:
    """The Khronos validator's report on each file."""
    if not files:
        return {}
    reports = run_node("validate.mjs", [str(file) for file in files])
    return {Path(name): report for name, report in reports.items()}


def three_load(file: Path, weights: Mapping[str, float], joints: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    """What three.js makes of a GLB under target weights and local joint matrices (16 numbers, column-major)."""
    answer: dict[str, Any] = run_node("three_load.mjs", [str(file)], json.dumps({"weights": weights, "joints": joints}))
    return answer


def vrm_load(file: Path, poses: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What three-vrm makes of a .vrm in each of the poses (tests/support/js/vrm_load.mjs)."""
    answer: dict[str, Any] = run_node("vrm_load.mjs", [str(file)], json.dumps(poses))
    return answer


def vrm_facts(file: Path) -> dict[str, Any]:
    """What three-vrm knows of the avatar in a .vrm (tests/support/js/vrm_facts.mjs)."""
    facts: dict[str, Any] = run_node("vrm_facts.mjs", [str(file)])
    return facts


def three_play(file: Path, clip: str, times: Sequence[float], out: Path) -> tuple[dict[str, Any], np.ndarray]:
    """What three.js shows of an animation: its meshes, and (times, vertices, 3) world positions, kept in `out`."""
    request = json.dumps({"clip": clip, "times": list(times)})
    answer: dict[str, Any] = run_node("three_play.mjs", [str(file), str(out)], request)
    return answer, np.memmap(out, np.float32, "r").reshape(len(times), -1, 3)


def onnx_run(file: Path, feeds: Sequence[Mapping[str, np.ndarray]]) -> list[dict[str, np.ndarray]]:
    """The outputs of an ONNX model in onnxruntime-web for each of `feeds`, float32."""
    requests = [
        {name: {"dims": values.shape, "data": values.ravel().tolist()} for name, values in feed.items()}
        for feed in feeds
    ]
    answers = run_node("onnx_run.mjs", [str(file)], json.dumps(requests))
    return [
        {name: np.array(one["data"], np.float32).reshape(one["dims"]) for name, one in answer.items()}
        for answer in answers
    ]


def meshopt_encode(requests: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Arrays compressed with meshoptimizer, and what its own decoder makes of them."""
    answers: list[dict[str, str]] = run_node("meshopt_encode.mjs", [], json.dumps(requests))
    return answers


def run_node(script: str, arguments: Sequence[str], request: str = "") -> Any:
    """What a script of tests/support/js answers, JSON on its stdout, to a request on its stdin."""
    command = [node_packages(), str(HERE / script), *arguments]
    done = subprocess.run(command, input=request, capture_output=True, text=True, encoding="utf-8", check=False)
    if done.returncode:
        pytest.fail(f"{script}: {done.stderr[-2000:]}")
    return json.loads(done.stdout)


def _is_installed() -> bool:
    if not _INSTALLED.is_file():
        return False
    wanted = json.loads((HERE / "package-lock.json").read_text())["packages"]
    present = json.loads(_INSTALLED.read_text())["packages"]
    return all(present.get(name, {}).get("version") == entry["version"] for name, entry in wanted.items() if name)


def _install(npm: str) -> None:
    done = subprocess.run(
        [npm, "ci", "--no-audit", "--no-fund", "--ignore-scripts"],
        cwd=HERE,
        capture_output=True,
        text=True,
        check=False,
        timeout=_PATIENCE,
    )
    if done.returncode:
        pytest.fail(f"npm ci failed in {HERE}: {done.stderr[-2000:]}")
