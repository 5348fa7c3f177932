"""The page of a report: a section for each run and each checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from datagen import __version__
from datagen.display.html_page import escape, html_page
from datagen.html_report.run_section import run_section
from datagen.released import checkpoint_file
from datagen.schemas.errors import InputError
from datagen.schemas.run import open_runs

Section = tuple[str, Callable[[str], Iterator[str]]]


def report_page(paths: Sequence[str]) -> str:
    """The page about runs, also merged ones, and checkpoints. InputError for other paths."""
    sections = [section for path in dict.fromkeys(paths) for section in _sections(path)]
    body: list[str] = []
    if len(sections) > 1:
        links = (f'<li><a href="#part-{k}">{escape(title)}</a></li>' for k, (title, _) in enumerate(sections))
        body.append(f"<nav><ul>{''.join(links)}</ul></nav>")
    for k, (title, section) in enumerate(sections):
        body += [f'<h2 id="part-{k}">{escape(title)}</h2>', *section(f"part-{k}")]
    return html_page(
        "Report of labels and models", [*body, f"<p class=note>datagen {escape(__version__)}</p>"]
    )


def _sections(path: str) -> list[Section]:
    if "://" in path or Path(path).is_dir():
        return [(f"Run {run.storage.url}", partial(run_section, run)) for run in open_runs(path)]
    if (file := checkpoint_file(path)) is None:
        raise InputError(path, "", "is neither a run's folder nor a file", "Name runs and checkpoints")
    # Imported here: torch takes seconds to load, and a report of runs does not need it.
    from datagen.html_report.model_section import model_section

    return [(f"Model {path}", partial(model_section, Path(file)))]
