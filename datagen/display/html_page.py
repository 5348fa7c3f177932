"""The frame of an HTML page that is one file: title, colours for light and dark, tables that scroll."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
h3 { font-size: 1.05rem; margin: 1.6rem 0 .3rem; }
h1, h2, h3, p, li, dd { overflow-wrap: anywhere; }
a { color: var(--accent); }
.note, summary, dt { color: var(--pale); }
summary { cursor: pointer; padding: .2rem 0; }
.scroll { overflow-x: auto; max-width: 100%; margin: .4rem 0 1.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { padding: .2rem .6rem; text-align: right; vertical-align: top; border-bottom: 1px solid var(--line); }
th { background: var(--band); font-weight: 600; }
td { white-space: pre-wrap; }
td + td { white-space: nowrap; }
th:first-child, td:first-child, table.text td, table.text th { text-align: left; }
figure { margin: .6rem 0 1.2rem; padding: .4rem; background: #ffffff; color: #1b1f24;
  border: 1px solid var(--line); border-radius: 6px; overflow-x: auto; }
figure > svg { display: block; width: 100%; min-width: 44rem; height: auto; }
figure > img { display: block; width: 100%; height: auto; }
figcaption { font-size: .92rem; color: #59636e; }
.pictures { display: grid; gap: .8rem; align-items: start;
  grid-template-columns: repeat(auto-fit, minmax(min(20rem, 100%), 1fr)); }
pre { overflow-x: auto; max-width: 100%; font-size: .82rem; background: var(--band); padding: .5rem;
  border-radius: 5px; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; margin: .6rem 0; }
dd { margin: 0; min-width: 0; grid-column: 2; }
@media (max-width: 40rem) { dl { display: block; } dd { margin-bottom: .4rem; } h1 { font-size: 1.35rem; } }
code { font-size: 88%; overflow-wrap: anywhere; }
"""


def html_page(title: str, body: Iterable[str]) -> str:
    """The whole page; `body` is HTML."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head>\n<body>\n<h1>{escape(title)}</h1>\n"
        + "\n".join(body)
        + "\n</body></html>\n"
    )


def escape(text: str) -> str:
    """The text escaped for HTML, without markup or control characters."""
    return html_escape(printable(text))


def html_table(headings: Sequence[str], lines: Iterable[Sequence[str]], kind: str = "") -> str:
    """A table in a box that scrolls; `kind` is "text" for columns of text. Headings may be blank."""
    head = "".join(f"<th>{escape(h)}</th>" for h in headings) if any(headings) else ""
    body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in line) + "</tr>\n" for line in lines)
    return f'<div class="scroll" tabindex="0"><table class="{kind}"><tr>{head}</tr>\n{body}</table></div>'


def html_figure(content: str, caption: str = "") -> str:
    """A figure (HTML) on white, which its colours were chosen for, with its caption; a wide one scrolls."""
    words = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure tabindex="0">{content}{words}</figure>'


def html_picture(address: str, description: str) -> str:
    """A picture at a `data:` address, with its description for readers who do not see it."""
    return f'<figure><img src="{address}" alt="{escape(description)}"></figure>'


def html_facts(facts: Iterable[tuple[str, str]]) -> str:
    """A list of pairs of a heading and a text; a text without a heading belongs to the one above."""
    rows = (f"<dt>{escape(h)}</dt><dd>{escape(t)}</dd>" if h else f"<dd>{escape(t)}</dd>" for h, t in facts)
    return f"<dl>{''.join(rows)}</dl>"


def html_folded(title: str, text: str) -> str:
    """Lines of text behind a heading that opens."""
    lines = "\n".join(escape(line) for line in text.splitlines())
    return f"<details><summary>{escape(title)}</summary><pre>{lines}</pre></details>"
