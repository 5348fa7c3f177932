"""Records of another user's run, printed: nothing in them reaches a terminal but as text."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen import cli
from datagen.console.printing import print_lines, print_rows
from datagen.schemas.jobs import JobRecord, Jobs, JobState
from datagen.schemas.run_records import LedgerEntry
from datagen.train.prediction.page import escaped
from tests.made_runs import give_up, make_run

# A colour, the clipboard (OSC 52), a bell, a carriage return, C1 controls, text that runs backwards, markup.
EVIL = (
    "\x1b[31m\x1b]52;c;cm0gLXJmIH4=\x07\r\x08\x9b2J\u202egnp\u2066x\u2069\u200f"
    "[red]told[/red][link=http://example.org]y[/link][/]<script>\u2028"
)
AT = "2026-01-01T00:00:00.000+00:00"
ATTEMPT = "000001-aaaaaaaa-000001"


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose every free text is hostile."""
    run = make_run(tmp_path_factory.mktemp("foreign") / "run", n=50, shards=[0, 2, 4])
    stack = f"line one {EVIL}\nline two {EVIL}"
    entry = LedgerEntry(
        attempt=ATTEMPT, shard=1, outcome="failed", cause=EVIL, stack=stack, started=AT, ended=AT
    )
    run.ledger.end(entry)
    give_up(run, 1, EVIL, attempts=(ATTEMPT,), stack=stack, at=AT)
    jobs = Jobs(run.storage)
    for number, end in enumerate(("failed", "")):
        job = f"20260101T00000{number}-aaaaaaaa"
        evil = dict.fromkeys(("host", "address", "submission", "jobs_api"), EVIL)
        jobs.begin(JobRecord(id=job, command=("submit", EVIL), pid=1, started=AT, **evil))
        jobs.put_state(JobState(id=job, updated=AT, phase="making", end=end, cause=EVIL, stopping=EVIL))
        if not end:
            jobs.ask_to_stop(job, at_once=False)
    return Path(run.storage.url)


VERBS = [
    ["status", "{run}", "--log"],
    ["status", "{run}", "--log", "--stacks"],
    ["status", "{run}", "--log", "--stacks", "--json"],
    ["status", "{run}"],
    ["status", "{run}", "--stacks"],
    ["status", "{run}", "--json"],
    ["audit", "{run}"],
    ["verify", "{run}"],
    ["verify", "{run}", "--repair", "--clean"],
    ["show", "{run}", "--scene", "0", "--out", "{out}.png"],
    ["merge", "{run}", "--out", "{out}"],
    ["resume", "{run}", "--workers", "0"],
    ["resume", "{run}", "--n", "60", "--workers", "0"],
]


@pytest.mark.parametrize("words", VERBS, ids=lambda words: " ".join(words[:1] + words[2:4]))
def test_no_verb_prints_what_a_terminal_acts_on(
    words: list[str], foreign: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert cli.run([word.format(run=foreign, out=tmp_path / "out") for word in words]) in (0, 1, 2)
    told = capfd.readouterr()
    for text in (told.out, told.err):
        assert all(c.isprintable() or c == "\n" for c in text), [c for c in text if not c.isprintable()]
    assert "Traceback" not in told.err
    if words[0] == "status" and words[-1] != "--json":
        assert "\\x1b]52;c" in told.out and "[red]told" in "".join(told.out.split())


def test_tables_take_brackets_for_brackets(capsys: pytest.CaptureFixture[str]) -> None:
    print_rows(f"title {EVIL}", [("a [red]b[/red]", "[/]"), (EVIL, "")], ("[bold]head", "n"))
    told = capsys.readouterr().out
    assert "a [red]b[/red]" in told and "[/]" in told and "[bold]head" in told
    assert all(c.isprintable() or c == "\n" for c in told)


def test_a_page_shows_what_it_is_given() -> None:
    assert escaped(EVIL).isprintable() and "<" not in escaped(EVIL) and "\\u202e" in escaped(EVIL)


def test_lines_keep_their_breaks(capsys: pytest.CaptureFixture[str]) -> None:
    print_lines("one\x1b\r\ntwo\rthree\u2028four\tfive", "> ")
    assert capsys.readouterr().out == "> one\\x1b\n> two\n> three\n> four\\tfive\n"
