"""Requests of any kind to a server, drawn from its OpenAPI by schemathesis: none is answered with 5xx or against it.

First operations by themselves, then along links: what one answer names is asked for next. Some faces are there before,
so that links lead somewhere.

usage: python tests/support/fuzz_api.py --seconds 60 --seed 41 [--st PROGRAM]
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from faces import tiny_face
from served import Served, kept, saved

CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "ensure_resource_availability",
)
PARTS = {"examples,coverage,fuzzing": 0.4, "stateful": 0.6}  # phases -> their share of the time


def main() -> int:
    """The exit code: 1 for a finding, or where no link was followed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--seed", type=int, default=41)
    parser.add_argument("--st", default="st", help="schemathesis, which has an environment of its own")
    given = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        served = Served(folder / "state", "--rate", "100000", "--processes", "1")
        try:
            for seed in range(3):
                kept(served.client, saved(tiny_face(seed), folder / f"head{seed}.usdc"))
            for part, share in PARTS.items():
                words = [given.st, "run", f"{served.url}api/v1/openapi.json", "--phases", part, "--no-color"]
                words += ["--checks", ",".join(CHECKS), "--seed", str(given.seed), "--warnings", "off"]
                words += ["--max-time", str(max(1, round(share * given.seconds)))]
                run = subprocess.run(words, cwd=folder, stdout=subprocess.PIPE, text=True, check=False)
                print(run.stdout)
                failed |= run.returncode != 0
            followed = re.search(r"API Links: +(\d+) covered", run.stdout)
            failed |= followed is None or int(followed[1]) == 0
        finally:
            served.stop()
        errors = [line for line in served.log.read_text().splitlines() if '"level": "error"' in line]
        print("\n".join(errors[:20]))
    return int(failed or bool(errors))


if __name__ == "__main__":
    sys.exit(main())
