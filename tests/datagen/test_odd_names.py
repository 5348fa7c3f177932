"""Names that are no Unicode, as a file system allows them: no record could say them."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import pytest

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import Jobs
from datagen.schemas.record_files import decode_record, encode_record
from datagen.schemas.run_records import LedgerEntry
from datagen.schemas.storage import open_storage
from tests.made_runs import files_of, make_run
from tests.refusals import refused
from tests.small_runs import submit_arguments

ODD = os.fsdecode(b"b\xffd")


@pytest.fixture
def odd(tmp_path: Path) -> Path:
    """A folder whose name is Latin-1."""
    folder = tmp_path / ODD
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system takes UTF-8 names alone")
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ["submit", "heuristic", "--n", "8", "--out", ODD],
        *(
            ["submit", "heuristic", "--n", "8", "--out", "run", option, value]
            for option, value in (
                ("--houses", f"procthor:{ODD}"),
                ("--objects", f"ycb:{ODD}"),
                ("--scenes-from", ODD),
                ("--config", f"{ODD}/a.toml"),
            )
        ),
        ["resume", ODD],
        ["merge", ODD, "--out", "merged"],
        ["merge", "plain", "--out", ODD],
        ["relabel", "plain", "--out", ODD],
        ["train", ODD, "--out", "model.pt"],
        ["verify", ODD],
    ],
    ids=" ".join,
)
def test_an_argument_that_is_not_utf8_is_refused(
    words: list[str],
    odd: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    make_run(tmp_path / "plain", 10)
    before = files_of(tmp_path)
    monkeypatch.chdir(tmp_path)
    refused([word.replace(ODD, str(odd)) for word in words], capsys, r"b\udcffd", "not UTF-8")
    assert files_of(tmp_path) == before


def test_a_working_folder_that_is_not_utf8_is_refused_where_a_record_would_name_it(
    odd: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(odd)
    Path("houses.json").write_text("{}")
    outside = submit_arguments(tmp_path / "run", 8)
    inside = ["run" if word == str(tmp_path / "run") else word for word in outside]
    for words in (inside, [*outside, "--houses", "procthor:houses.json"]):
        refused(words, capsys, r"b\udcffd", "not UTF-8")
    assert list(odd.iterdir()) == [odd / "houses.json"] and not (tmp_path / "run").exists()
    assert cli.run(outside) == 0  # nothing names the folder
    (job,) = Jobs(open_storage(tmp_path / "run")).all()
    assert job.state is not None and job.state.end == "complete"


def test_the_log_has_a_command_that_can_be_copied(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "Büro's 2"
    assert cli.run(submit_arguments(run, 8)) == 0
    capsys.readouterr()
    assert cli.run(["status", str(run), "--log"]) == 0
    began = capsys.readouterr().out.splitlines()[0]
    assert str(run) in shlex.split(began.partition(": ")[2])


def test_a_record_of_half_characters_can_be_read_back(odd: Path) -> None:
    """An error's message may name any file, and a host is called as it is."""
    with pytest.raises(FileNotFoundError) as caught:
        (odd / "none").stat()
    entry = LedgerEntry(attempt="a", shard=0, outcome="failed", cause=f"{caught.value} 椅子 😀", stack="x")
    read = decode_record("a.json", encode_record(entry), LedgerEntry)
    assert read.cause == entry.cause.replace("\udcff", "?") and "椅子 😀" in read.cause
    with pytest.raises(InputError, match="not UTF-8"):
        open_storage(odd / "new")
    assert list(odd.iterdir()) == []
