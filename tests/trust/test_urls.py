"""URLs of files: below the roots that were given, and of nothing but a bucket and a path."""

import os
from pathlib import Path

import pytest

from facepipe.core.errors import InputError
from facepipe.core.policy.paths import checked, placed

ROOTS = ("s3://show/a/", "gs://other")


def test_urls_lie_below_a_root() -> None:
    assert checked("s3://show/a/b.usda", ROOTS) == "s3://show/a/b.usda"
    assert checked("gs://other/b/c d/", ROOTS) == "gs://other/b/c d"
    assert checked("s3://show/a", ROOTS) == "s3://show/a"
    for url in ("s3://show/b.usda", "s3://show/ab.usda", "s3://show", "gs://other2/b.usda", "s3://other/b.usda"):
        with pytest.raises(InputError, match=r"is outside the roots \(s3://show/a/, gs://other\), expected --root"):
            checked(url, ROOTS)


@pytest.mark.parametrize("part", [*(f"b{one}c" for one in '\\:*?"<>|#@\0\n\x1f'), "..", ".", ".facepipe-lock"])
def test_parts_of_paths_are_plain(part: str) -> None:
    for url in (f"s3://show/a/{part}/d", f"s3://show/a/{part}", f"s3://show/a//{part}", "s3://show/a//d"):
        with pytest.raises(InputError, match="can't be used, expected one like s3://"):
            checked(url, ROOTS)


@pytest.mark.parametrize(
    "host", ["", "-show", ".show", "sh ow", "show:80", "key@show", "key:secret@show", "show?a", "é"]
)
@pytest.mark.parametrize("scheme", ["s3", "https"])
def test_hosts_of_urls_are_buckets_without_a_key(scheme: str, host: str) -> None:
    url = f"{scheme}://{host}/a"
    with pytest.raises(InputError, match="can't be used") as raised:
        checked(url, [url])
    assert "key" not in str(raised.value)


@pytest.mark.parametrize("url", ["https://show/a", "file:///a", "S3://show/a", "s3:/show/a", "x::s3://show/a", "/a"])
def test_other_schemes_are_refused_whatever_the_roots(url: str) -> None:
    with pytest.raises(InputError, match="can't be used"):
        checked(url, [url, "/"])


def test_a_url_within_a_url_is_not_shortened_to_one_of_the_roots() -> None:
    with pytest.raises(InputError, match="can't be used"):
        checked(placed("plans", "s3://show/a/s3://../b.usda"), ROOTS)


def test_a_long_url_is_shown_short() -> None:
    with pytest.raises(InputError) as raised:
        checked("https://" + "a" * 10_000, ROOTS)
    assert len(str(raised.value)) < 300


def test_places_are_in_their_shortest_form() -> None:
    here = os.path.abspath("x")  # noqa: PTH100  (absolute as the system has it)
    assert placed("plans", "a/../b//c.usda") == str(Path("plans/b/c.usda"))
    assert placed("plans", here) == here
    assert placed("plans", "s3://show/a/./b/../c.usda") == "s3://show/a/c.usda"
    assert placed("s3://show/plans", "../b.usda") == "s3://show/b.usda"
    assert placed("s3://show", here) == here
