"""A page of HTML as its parts."""

from __future__ import annotations

import re
from html.parser import HTMLParser

# Elements that only text and figures need; none loads or runs something.
_HARMLESS = (
    "html head meta title style body h1 h2 h3 p ul li a nav section code dl dt dd div table tr th td figure "
    "figcaption details summary pre img svg g path defs use clippath rect image"
)


class Page(HTMLParser):
    """Tags, addresses, handlers of events and text of a page."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.handlers: list[str] = []
        self.words: list[str] = []
        self.source = source
        self.feed(source)
        self.text = re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.handlers += [k for k, _ in attrs if k.startswith("on")]
        names = ("src", "href", "xlink:href", "srcset", "action", "data")
        self.addresses += [v for k, v in attrs if k in names and v]

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    def check_harmless(self) -> None:
        """The page runs nothing and asks for nothing."""
        assert set(self.tags) <= set(_HARMLESS.split(" ")) and not self.handlers
        assert all(address.startswith(("#", "data:image/")) for address in self.addresses)
