"""Pages of reports as HTML, one file each: text is escaped, wherever it comes from."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

_VOID = ("col", "img", "meta")
_STYLE = """
:root{color-scheme:light dark;--ink:#22252b;--muted:#6b7280;--rule:#dfe2e7;--track:#e7e9ed;--above:#2078aa;
--under:#de7e30;--bad:#b00020;--paper:#fff}
@media(prefers-color-scheme:dark){:root{--ink:#e3e5e8;--muted:#9aa1ac;--rule:#34383f;--track:#2b2f36;--above:#4aa3d6;
--under:#eb9a55;--bad:#ff6b81;--paper:#16181b}}
*{box-sizing:border-box}
body{font:14px/1.45 system-ui,sans-serif;max-width:1240px;margin:0 auto;padding:36px 24px 64px;color:var(--ink);
background:var(--paper)}
h1{font-size:26px;line-height:1.2;font-weight:650;margin:0;overflow-wrap:anywhere}
h2{font-size:17px;font-weight:650;margin:40px 0 14px;padding-bottom:6px;border-bottom:1px solid var(--rule);
overflow-wrap:anywhere}
h2 small{float:right;font-weight:400;font-size:13px;line-height:24px;margin-left:16px}
small,.muted,caption,th{color:var(--muted)}
p{margin:6px 0}a{color:var(--above)}code{font-size:.95em;word-break:break-all}.bad{color:var(--bad)}
table{border-collapse:collapse}th,td{padding:3px 14px 3px 0;text-align:left;vertical-align:top}
th{font-weight:400;font-size:13px}.ruled{margin:16px 0}
.ruled td,.ruled th{vertical-align:middle;border-bottom:1px solid var(--rule);padding:5px 18px 5px 0}
.bars{width:100%;table-layout:fixed}.bars td,.bars th{vertical-align:middle}.bars td:first-child{overflow-wrap:anywhere}
.bars caption{text-align:left;font-size:13px;padding:8px 0 2px}
td.number,th.number{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
.ruled td.track{width:45%;min-width:110px}.bar{display:block;width:100%;height:10px}
.grid{display:grid;gap:20px}.columns{display:grid;grid-template-columns:repeat(auto-fit,minmax(420px,1fr));gap:0 56px}
.flow{columns:2 420px;column-gap:56px}.names{columns:4 200px;list-style:none;padding:0;margin:8px 0}
.flow table,.names li{overflow-wrap:anywhere}
figure{margin:0}figure img{display:block;width:100%;height:auto;border-radius:4px}
figcaption{display:flex;justify-content:space-between;gap:12px;padding-top:6px;overflow-wrap:anywhere}
figcaption small{white-space:nowrap}.scale{max-width:640px;margin:16px 0 8px}
.cards{display:flex;flex-wrap:wrap;gap:10px}.card{width:150px;font-size:12px;color:var(--muted)}
.card b{color:var(--ink)}.card img{width:100%;border-radius:4px;display:block}
svg{max-width:100%}
"""


class Markup(str):
    """HTML or SVG that stands as it is; all other text is escaped."""

    __slots__ = ()


def tag(name: str, /, *content: object, **attributes: object) -> Markup:
    """An element; of attributes `class_` is `class`, and `stroke_width` is `stroke-width`; None leaves one out."""
    given = {key.rstrip("_").replace("_", "-"): value for key, value in attributes.items() if value is not None}
    start = "".join(f' {key}="{escape(str(value))}"' for key, value in given.items())
    return Markup(f"<{name}{start}>" if name in _VOID else f"<{name}{start}>{joined(*content)}</{name}>")


def joined(*content: object) -> Markup:
    """Pieces one after the other."""
    return Markup("".join(piece if isinstance(piece, Markup) else escape(str(piece)) for piece in content))


def heading(text: str, note: str = "") -> Markup:
    """The heading of a part of a page, with a note at the right."""
    return tag("h2", *([tag("small", note)] if note else []), text)


def ruled_table(head: Sequence[str], rows: Sequence[Sequence[object]], numbers: Sequence[int]) -> Markup:
    """A table with lines between rows; columns of `numbers` end at the right."""
    sides = ["number" if column in numbers else None for column in range(len(head))]
    titles = tag("tr", *(tag("th", title, class_=side) for title, side in zip(head, sides, strict=True)))
    lines = [tag("tr", *(tag("td", cell, class_=_side(cell, side)) for cell, side in zip(row, sides, strict=True)))
             for row in rows]  # fmt: skip
    return tag("table", titles, *lines, class_="ruled")


def _side(cell: object, side: str | None) -> str | None:
    return "track" if isinstance(cell, Markup) else side


def page(title: str, *content: object) -> bytes:
    """A whole page."""
    head = joined(
        tag("meta", charset="utf-8"),
        tag("title", title),
        tag("meta", name="viewport", content="width=device-width"),
        tag("style", Markup(_STYLE)),
    )
    whole = tag("html", tag("head", head), tag("body", *content), lang="en")
    return f"<!doctype html>{whole}\n".encode("utf-8", "replace")
