"""What samples/server has containers do, done on this machine: its lines of pip, its commands, PostgreSQL and S3."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import httpx
import pytest
import s3_server
import yaml
from places import REPOSITORY
from postgres import Postgres
from served import PATIENCE, kept

FOLDER = REPOSITORY / "samples" / "server"
DOCKERFILE = (FOLDER / "Dockerfile").read_text(encoding="utf-8")
COMPOSE: dict[str, Any] = yaml.safe_load((FOLDER / "compose.yaml").read_text(encoding="utf-8"))
SECRETS = {"FACES_NAME": "faces.example.com", "DATABASE_PASSWORD": "x", "STORE_KEY": "key", "STORE_SECRET": "secret"}


def told(text: str) -> str:
    """With the values of an .env in place."""
    return re.sub(r"\$\{(\w+):\?\}", lambda found: SECRETS[found[1]], text)


def steps(name: str) -> list[str]:
    """The words of an instruction, one after another."""
    return re.findall(rf"^{name} (.+)$", DOCKERFILE, re.MULTILINE)


def test_files_name_what_there_is() -> None:
    """Sources that are copied, extras, services, volumes and the port."""
    copied = [word for line in steps("COPY") if not line.startswith("--from") for word in line.split()[:-1]]
    assert [name for name in copied if not (REPOSITORY / name).exists()] == []
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {one for line in re.findall(r"EXTRAS=([\w,]+)", DOCKERFILE) for one in line.split(",")}
    assert named == {"server", "train"}
    assert named <= set(extras)
    services, faces = COMPOSE["services"], COMPOSE["services"]["faces"]
    assert (FOLDER / faces["build"]["context"] / faces["build"]["dockerfile"]).samefile(FOLDER / "Dockerfile")
    assert set(faces["depends_on"]) <= set(services)
    volumes = {line.partition(":")[0] for one in services.values() for line in one.get("volumes", ())}
    assert volumes == set(COMPOSE["volumes"])
    assert faces["ports"] == ["127.0.0.1:8000:8000"], "no password or token crosses a network without TLS"
    assert not re.search(r"password|secret", re.sub(r"\$\{\w+:\?\}|[A-Z_]+", "", json.dumps(services)), re.IGNORECASE)


@pytest.mark.slow
def test_its_steps_serve_faces_from_postgresql_and_s3(tmp_path: Path, postgres: Postgres, heads: list[Path]) -> None:
    """The wheel from the copied sources alone, in a fresh environment; then the four lines of compose.yaml."""
    source = tmp_path / "src"
    for line in steps("COPY"):
        for word in line.split()[:-1] if not line.startswith("--from") else ():
            if (REPOSITORY / word).is_dir():
                ignored = shutil.ignore_patterns("node_modules", "__pycache__")
                shutil.copytree(REPOSITORY / word, source / word, ignore=ignored)
            else:
                source.mkdir(exist_ok=True)
                shutil.copy(REPOSITORY / word, source)
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    path = f"{tmp_path / 'venv' / 'bin'}{os.pathsep}{os.environ['PATH']}"
    own = {**os.environ, "PATH": path, "EXTRAS": "server"}
    own.pop("PYTHONPATH", None)
    for line in steps("RUN"):
        if line.startswith("pip "):
            words = line.replace("/wheels", str(tmp_path / "wheels")).replace("--no-cache-dir", "--quiet")
            subprocess.run(["bash", "-euc", words], cwd=source, env=own, check=True)
    with s3_server.serving() as store:
        rows = f"facepipe@127.0.0.1:{postgres.port}/postgres"
        places = {
            "facepipe@database/facepipe": rows,
            "/faces": str(tmp_path / "faces"),
            "http://store:9000": store.address,
        }

        def here(text: object) -> str:
            word = told(str(text))
            return places.get(word) or word.replace("facepipe@database/facepipe", rows)

        def line(name: str, *instead: str) -> list[str]:
            one = COMPOSE["services"][name]
            program, *words = [*map(here, one["entrypoint"]), *(instead or map(here, one["command"]))]
            return [str(tmp_path / "venv" / "bin" / program), *words]

        own |= {name: here(value) for name, value in COMPOSE["services"]["faces"]["environment"].items()}
        subprocess.run(line("bucket"), env=own, check=True)
        (tmp_path / "faces").mkdir()
        added = line("faces", "token", "add", "studio")
        token = subprocess.run(added, env=own, check=True, capture_output=True, text=True).stdout.strip()
        with subprocess.Popen([*line("faces"), "--port", "0"], env=own, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            try:
                port = httpx.URL(server.stdout.readline().split()[0]).port
                head = {"Authorization": f"Bearer {token}", "Host": SECRETS["FACES_NAME"]}
                asked: Any = {"base_url": f"http://127.0.0.1:{port}", "timeout": PATIENCE, "trust_env": False}
                with httpx.Client(headers=head, **asked) as client:
                    face = kept(client, heads[0])
                    assert client.get(f"/api/v1/faces/{face}/versions/1/face.glb").content[:4] == b"glTF"
                    assert client.get("/").status_code == 200
                    assert client.get("/studio.html").text.startswith("<!doctype html>")
                    assert client.get("/api/v1/me", headers={"Authorization": ""}).status_code == 401
            finally:
                server.terminate()
        assert server.returncode == 0
        assert any(face in one for one in store.asked if one.startswith("PUT /faces/server/"))
    assert not (tmp_path / "faces" / "serve.db").exists()
