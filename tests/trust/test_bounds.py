"""What is granted for bytes that a file really holds is granted once, however often they are named."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from facepipe_gltf.read.document import Value, open_document

from facepipe.core.errors import InputError
from facepipe.core.names import numbered
from facepipe.core.policy.bounds import Budget, same_file


def test_a_source_is_granted_once_and_each_use_is_paid() -> None:
    budget = Budget(10, 2)
    for source in ("one", "one", "other"):
        budget.grant(5, source)
    assert (budget.left, budget.held) == (30, 10)
    budget.spend(20, lambda what: InputError("file", what))
    with pytest.raises(InputError, match="file: the file asks for far more data than it holds"):
        budget.spend(11, lambda what: InputError("file", what))
    assert budget.left == 10


def test_all_names_of_one_file_are_the_same(tmp_path: Path) -> None:
    one, hard, soft, other = (tmp_path / name for name in ("one", "hard", "soft", "other"))
    one.write_bytes(b"data")
    other.write_bytes(b"data")
    hard.hardlink_to(one)
    soft.symlink_to(one)
    assert same_file(one) == same_file(hard) == same_file(soft) == same_file(tmp_path / "." / "one")
    assert same_file(one) != same_file(other)
    assert same_file(tmp_path / "absent") != same_file(tmp_path / "gone")


def test_buffers_of_one_file_share_its_bytes(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(bytes(100))
    buffers = [{"uri": uri, "byteLength": size} for uri, size in (("a.bin", 100), ("./a.bin", 90), ("a.bin", 80))]
    (tmp_path / "a.gltf").write_text(json.dumps({"asset": {"version": "2.0"}, "buffers": buffers}))
    document = open_document(tmp_path / "a.gltf")
    read = [document.buffer(Value(number, "")) for number in range(3)]
    assert [len(data) for data in read] == [100, 90, 80]
    assert len({id(data.obj) for data in read}) == 1
    assert document.budget.held == 100


def test_a_name_that_all_have_is_numbered_in_one_pass() -> None:
    names = numbered(["a", "a_7"] * 50_000)
    assert len(set(names)) == len(names) == 100_000
    assert names[:6] == ("a", "a_7", "a_2", "a_7_2", "a_3", "a_7_3")
    assert names[12:14] == ("a_8", "a_7_7")
