"""Stages of a few lines that compose to more than memory holds are refused by a count, before USD composes them."""

from __future__ import annotations

import os
import re
import struct
import sys
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from layers import prim, write
from pxr import Sdf, Usd

from facepipe.core.errors import InputError
from facepipe.stage.composition import Composition
from facepipe.stage.files import dependencies, open_stage
from facepipe.stage.recipes import layer_links

DEPTH = 30  # doublings: 10^9 prims
ARCS = ("references", "payload", "inherits", "specializes")


def doubling(arc: str, depth: int = DEPTH) -> dict[str, str]:
    """Two children of each prim are the next prim."""
    pairs = (prim(f"a{i}", "", "".join(prim(name, f"{arc} = </a{i + 1}>") for name in "xy")) for i in range(depth))
    return {"bomb.usda": "".join(pairs) + prim(f"a{depth}")}


def doubling_files(depth: int = DEPTH) -> dict[str, str]:
    """The same over many files."""
    layers = {
        f"l{i}.usda": prim("a0", "", "".join(prim(name, f"payload = @./l{i + 1}.usda@") for name in "xy"))
        for i in range(depth)
    }
    return layers | {f"l{depth}.usda": prim("a0")}


def doubling_variants(depth: int = DEPTH) -> dict[str, str]:
    """The same in variants."""
    text = ""
    for i in range(depth):
        inside = "".join(prim(name, f"references = </a{i + 1}>") for name in "xy")
        text += prim(
            f"a{i}",
            'variantSets = "v"\nvariants = {string v = "on"}',
            f'variantSet "v" = {{\n"on" {{\n{inside}\n}}\n}}',
        )
    return {"bomb.usda": text + prim(f"a{depth}")}


def doubling_below(depth: int = DEPTH) -> dict[str, str]:
    """References to prims below others, which get what those refer to."""
    text = "".join(
        prim(f"a{i}", f"references = </b{i}>")
        + prim(
            f"b{i}",
            "",
            prim("in", "", prim("x", f"references = </a{i + 1}/in>") + prim("y", f"references = </a{i + 1}/in>")),
        )
        for i in range(depth)
    )
    return {"bomb.usda": text + prim(f"a{depth}", "", prim("in"))}


def many_opinions(depth: int = DEPTH) -> dict[str, str]:
    """One prim of 2^30 references, all of them to prims that say nothing."""
    text = "".join(
        prim(f"{name}{i}", f"references = [</a{i + 1}>, </b{i + 1}>]") for i in range(depth) for name in "ab"
    )
    return {"bomb.usda": text + prim(f"a{depth}") + prim(f"b{depth}")}


def implied_classes(arc: str = "references") -> dict[str, str]:
    """The asset's classes are empty; the layer that refers to it fills them in, from one class to the next."""
    asset = prim("a0", "", "".join(prim(name, "inherits = </_c0>") for name in "xy"))
    rest = "".join(
        prim(f"k{i}", "", "".join(prim(name, f"inherits = </_c{i}>") for name in "xy")) + prim(f"_c{i}")
        for i in range(1, DEPTH)
    )
    classes = "".join(prim(f"_c{i}", "", prim("in", f"{arc} = @./asset.usda@</k{i + 1}>")) for i in range(DEPTH - 1))
    return {"bomb.usda": prim("a0", f"{arc} = @./asset.usda@") + classes, "asset.usda": asset + prim("_c0") + rest}


def doubling_sublayers() -> dict[str, str]:
    """Two sublayers of each layer have the same two sublayers."""
    layers = {
        f"{name}{i}.usda": f"#usda 1.0\n(subLayers = [@./a{i + 1}.usda@, @./b{i + 1}.usda@])\n"
        for i in range(DEPTH)
        for name in "ab"
    }
    return layers | {f"{name}{DEPTH}.usda": "#usda 1.0\n" for name in "ab"}


def chain(arc: str) -> dict[str, str]:
    """References one through another, which USD follows in quadratic time or off its stack."""
    links = (prim(f"a{i}", "", prim("x", f"{arc} = </a{i + 1}/x>")) for i in range(1000))
    return {"bomb.usda": "".join(links) + prim("a1000", "", prim("x"))}


def nested() -> dict[str, str]:
    return {"bomb.usda": 'def "a" {\n' * 100_000 + "}\n" * 100_000}


def nested_metadata() -> dict[str, str]:
    return {"bomb.usda": prim("a", "customData = {\n" + "dictionary a = {\n" * 100_000 + "}\n" * 100_000 + "}\n")}


def nested_target() -> dict[str, str]:
    return {"bomb.usda": prim("a", "", "rel r = <" + "/a.r[" * 100_000 + "/a" + "]" * 100_000 + ">")}


def nested_expression() -> dict[str, str]:
    return {"bomb.usda": prim("a", "", 'pathExpression x = "' + "(" * 100_000 + "/a" + ")" * 100_000 + '"')}


def endless_clips() -> dict[str, str]:
    times = "".join(f"double template{name}\n" for name in ("StartTime = 0", "EndTime = 1e12", "Stride = 1"))
    clips = f'dictionary default = {{\n{times}string templateAssetPath = "./c.#.usda"\n}}'
    return {"bomb.usda": prim("a0", f"clips = {{\n{clips}\n}}")}


BOMBS: dict[str, Callable[[], dict[str, str]]] = {
    **{arc: lambda arc=arc: doubling(arc) for arc in ARCS},
    **{f"chain of {arc}": lambda arc=arc: chain(arc) for arc in ARCS},
    "implied classes behind payloads": lambda: implied_classes("payload"),
    **{
        one.__name__: one
        for one in (
            doubling_files,
            doubling_variants,
            doubling_below,
            many_opinions,
            implied_classes,
            doubling_sublayers,
        )
    },
    **{one.__name__: one for one in (nested, nested_metadata, nested_target, nested_expression, endless_clips)},
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name == "implied_classes" else name for name in BOMBS]
)
def test_a_bomb_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"composes to|can't be read as USD|more than") as caught:
        open_stage(write(tmp_path, BOMBS[name]()), strict=False)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["nested", "doubling_sublayers"])
def test_what_a_file_stands_on_is_refused_likewise(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"can't be read as USD|more than"):
        dependencies(write(tmp_path, BOMBS[name]()))


def test_a_package_of_a_bomb_is_refused(tmp_path: Path) -> None:
    bomb = write(tmp_path, doubling("references"))
    package = tmp_path / "bomb.usdz"
    with zipfile.ZipFile(package, "w") as archive:
        start = zipfile.ZipInfo("bomb.usda")
        start.extra = b"\x86\x19" + struct.pack("<H", 64 - 30 - 9 - 4) + bytes(64 - 30 - 9 - 4)  # content begins at 64
        archive.writestr(start, bomb.read_bytes())
    shot = write(tmp_path, {"shot.usda": prim("a0", "references = @./bomb.usdz@")})
    for one in (package, shot):
        with pytest.raises(InputError, match="composes to"):
            open_stage(one, strict=False)


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes with names")
def test_layers_are_regular_files(tmp_path: Path) -> None:
    """A pipe would be waited for without end."""
    os.mkfifo(tmp_path / "pipe.usda")
    expression = "@`'./${NAME}.usda'`@"
    for text in (
        "#usda 1.0\n(subLayers = [@./pipe.usda@])\n",
        prim("a", "references = @./pipe.usda@"),
        prim("a", "", prim("b", "payload = @pipe.usda@")),
        f'#usda 1.0\n(expressionVariables = {{string NAME = "pipe"}}\nsubLayers = [{expression}])\n',
        prim("a", "clips = {dictionary default = {asset[] assetPaths = [@./pipe.usda@]\n}}"),
    ):
        stage = write(tmp_path, {"stage.usda": text})
        for reader in (open_stage, dependencies):
            with pytest.raises(InputError, match="no regular file"):
                reader(stage)
    with pytest.raises(InputError, match="no regular file"):
        layer_links(tmp_path / "pipe.usda")


def test_a_binary_layer_promises_no_more_than_it_can_hold(tmp_path: Path) -> None:
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    Sdf.CreatePrimInLayer(layer, "/a/b")
    layer.Export(str(tmp_path / "a.usdc"))
    data = bytearray((tmp_path / "a.usdc").read_bytes())
    contents = struct.unpack_from("<q", data, 16)[0]
    for number in range(struct.unpack_from("<Q", data, contents)[0]):
        changed = bytearray(data)
        start = struct.unpack_from("<q", data, contents + 8 + 32 * number + 16)[0]
        struct.pack_into("<Q", changed, start, 1 << 33)
        (tmp_path / "b.usdc").write_bytes(changed)
        with pytest.raises(InputError, match="promises 8589934592 entries"):
            open_stage(tmp_path / "b.usdc")


def test_a_binary_layer_lists_a_prim_that_it_lacks(tmp_path: Path) -> None:
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    for name in ("One", "Two"):
        Sdf.CreatePrimInLayer(layer, f"/{name}")
    layer.Export(str(tmp_path / "a.usdc"))
    data = (tmp_path / "a.usdc").read_bytes()
    lists = re.finditer(rb"\x02\0{7}.\0{3}.\0{3}", data, re.DOTALL)  # the root's prims: a count, numbers of names
    first = next(lists).start()
    (tmp_path / "b.usdc").write_bytes(data[: first + 12] + struct.pack("<I", 0) + data[first + 16 :])
    with pytest.raises(InputError, match="lists a prim that it does not hold"):
        open_stage(tmp_path / "b.usdc")


def test_large_stages_open(tmp_path: Path) -> None:
    """Braces in texts nest nothing; a hundred references to a hundred prims, and to classes, are a shot."""
    inside = 'string x = "' + "{" * 2000 + '"\nstring y = """' + '{" ' * 2000 + '"""\n# {{{{'
    face = prim("a0", "inherits = </_face>", "".join(prim(f"p{i}", "inherits = </_part>") for i in range(100)))
    layers = {
        "shot.usda": prim("a0", "", "".join(prim(f"f{i}", "references = @./face.usda@") for i in range(100))),
        "face.usda": face + "".join(prim(one) for one in ("_face", "_part")),
        "texts.usda": "".join(prim(f"t{i}", "", inside) for i in range(100)),
    }
    shot, texts = open_stage(write(tmp_path, layers)), open_stage(tmp_path / "texts.usda")
    assert sum(1 for _ in shot.TraverseAll()) == 1 + 100 * 101
    assert len(texts.GetPseudoRoot().GetChildren()) == 100


SMALL = (doubling_files, doubling_variants, doubling_below, many_opinions, *(partial(doubling, arc) for arc in ARCS))


@pytest.mark.parametrize("bomb", SMALL)
def test_the_count_is_no_less_than_what_usd_composes(bomb: Callable[..., dict[str, str]], tmp_path: Path) -> None:
    path = write(tmp_path, bomb(depth=5))
    counted = Composition(path).count()
    stage = Usd.Stage.Open(str(path))
    found = sum(len(prim.GetPrimStack()) for prim in stage.TraverseAll())
    assert counted is not None
    assert found <= counted.opinions <= 12 * found
