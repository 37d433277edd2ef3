"""The codeless schemas: up to date, documented, registered both ways, and what `tokens` names."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import facepipe_schemas
import pytest
from places import REPOSITORY
from pxr import Sdf, Usd

from facepipe.core import tokens


@pytest.mark.skipif(Usd.GetVersion() < (0, 26, 5), reason="usdGenSchema of older usd-core lacks the base schemas")
def test_generated_files_are_up_to_date() -> None:
    command = [sys.executable, str(REPOSITORY / "schemas" / "generate.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_attribute_states_range_and_units() -> None:
    layer = Sdf.Layer.FindOrOpen(str(facepipe_schemas.path() / "generatedSchema.usda"))
    attributes = [attribute for prim in layer.rootPrims for attribute in prim.properties]
    assert len(attributes) >= 20
    for attribute in attributes:
        assert re.search(r"Range: .+ Units: .+\.", attribute.documentation, re.DOTALL), attribute.path


@pytest.mark.parametrize("name", [value for name, value in vars(tokens).items() if name.endswith("_API")])
def test_registered_on_import(name: str) -> None:
    definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(name)
    layer = Sdf.Layer.FindOrOpen(str(facepipe_schemas.path() / "generatedSchema.usda"))
    declared = [attribute.name for attribute in layer.GetPrimAtPath(f"/{name}").properties]
    assert declared
    assert sorted(definition.GetPropertyNames()) == sorted(declared)


def test_registered_through_the_plugin_path() -> None:
    program = (
        "from pxr import Usd\n"
        "stage = Usd.Stage.CreateInMemory()\n"
        "prim = stage.DefinePrim('/Face', 'SkelRoot')\n"
        "assert prim.ApplyAPI('FacepipeFaceAPI')\n"
        "assert prim.GetAttribute('facepipe:attachJoint').Get() == ''\n"
        "mesh = stage.DefinePrim('/Face/Head', 'Mesh')\n"
        "assert mesh.ApplyAPI('FacepipeRegionAPI', 'mouth')\n"
        "assert mesh.GetAttribute('primvars:facepipe:region:mouth').GetTypeName() == 'float[]'\n"
        "assert not prim.CanApplyAPI('FacepipeAnchorAPI')\n"
    )
    environment = {**os.environ, "PXR_PLUGINPATH_NAME": str(facepipe_schemas.path())}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_tokens_are_the_schemas_attributes() -> None:
    layer = Sdf.Layer.FindOrOpen(str(facepipe_schemas.path() / "generatedSchema.usda"))
    names = {attribute.name for prim in layer.rootPrims for attribute in prim.properties}
    own = [value for value in vars(tokens).values() if isinstance(value, str) and re.match(r"facepipe:.*[a-z]$", value)]
    assert len(own) >= 10
    others = {
        tokens.SEAM_RESIDUAL,
        tokens.SCANNED,
        tokens.ARRAYS_OF,
        tokens.DATA_LABEL,
        tokens.UNLIT,
        tokens.SHEEN_COLOR,
        tokens.SHEEN_ROUGHNESS,
    }  # plain primvars of results, data of layers and prims
    assert set(own) - others <= names


def test_one_module_applies_and_finds_our_schemas() -> None:
    """USD's own calls do nothing where its registry was built before (test_late_schemas)."""
    calls = re.compile(
        r"GetAppliedSchemas\(|\.(Apply|Remove|Has)API\((tokens\.|[\"']Facepipe)|IsAllowedAPISchemaInstance"
    )
    files = [file for folder in ("facepipe", "exporters") for file in (REPOSITORY / folder).rglob("*.py")]
    assert len(files) > 300
    assert [file.name for file in files if calls.search(file.read_text(encoding="utf-8"))] == []
