"""Landmark files of scans: what is written reads back, and what is wrong is named in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from import_data import damaged, refused

from facepipe.core.errors import InputError
from facepipe.importers.scan_landmarks import read_scan_landmarks, write_scan_landmarks
from facepipe.scans import Scan, ScanHints, ScanLandmarks

PLACES = np.random.default_rng(1).normal(size=(68, 3)) * 100
WHOLE: dict[str, Any] = {
    "scheme": "multipie68",
    "points": [None if i in (3, 67) else PLACES[i].tolist() for i in range(68)],
    "markers": {"cheek_left": [1, 2.5, -3], "brow": [0.0, 0.0, 1e-9]},
    "sigma_mm": [None if i in (5, 66) else 0.5 + i for i in range(68)],
}


def read(content: Any, folder: Path) -> ScanLandmarks:
    data = content if isinstance(content, bytes) else json.dumps(content).encode()
    (folder / "scan.landmarks.json").write_bytes(data)
    return read_scan_landmarks(folder / "scan.landmarks.json")


def test_landmarks_and_markers_are_what_the_file_says(tmp_path: Path) -> None:
    found = read(WHOLE, tmp_path)
    assert found.known.tolist() == [i not in (3, 67) for i in range(68)]
    assert (found.points[found.known] == PLACES[found.known]).all()
    assert {name: place.tolist() for name, place in found.markers.items()} == WHOLE["markers"]
    assert np.array_equal(found.sigma_mm, np.array(WHOLE["sigma_mm"], float), equal_nan=True)
    assert read(WHOLE | {"sigma_mm": 2}, tmp_path).sigma_mm.tolist() == [2.0] * 68
    assert np.isnan(read({"points": WHOLE["points"]}, tmp_path).sigma_mm).all()


@settings(max_examples=30, deadline=None)
@given(
    known=st.lists(st.booleans(), min_size=68, max_size=68).filter(any),
    names=st.sets(st.text(st.characters(exclude_categories=["Cs"]), min_size=1), max_size=4),
    scale=st.sampled_from([1e-12, 1.0, 1e12]),
    sigmas=st.lists(st.none() | st.floats(1e-3, 1e3), min_size=68, max_size=68),
)
def test_written_landmarks_read_back_to_the_bit(
    known: list[bool],
    names: set[str],
    scale: float,
    sigmas: list[float | None],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    points = np.where(np.array(known)[:, None], PLACES * scale, np.nan)
    markers = {name: PLACES[i] * scale for i, name in enumerate(sorted(names))}
    first, second = (tmp_path_factory.getbasetemp() / name for name in ("first.json", "second.json"))
    own = np.array(sigmas, np.float64)
    write_scan_landmarks(ScanLandmarks(points=points, sigma_mm=own, markers=markers), first)
    back = read_scan_landmarks(first)
    assert np.array_equal(back.sigma_mm, own, equal_nan=True)
    assert np.array_equal(back.points, points, equal_nan=True)
    assert {name: place.tolist() for name, place in back.markers.items()} == {k: v.tolist() for k, v in markers.items()}
    write_scan_landmarks(back, second)
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(("change", "message"), [
    ({"points": [[0, 0, 0]] * 67}, "67 landmarks, expected 68"),
    ({"points": [[0, 0, 0]] * 67 + [[0, 0]]}, "points -> 67: [0, 0], expected three numbers"),
    ({"points": [[0, 0, "1"]] * 68}, "points -> 0: '1', expected a finite number"),
    ({"points": [[0, 0, True]] * 68}, "True"),
    ({"points": [[0, 0, float("nan")]] * 68}, "nan, expected a finite number"),
    ({"points": [[0, 0, 1e40]] * 68}, "1e+40"),
    ({"points": [[0, 0, 10**400]] * 68}, "expected a finite number"),
    ({"points": {"0": [0, 0, 0]}}, "expected a list of 68"),
    ({"scheme": "ibug98"}, "'ibug98', expected multipie68"),
    ({"landmarks": []}, "key 'landmarks', expected scheme, points, vertices, mesh, markers, sigma_mm"),
    ({"sigma_mm": 0}, "sigma_mm: 0, expected 0.001 to 1000 mm"),
    ({"sigma_mm": True}, "sigma_mm: True"),
    ({"sigma_mm": [1.0] * 51}, "sigma_mm: 51 numbers, expected one, or 68"),
    ({"sigma_mm": [1.0] * 67 + [-2]}, "sigma_mm -> 67: -2, expected 0.001 to 1000 mm"),
    ({"sigma_mm": [None] * 67 + [float("nan")]}, "sigma_mm -> 67: nan"),
    ({"markers": [1, 2]}, "expected an object of name and place"),
    ({"markers": {"": [1, 2, 3]}}, "without a name"),
    ({"markers": {"dot": None}}, "markers -> 'dot': None, expected three numbers"),
])  # fmt: skip
def test_wrong_files_are_one_line(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    error = refused(lambda: read(WHOLE | change, tmp_path), tmp_path / "scan.landmarks.json")
    assert error is not None
    assert message in str(error)


@pytest.mark.parametrize(("change", "message"), [
    ({"mesh": ["a"]}, "mesh: ['a'], expected the name of a mesh of the scan: 'a', 'b'"),
    ({"mesh": {}}, "mesh: {}, expected the name of a mesh"),
    ({}, "mesh: None, expected the name of a mesh"),
    ({"mesh": "a", "vertices": {"68": 1}}, "landmark '68', expected a number from 0 to 67"),
    ({"mesh": "a", "vertices": {"3": 4}}, "vertices -> 3: 4, expected 0 to 3"),
    ({"mesh": "a", "vertices": {"3": True}}, "vertices -> 3: True"),
    ({"mesh": "a", "vertices": [1] * 67}, "expected a list of 68, or an object by number"),
])  # fmt: skip
def test_vertices_that_are_not_there_are_one_line(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = tmp_path / "scan.landmarks.json"
    path.write_text(json.dumps({"vertices": {"30": 1}} | change))
    scan = Scan(name="scan", points=np.eye(4, 3), hints=ScanHints(vertices={"a": np.eye(4, 3), "b": np.eye(4, 3)}))
    error = refused(lambda: read_scan_landmarks(path, scan), path)
    assert error is not None
    assert message in str(error)


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b'{"points": [], "points": []}', b"\xff", b"[" * 99999])
def test_what_is_no_landmark_file_is_refused(content: bytes, tmp_path: Path) -> None:
    assert refused(lambda: read(content, tmp_path), tmp_path / "scan.landmarks.json") is not None


@settings(max_examples=100, deadline=None)
@given(data=damaged(json.dumps(WHOLE).encode()))
def test_damaged_files_read_finite_or_are_refused(data: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.getbasetemp()
    found: list[ScanLandmarks] = []
    refused(lambda: found.append(read(data, folder)), folder / "scan.landmarks.json")
    for one in found:
        assert not np.isinf(one.points).any()
        assert one.known.any() or one.markers
        assert all(np.isfinite(place).all() and place.shape == (3,) for place in one.markers.values())


def test_markers_that_are_not_finite_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="finite"):
        write_scan_landmarks(ScanLandmarks(markers={"dot": np.array([0.0, 1.0, np.inf])}), tmp_path / "out.json")
    assert not list(tmp_path.iterdir())
