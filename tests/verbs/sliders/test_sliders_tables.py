"""Tables of sliders: what the forms mean, and that damaged ones give one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from slider_tables import LIST, MATRIX, TOML

from facepipe.core.errors import InputError
from facepipe.parts import Slider
from facepipe.rig import CHANNELS, rest_coefficients, slide
from facepipe.verbs.sliders import Drive, SliderRule, SliderTable, read_table, tables

JOINTS = ("root", "root/jaw", "root/lidLeft", "root/lidRight")
SHAPES = ("jawOpen", "smileLeft", "smileRight")


def resolved(folder: Path, text: str | bytes, suffix: str = ".toml", meters_per_unit: float = 0.01) -> list[Slider]:
    path = folder / f"table{suffix}"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return list(read_table(path).resolve(JOINTS, SHAPES, meters_per_unit))


def assert_act_alike(one: list[Slider], other: list[Slider]) -> None:
    assert [slider.name for slider in one] == [slider.name for slider in other]
    rng = np.random.default_rng(4)
    for _ in range(20):
        values = {slider.name: rng.uniform(slider.minimum - 0.5, slider.maximum + 0.5) for slider in one}
        (bones, weights), (others, other_weights) = (slide(sliders, JOINTS, values) for sliders in (one, other))
        np.testing.assert_allclose(bones, others, atol=1e-12)
        assert weights == pytest.approx(other_weights)


def test_a_table_says_what_sliders_are(tmp_path: Path) -> None:
    width, left, right = resolved(tmp_path, TOML)
    assert width == Slider(
        name="width",
        group="nose",
        minimum=-1.0,
        channels=(("root/jaw", "tx", 0.5), ("root", "sy", -0.25)),
    )
    assert left == Slider(
        name="openLeft",
        default=0.25,
        channels=(("root/lidLeft", "rx", 0.5),),
        shapes=(("smileLeft", 2.0),),
        mirror="openRight",
    )
    assert right.mirror is None  # the other side is named when the table is authored


@pytest.mark.parametrize(("text", "suffix"), [(LIST, ".csv"), (MATRIX, ".CSV")])
def test_all_forms_say_the_same(text: str, suffix: str, tmp_path: Path) -> None:
    toml, other = resolved(tmp_path, TOML), resolved(tmp_path, text, suffix)
    assert_act_alike(toml, other)
    for name in ("group", "minimum", "maximum", "default", "mirror"):
        assert [getattr(one, name) for one in toml] == [getattr(one, name) for one in other]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("text", [LIST, MATRIX])
def test_spreadsheets_of_other_countries_say_the_same(text: str, encoding: str, tmp_path: Path) -> None:
    expected = resolved(tmp_path, text, ".csv")
    german = text.replace(",", ";").replace(".", ",").replace("\n", "\r\n")
    for other in (german, text.replace(",", "\t"), text.replace("width", '"width"').replace("\n", "\n\n")):
        assert resolved(tmp_path, other.encode(encoding), ".csv") == expected


def test_patterns_and_kinds_reach_several_and_later_ones_win(tmp_path: Path) -> None:
    (slider,) = resolved(
        tmp_path,
        '[slider.a]\nchannels = { "lid*:s" = 0.1, "root/*Left:sy" = [[0, 0], [1, 2]] }\nshapes = { "smile*" = 0.5 }',
    )
    curve = ((0.0, 0.0), (1.0, 2.0))
    assert slider.channels == (
        ("root/lidLeft", "sx", 0.1),
        ("root/lidLeft", "sy", 1.0),
        ("root/lidLeft", "sz", 0.1),
        ("root/lidRight", "sx", 0.1),
        ("root/lidRight", "sy", 0.1),
        ("root/lidRight", "sz", 0.1),
    )
    assert slider.channel_curves == (None, curve, None, None, None, None)
    assert slider.shapes == (("smileLeft", 0.5), ("smileRight", 0.5))


def test_curves_are_written_in_both_files(tmp_path: Path) -> None:
    text = "[slider.a]\nshapes = { jawOpen = { gain = 0.5, curve = [[-1, 1], [0, 0], [1.5, 0]] } }"
    table = "slider;target;gain;curve\na;jawOpen;0,5;-1:1 0:0 1,5:0\n"
    assert resolved(tmp_path, text) == resolved(tmp_path, table, ".csv")


@pytest.mark.parametrize(("units", "factor"), [("stage", 1.0), ("mm", 0.1), ("cm", 1.0), ("m", 100.0)])
def test_units_scale_translations_alone(units: str, factor: float, tmp_path: Path) -> None:
    driven = 'channels = { "jaw:tx" = 2, "jaw:rx" = 2, "jaw:sx" = 2 }\nshapes = { jawOpen = 2 }'
    text = f'units = "{units}"\n[slider.a]\n{driven}'
    (slider,) = resolved(tmp_path, text)
    assert [gain for _, _, gain in slider.channels] == pytest.approx([2 * factor, 2, 2])
    assert slider.shapes == (("jawOpen", 2.0),)


@pytest.mark.parametrize("row", ["b", "Bias"])
def test_a_matrix_is_gamma_of_the_document(row: str, tmp_path: Path) -> None:
    """gamma = W^T alpha + b [0209], alpha clamped to its range, whatever the defaults."""
    rng = np.random.default_rng(2)
    targets = ["root:tx", "jaw:rx", "lidLeft:sy", "jawOpen"]
    matrix, bias = rng.normal(size=(3, 4)), rng.normal(size=4)
    matrix[1, 2] = matrix[:, 3] = matrix[0, 0] = 0  # nothing moves jawOpen, the first slider not root:tx
    ranges = [(-1.0, 1.0, 0.0), (0.0, 1.0, 0.5), (0.25, 2.0, 0.25)]
    rows = [",".join(map(repr, [*own.tolist(), *span])) for own, span in zip(matrix, ranges, strict=True)]
    lines = [f",{','.join(targets)},min,max,default", *(f"s{i},{one}" for i, one in enumerate(rows))]
    lines.insert(2, f"{row},{','.join(map(repr, bias.tolist()))},,,")
    sliders = resolved(tmp_path, "\n".join(lines), ".csv")
    assert [slider.name for slider in sliders] == ["s0", "s1", "s2"]
    for _ in range(20):
        alpha = rng.uniform(-1.5, 2.5, 3)
        inside = np.clip(alpha, *np.array(ranges).T[:2])
        gamma = matrix.T @ inside + bias
        bones, weights = slide(sliders, JOINTS, {f"s{i}": float(one) for i, one in enumerate(alpha)})
        expected = rest_coefficients(len(JOINTS))
        for place, value in zip(((0, "tx"), (1, "rx"), (2, "sy")), gamma, strict=False):
            expected[place[0], CHANNELS.index(place[1])] += value
        np.testing.assert_allclose(bones, expected, atol=1e-12)
        assert weights == pytest.approx({"jawOpen": gamma[3]})


def test_a_matrix_without_bias_leaves_the_default_at_rest(tmp_path: Path) -> None:
    sliders = resolved(tmp_path, MATRIX, ".csv")
    bones, weights = slide(sliders, JOINTS)
    np.testing.assert_array_equal(bones, rest_coefficients(len(JOINTS)))
    assert set(weights.values()) == {0.0}


def test_the_default_is_0_where_that_is_in_range_and_the_minimum_elsewhere(tmp_path: Path) -> None:
    text = "".join(f"[slider.s{i}]\nrange = {span}\n" for i, span in enumerate(([-1, 1], [0.5, 1], [-2, -1])))
    assert [one.default for one in resolved(tmp_path, text)] == [0.0, 0.5, -2.0]


ONE = "[slider.a]\n"
BAD: dict[str, tuple[str | bytes, str, str]] = {
    "no TOML": ("[slider.a", ".toml", "is not TOML"),
    "a slider twice": (ONE + ONE, ".toml", "is not TOML"),
    "latin 1": (b"[slider.a]\ngroup = '\xe4'", ".toml", "is not TOML"),
    "binary": (bytes(range(256)), ".toml", "is not TOML"),
    "endless nesting": ("a = " + "[" * 100_000, ".toml", "is not TOML"),
    "endless digits": (ONE + f"default = {'9' * 5000}", ".toml", "is not TOML"),
    "beyond floats": (
        ONE + f"default = {'9' * 400}",
        ".toml",
        "default: 9999999999999999999999999999999999999999, expected a finite number",
    ),
    "empty": ("", ".toml", "no sliders"),
    "sliders that are none": ("slider = 3", ".toml", "slider: 3, expected an object of which each value is an object"),
    "a slider that is none": ("[slider]\na = 3", ".toml", "slider -> a: 3, expected an object"),
    "unknown key": ("[sliders.a]", ".toml", "option 'sliders' is unknown, did you mean 'slider'?"),
    "unknown key of a slider": (
        ONE + "gain = 3",
        ".toml",
        "slider -> a: option 'gain' is unknown, expected some of group",
    ),
    "unknown key of a target": (
        ONE + "shapes = { jawOpen = { amount = 1 } }",
        ".toml",
        "jawOpen: option 'amount' is unknown, expected some of gain",
    ),
    "unknown units": ('units = "inch"\n' + ONE, ".toml", "units: 'inch', expected one of stage"),
    "units of a number": ("units = 3\n" + ONE, ".toml", "units: 3, expected a text"),
    "group of a number": (ONE + "group = 3", ".toml", "group: 3, expected a text"),
    "range of one": (ONE + "range = [1]", ".toml", "range: [1], expected a list of 2 of which each is a finite number"),
    "range of texts": (ONE + 'range = ["0", "1"]', ".toml", "range -> 0: '0', expected a finite number"),
    "empty range": (ONE + "range = [1, 1]", ".toml", "range 1 to 1, expected a minimum below"),
    "empty in float32": (ONE + "range = [1, 1.00000001]", ".toml", "range 1 to 1, expected a minimum below"),
    "range upside down": (ONE + "range = [1, 0]", ".toml", "range 1 to 0, expected"),
    "endless range": (ONE + "range = [0, inf]", ".toml", "range -> 1: inf, expected a finite number"),
    "NaN range": (ONE + "range = [nan, 1]", ".toml", "range -> 0: nan, expected a finite number"),
    "default outside": (ONE + "default = 2", ".toml", "default 2, expected 0 to 1"),
    "default of a boolean": (ONE + "default = true", ".toml", "default: True, expected a finite number"),
    "NaN gain": (ONE + "shapes = { jawOpen = nan }", ".toml", "jawOpen: nan, expected a finite number"),
    "gain beyond reason": (ONE + "shapes = { jawOpen = 1e30 }", ".toml", "gain 1e+30, expected"),
    "gain of a text": (ONE + 'shapes = { jawOpen = "1" }', ".toml", "jawOpen: '1', expected a finite number or a list"),
    "gain of a text beside a curve": (
        ONE + 'shapes = { jawOpen = { gain = "1" } }',
        ".toml",
        "gain: '1', expected a finite number",
    ),
    "nothing for a target": (
        ONE + "shapes = { jawOpen = {} }",
        ".toml",
        "jawOpen -> gain: none, and no curve, expected one of them",
    ),
    "targets that are none": (
        ONE + "channels = [1]",
        ".toml",
        "channels: [1], expected an object of which each value is",
    ),
    "curve of one knot": (ONE + "shapes = { jawOpen = [[0, 1]] }", ".toml", "a curve of 1 knots"),
    "curve of no knot": (ONE + "shapes = { jawOpen = [] }", ".toml", "a curve of 0 knots"),
    "curve of numbers": (ONE + "shapes = { jawOpen = [0, 1] }", ".toml", "jawOpen -> 0: 0, expected a list of 2"),
    "curve that descends": (ONE + "shapes = { jawOpen = [[1, 0], [0, 1]] }", ".toml", "strictly ascending"),
    "curve that turns": (ONE + "shapes = { jawOpen = [[0, 0], [1, 1], [2, 0]] }", ".toml", "rises and falls"),
    "NaN knot": (
        ONE + "shapes = { jawOpen = [[0, 0], [1, nan]] }",
        ".toml",
        "jawOpen -> 1 -> 1: nan, expected a finite number",
    ),
    "unknown joint": (
        ONE + 'channels = { "nose:tx" = 1 }',
        ".toml",
        "'nose' matches none of 4 joints, expected some of root",
    ),
    "unknown channel": (ONE + 'channels = { "jaw:qx" = 1 }', ".toml", "'jaw:qx', expected JOINT:CHANNEL"),
    "no channel": (ONE + "channels = { jaw = 1 }", ".toml", "'jaw', expected JOINT:CHANNEL"),
    "unknown shape": (ONE + "shapes = { smile = 1 }", ".toml", "'smile' matches none of 3 shapes"),
    "other suffix": ("{}", ".json", "suffix '.json', expected one of .toml, .csv"),
    "nothing": ("", ".csv", "0 rows, expected a header and sliders"),
    "header alone": ("slider,target,gain\n", ".csv", "1 rows, expected a header and sliders"),
    "no gain": ("slider,target,amount\na,jawOpen,1", ".csv", "line 1: no column 'gain'"),
    "no slider": ("name,target,gain\na,jawOpen,1", ".csv", "line 1: no column 'slider'"),
    "a column too many": ("slider,target,gain,note\na,jawOpen,1,x", ".csv", "line 1: column 'note', expected columns"),
    "a column twice": ("slider,target,gain,gain\na,jawOpen,1,1", ".csv", "line 1: column 'gain' twice"),
    "a column without name": ("slider,target,gain,\na,jawOpen,1,1", ".csv", "line 1: a column without name"),
    "a cell too many": ("slider,target,gain\na,jawOpen,1,2", ".csv", "line 2: 4 cells, expected 3"),
    "a cell missing": ("slider,target,gain\na,jawOpen", ".csv", "line 2: nothing in column 'gain'"),
    "no number": ("slider,target,gain\na,jawOpen,one", ".csv", "line 2: gain 'one', expected a number"),
    "a thousand": ('slider,target,gain\na,jawOpen,"1,000"', ".csv", "gain '1,000', expected a number"),
    "NaN in a row": ("slider,target,gain\na,jawOpen,nan", ".csv", "line 2: gain nan, expected a finite number"),
    "a target twice": (
        "slider,target,gain\na,jawOpen,1\na,jawOpen,1",
        ".csv",
        "line 3: target 'jawOpen' of slider 'a' twice",
    ),
    "two defaults": (
        "slider,target,gain,default\na,jawOpen,1,0\na,smile*,1,1",
        ".csv",
        "line 3: default '1', and '0' in a row above",
    ),
    "curve of a row": ("slider,target,gain,curve\na,jawOpen,1,0:0 0:1", ".csv", "line 2 -> a: knot values 0, 0"),
    "curve without colon": ("slider,target,gain,curve\na,jawOpen,1,0 1", ".csv", "line 2: knot '', expected a number"),
    "unclosed quote": ('slider,target,gain\n"a,jawOpen,1', ".csv", "is not CSV"),
    "NUL": (b"slider,target,gain\na,jaw\0Open,1", ".csv", "table.csv"),
    "latin 1 in CSV": ("slider,target,gain\nä,jawOpen,1".encode("latin-1"), ".csv", "is not UTF-8 (byte 19)"),
    "half of UTF-16": (b"\xff\xfes\0l", ".csv", "is not UTF-8 (byte 4)"),
    "odd UTF-16": (b"\xff\xfes\0l\0x", ".csv", "is not UTF-8"),
    "matrix without targets": ("slider,min,max\na,0,1", ".csv", "line 1: 3 columns, expected slider, and one per"),
    "matrix with a name twice": ("slider,jaw:tx\na,1\na,2", ".csv", "slider 'a' 2 times, expected each once"),
    "matrix with two rows b": ("slider,jaw:tx\na,1\nb,1\nbias,1", ".csv", "line 4: a second row b"),
    "matrix of a bias alone": ("slider,jaw:tx\nb,1\n", ".csv", "0 sliders, expected 1 to"),
    "matrix with NaN": ("slider,jaw:tx\na,nan", ".csv", "jaw:tx nan, expected a finite number"),
    "matrix of unknown joints": ("slider,nose:tx\na,1", ".csv", "'nose' matches none of 4 joints"),
    "bias of an unknown channel": ("slider,jaw:tx,jaw:qq\na,1,0\nb,0,1", ".csv", "'jaw:qq', expected JOINT:CHANNEL"),
    "matrix of unknown shapes": ("slider,jaw:tx,grin\na,1,1", ".csv", "'grin' matches none of 3 shapes"),
    "a list without its header": ("a,jawOpen,1\nb,jawOpen,1", ".csv", "line 1: column '1', expected a header"),
    "a nameless slider": ("slider,jaw:tx\n,1", ".csv", "line 2: nothing in column 'slider'"),
    "empty range in a row": ("slider,jaw:tx,min,max\na,1,2,2", ".csv", "line 2 -> a: range 2 to 2, expected"),
    "default outside in a row": ("slider,jaw:tx,default\na,1,2", ".csv", "line 2 -> a: default 2, expected 0 to 1"),
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_tables_give_one_line(name: str, tmp_path: Path) -> None:
    text, suffix, message = BAD[name]
    with pytest.raises(InputError) as caught:
        resolved(tmp_path, text, suffix)
    found = str(caught.value)
    assert message in found
    assert "\n" not in found
    assert len(found.replace(str(tmp_path), "")) < 300
    assert str(tmp_path) in found


def test_large_files_and_folders_are_refused(tmp_path: Path) -> None:
    for suffix in (".toml", ".csv"):
        path = tmp_path / f"huge{suffix}"
        path.write_bytes(b"#" * ((1 << 22) + 1))
        with pytest.raises(InputError, match="larger than 4194304 bytes"):
            read_table(path)
        (tmp_path / f"folder{suffix}").mkdir()
        with pytest.raises(InputError, match="is not a regular file"):
            read_table(tmp_path / f"folder{suffix}")
        with pytest.raises(InputError, match="can't be read"):
            read_table(tmp_path / f"nowhere{suffix}")


def test_tables_of_too_much_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    rules = tuple(SliderRule(name=f"s{i}", where="t", channels=(Drive(target="*:t", where="t"),)) for i in range(4097))
    with pytest.raises(InputError, match="4097 sliders, expected 1 to 4096"):
        SliderTable(rules=rules)
    with pytest.raises(InputError, match="more than 262144 channels"):
        SliderTable(rules=rules[:200]).resolve([f"j{i}" for i in range(500)], (), 0.01)
    monkeypatch.setattr(tables, "_MOST_DRIVEN", 12)
    assert len(SliderTable(rules=rules[:2]).resolve(["j0", "j1"], (), 0.01)) == 2  # of 3 channels of 2 joints
    with pytest.raises(InputError, match="more than 12 channels"):
        SliderTable(rules=rules[:3]).resolve(["j0", "j1"], (), 0.01)


def test_a_table_made_in_python_is_as_one_that_was_read(tmp_path: Path) -> None:
    rule = SliderRule(
        name="width",
        group="nose",
        minimum=-1.0,
        channels=(Drive(target="jaw:tx", gain=0.5, where="w"), Drive(target="root:sy", gain=-0.25, where="w")),
        where="width",
    )
    assert list(SliderTable(rules=(rule,)).resolve(JOINTS, SHAPES, 0.01)) == resolved(tmp_path, TOML)[:1]
