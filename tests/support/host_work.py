"""What a program does with a face, in the folder it runs in: every attribute written, read, changed and taken away."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from full_faces import full_face
from pxr import Usd

import facepipe
from facepipe.cli import main
from facepipe.core.errors import InputError
from facepipe.parts import SliderNetwork
from facepipe.stage import save_parts
from facepipe.stage.author_changes import author_changes
from facepipe.stage.recipes import author_neural_rig_link, read_neural_rig_link

COMMANDS = (
    "sliders face.usda --set open=0.75 -o person.usda",
    "landmarks face.usda --from points.json --scheme mine -o marked.usdc",
    "export face.usda -o face.glb --animations",
    "export person.usda -o person.glb",
    "validate face.usda person.usda marked.usdc bare.usda face.glb",
    "inspect face.usda --json",
)


def work() -> None:
    """Write files; what is said in the last line is whether USD knows the schemas."""
    known = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition("FacepipeFaceAPI") is not None
    network = SliderNetwork(sliders=("open",), shapes=("jawOpen",), weights=(np.ones((1, 1)),), biases=(np.ones(1),))
    parts = replace(full_face(), slider_network=network)
    save_parts(parts, "face.usda")
    face = facepipe.open("face.usda")
    np.save("posed.npy", face.evaluate({"jawOpen": 0.5}, sliders={"open": 0.75}))
    with face.deriving("linked.usda") as derived:
        author_neural_rig_link(derived.prim, "rig.fpnr", "sha256:0", "sha256:1")
    linked = facepipe.open("linked.usda")
    link = read_neural_rig_link(linked.prim)
    assert link is not None
    assert link.file == "rig.fpnr"
    with face.deriving("bare.usda") as derived:
        head, *others = face.meshes
        bare = replace(face.parts(), sliders=(), slider_network=None, recipe=None, bone_limits=None, photos=())
        head = replace(head, landmarks={}, anchor=None, regions={})
        author_changes(derived, replace(bare, attribution="", meshes=(head, *others)))
    assert facepipe.open("bare.usda").slider_network is None
    Path("points.json").write_text(json.dumps({"nose": 3, "chin": 4}))
    for words in COMMANDS:
        assert main(words.split()) in (0, 1), words
    try:
        slider = replace(parts.sliders[0], name="mouth:group")
        save_parts(replace(parts, sliders=(slider,), slider_network=None), "damaged.usda")
    except InputError as error:
        print(error)
    print("known" if known else "unknown")


if __name__ == "__main__":
    work()
