"""Makes all that is generated: `python schemas/generate.py [--check]`.

generatedSchema.usda and plugInfo.json are made of schema.usda; `manifest` beside this file has the rest. With --check
nothing is written: the exit code says whether the committed files are up to date.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import manifest

FOLDER = Path(__file__).parent / "facepipe_schemas"
FILES = ("generatedSchema.usda", "plugInfo.json")


def generate(out: Path) -> None:
    """Run usdGenSchema on schema.usda and write both files into `out`."""
    command = [sys.executable, "-m", "pxr.Usd.usdGenSchema", str(FOLDER / "schema.usda"), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{FOLDER / 'schema.usda'}: usdGenSchema failed: {done.stderr.strip() or done.stdout.strip()}")
    plug_info = out / "plugInfo.json"
    text = plug_info.read_text()
    # the plugin description without the build system's placeholders: a resource plugin in its own folder
    info: dict[str, object] = json.loads(re.sub(r"^#.*$", "", text, flags=re.MULTILINE))
    for plugin in info["Plugins"]:  # type: ignore[attr-defined]
        plugin.update(Type="resource", Root=".", LibraryPath="", ResourcePath=".")
    plug_info.write_text(json.dumps(info, indent=4, sort_keys=True) + "\n")
    generated = out / "generatedSchema.usda"
    # put the full documentation back: usdGenSchema keeps only first sentences, hosts show what is in this file
    from pxr import Sdf

    source, target = Sdf.Layer.FindOrOpen(str(FOLDER / "schema.usda")), Sdf.Layer.FindOrOpen(str(generated))
    for prim in target.rootPrims:
        written = source.GetPrimAtPath(prim.path)
        prim.documentation = written.documentation
        prim.ClearInfo("customData")
        for attribute in prim.properties:
            # a multiple-apply schema's properties gain the namespace and instance name in front
            own = [one for one in written.properties if attribute.name.split(":")[-1] == one.name.split(":")[-1]]
            attribute.documentation = own[0].documentation
            attribute.ClearInfo("customData")
    target.Save()


def main() -> int:
    """Write the files, or compare them."""
    with tempfile.TemporaryDirectory() as folder:
        generate(Path(folder))
        made = {FOLDER / name: Path(folder, name).read_text(encoding="utf-8") for name in FILES}
    made |= manifest.made()
    stale = [file for file, text in made.items() if not file.exists() or file.read_text(encoding="utf-8") != text]
    if "--check" in sys.argv[1:]:
        names = ", ".join(file.name for file in stale)
        print(f"out of date: {names}; `python schemas/generate.py` makes them" if stale else "all is up to date")
        return bool(stale)
    for file in stale:
        file.write_text(made[file], encoding="utf-8", newline="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
