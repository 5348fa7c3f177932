"""The frame of an HTML page that is one file: title, colours for light and dark, tables that scroll."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from hashlib import sha256
from html import escape as html_escape

from datagen.schemas.errors import printable

_STYLE = """
:root { color-scheme: light dark; --paper: #ffffff; --ink: #1b1f24; --pale: #59636e; --line: #d1d9e0;
  --band: #f3f6f9; --accent: #0b57a4; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #14181d; --ink: #e6eaef; --pale: #a3afbb; --line: #39424c; --band: #1d232a;
    --accent: #7db8f5; } }
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); margin: 0 auto;
  max-width: 78rem; padding: 0 1rem 3rem; border-top: 6px solid var(--accent); }
h1 { font-size: 1.6rem; line-height: 1.25; }
h2 { font-size: 1.25rem; margin-top: 2.4rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1.05rem; margin-bottom: .3rem; }
h1, h2, h3, p, dd { overflow-wrap: anywhere; }
.note, summary, dt { color: var(--pale); }
summary { cursor: pointer; padding: .2rem 0; }
.scroll { overflow-x: auto; max-width: 100%; margin: .4rem 0 1.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { padding: .2rem .6rem; text-align: right; vertical-align: top; border-bottom: 1px solid var(--line); }
th { background: var(--band); font-weight: 600; }
td { white-space: nowrap; }
th:first-child, td:first-child, table.text td, table.text th { text-align: left; }
figure { margin: .6rem 0 1.2rem; padding: .4rem; background: #ffffff; color: #1b1f24;
  border: 1px solid var(--line); border-radius: 6px; overflow-x: auto; }
figure > svg { display: block; width: 100%; min-width: 44rem; height: auto; }
figcaption { font-size: .92rem; color: #59636e; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; margin: .6rem 0; }
dd { margin: 0; min-width: 0; }
@media (max-width: 40rem) { dl { display: block; } dd { margin-bottom: .4rem; } h1 { font-size: 1.35rem; } }
code { font-size: 88%; overflow-wrap: anywhere; }
"""


def html_page(title: str, body: Iterable[str], style: str = "", script: str | None = None) -> str:
    """The whole page; `body` is HTML, `style` is added to the page's.

    With a `script`, a content security policy lets the browser run only it and fetch nothing.
    """
    policy, end = "", ""
    if script is not None:
        digest = b64encode(sha256(script.encode()).digest()).decode()
        policy = (
            '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
            f"style-src 'unsafe-inline'; script-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'\">"
        )
        end = f"<script>{script}</script>"
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">{policy}'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}{style}</style></head>\n<body>\n<h1>{escape(title)}</h1>\n"
        + "\n".join(body)
        + f"\n{end}</body></html>\n"
    )


def escape(text: str) -> str:
    """The text escaped for HTML, without markup or control characters."""
    return html_escape(printable(text))


def html_table(headings: Sequence[str], lines: Iterable[Sequence[str]], kind: str = "") -> str:
    """A table in a box that scrolls; `kind` is "text" where columns are not numbers."""
    head = "".join(f"<th>{escape(h)}</th>" for h in headings)
    body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in line) + "</tr>\n" for line in lines)
    return f'<div class="scroll" tabindex="0"><table class="{kind}"><tr>{head}</tr>\n{body}</table></div>'


def html_figure(content: str, caption: str = "") -> str:
    """A figure (HTML) on white, which its colours were chosen for, with its caption."""
    words = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f"<figure>{content}{words}</figure>"


def html_facts(facts: Iterable[tuple[str, str]]) -> str:
    """A list of pairs of a heading and a text."""
    return "<dl>" + "".join(f"<dt>{escape(h)}</dt><dd>{escape(t)}</dd>" for h, t in facts) + "</dl>"
