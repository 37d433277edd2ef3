"""Who a server works for: tenants, their tokens, all that it keeps of one, and its end."""

from __future__ import annotations

import hashlib
import json
import secrets
import shutil
import time
import zipfile
from typing import Any, BinaryIO

import sqlalchemy as sa

from facepipe.core.errors import InputError
from facepipe.core.names import did_you_mean
from facepipe.server.library import Library, Version, new_id
from facepipe.server.tables import ARTEFACTS, CONSENTS, FACES, JOBS, TENANTS, TOKENS, VERSIONS, Database
from facepipe.server.uploads import Uploads

LOCAL = "local"  # the tenant of who asks without a token, on this machine
_MOST_NAME = 80


def tenant_named(database: Database, name: str) -> str:
    """The id of a tenant, which is made where it isn't there.

    :raises InputError: no name for one
    """
    if not name.isprintable() or not 0 < len(name) <= _MOST_NAME:
        raise InputError("TENANT", f"expected a name of up to {_MOST_NAME} printable characters")
    with database.write() as rows:
        found = rows.scalar(sa.select(TENANTS.c.id).where(TENANTS.c.name == name))
        if found is None:
            found = new_id()
            rows.execute(TENANTS.insert().values(id=found, name=name, created=time.time()))
    return str(found)


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


def add_token(database: Database, name: str) -> str:
    """A new token of a tenant, which only who asks for it sees: its digest is kept."""
    tenant, token = tenant_named(database, name), secrets.token_urlsafe(32)
    with database.write() as rows:
        rows.execute(TOKENS.insert().values(digest=_digest(token), tenant=tenant, created=time.time()))
    return token


def tenants(database: Database) -> dict[str, int]:
    """Tenant -> how many tokens it has."""
    counted = sa.select(TENANTS.c.name, sa.func.count(TOKENS.c.digest).label("tokens"))
    with database.read() as rows:
        found = rows.execute(counted.outerjoin(TOKENS).group_by(TENANTS.c.name).order_by(TENANTS.c.name))
        return {one.name: one.tokens for one in found}


def revoke(database: Database, name: str) -> int:
    """Take all tokens of a tenant back; how many.

    :raises InputError: no such tenant
    """
    known = tenants(database)
    if name not in known:
        raise InputError("TENANT", f"no such tenant{did_you_mean(name, known)}")
    with database.write() as rows:
        own = sa.select(TENANTS.c.id).where(TENANTS.c.name == name).scalar_subquery()
        return int(rows.execute(TOKENS.delete().where(TOKENS.c.tenant == own)).rowcount)


def tenant_of(database: Database, token: str) -> str | None:
    """The tenant that a token is of; None where it is nobody's."""
    with database.read() as rows:
        found = rows.scalar(sa.select(TOKENS.c.tenant).where(TOKENS.c.digest == _digest(token)))
        return None if found is None else str(found)


def name_of(database: Database, tenant: str) -> str:
    """A tenant's name."""
    with database.read() as rows:
        return str(rows.scalar(sa.select(TENANTS.c.name).where(TENANTS.c.id == tenant)))


def export(library: Library, tenant: str, out: BinaryIO) -> None:
    """Write all that is kept of a tenant as a ZIP: files as ``faces/FACE/VERSION/...``, rows as JSON."""
    rows_of: dict[str, list[dict[str, Any]]] = {}
    with library.database.read() as rows:
        faces = sa.select(FACES.c.id).where(FACES.c.tenant == tenant)
        asked = {
            "faces": sa.select(FACES).where(FACES.c.tenant == tenant),
            "versions": sa.select(VERSIONS).where(VERSIONS.c.face.in_(faces)),
            "jobs": sa.select(JOBS).where(JOBS.c.tenant == tenant),
            "consents": sa.select(CONSENTS).where(CONSENTS.c.tenant == tenant),
            "files": sa.select(ARTEFACTS).where(ARTEFACTS.c.face.in_(faces)),
        }
        for name, select in asked.items():
            rows_of[name] = [dict(row) for row in rows.execute(select).mappings()]
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as file:
        file.writestr("rows.json", json.dumps(rows_of, indent=1))
        for one in rows_of["files"]:
            name = f"faces/{Version(one['face'], one['version']).folder}/{one['path']}"
            with (
                library.open(tenant, one["face"], one["digest"]) as kept,
                file.open(name, "w", force_zip64=True) as copy,
            ):
                shutil.copyfileobj(kept, copy)


def delete(library: Library, uploads: Uploads, tenant: str) -> list[str]:
    """Delete a tenant with all that is kept of it, tokens and jobs too; the jobs that had not ended."""
    uploads.remove_of(tenant)
    with library.database.write() as rows:
        waits = sa.select(JOBS.c.id).where(JOBS.c.tenant == tenant, JOBS.c.state.in_(("queued", "running")))
        ended = list(rows.scalars(waits))
        known = rows.execute(sa.select(TENANTS).where(TENANTS.c.id == tenant)).mappings().first()
        rows.execute(TENANTS.delete().where(TENANTS.c.id == tenant))
        if known is not None and known["name"] == LOCAL:  # who asks without a token goes on, with nothing
            rows.execute(TENANTS.insert().values(**known))
    library.artefacts.remove(tenant)
    library.database.forget()
    return ended
