"""The extension installed as a user does, then a face in and out: ZIP FACE OUT."""

import json
import sys

import bpy

import addon_utils  # isort: skip  (Blender's, there only then)

addon, face, out = map(json.loads, sys.argv[1:])
bpy.ops.wm.read_factory_settings(use_empty=True)
addon_utils.enable("bl_pkg", default_set=False)
bpy.ops.extensions.package_install_files(filepath=addon, repo="user_default", enable_on_install=True)
assert "bl_ext.user_default.facepipe" in sys.modules
bpy.ops.wm.usd_import(filepath=face)
bpy.ops.wm.usd_export(filepath=out)
