"""Options of the verbs that run jobs, and the words that say them again."""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from datagen.cluster.ray_cluster import refuse_unusable
from datagen.console.command_lines import resumable, words_of
from datagen.console.whole_number import WHOLE_NUMBER
from datagen.schemas.errors import InputError, refuse_not_utf8
from datagen.schemas.progress import Progress
from datagen.workers.extras import refuse_missing

DEFAULT_SHARE = 0.01
# Variables of a detached job: its name at Ray, and where Ray answers for it.
SUBMISSION, JOBS_API = "DATAGEN_SUBMISSION", "DATAGEN_JOBS_API"
_DETACH = (
    "Hand the job to Ray and come back: it goes on when this shell ends. With --address, to that cluster "
    "(its dashboard, as http://HOST:8265, or itself); else to one that stays on this machine."
)


@Parameter(name="*")
@dataclass(frozen=True)
class Placing:
    """Where and how a job runs; nothing of this changes a sample."""

    workers: Annotated[
        int | None,
        WHOLE_NUMBER,
        Parameter(help="Worker processes [one a core]; 0 works in this process, for debuggers."),
    ] = None
    address: Annotated[str, Parameter(help="local, or the address of a running Ray cluster.")] = "local"
    max_quarantined: Annotated[
        float, Parameter(help="Share of the run's shards that may be given up before the job has failed.")
    ] = DEFAULT_SHARE
    detach: Annotated[bool, Parameter(negative=(), help=_DETACH)] = False
    json: Annotated[bool, Parameter(negative=(), help="Report progress as JSON lines on standard error.")] = (
        False
    )

    def refuse_bad(self) -> None:
        """Raise InputError for values out of range and, unless detached, for a cluster that is not there."""
        if self.workers is not None and not 0 <= self.workers <= 4096:
            mend = "Leave it out for one a core"
            raise InputError("--workers", str(self.workers), "is not between 0 and 4096", mend)
        if not 0 <= self.max_quarantined <= 1:
            given = str(self.max_quarantined)
            raise InputError("--max-quarantined", given, "is not a share", "Give 0.01 for one in a hundred")
        if self.workers != 0 or self.detach:
            refuse_missing("cluster", "" if self.detach else "or work in this process: --workers 0")
        if self.workers != 0 and not self.detach:
            refuse_unusable(self.address)

    def words(self) -> list[str]:
        """The options that say the same again, without --detach and --address."""
        share = None if self.max_quarantined == DEFAULT_SHARE else self.max_quarantined
        return words_of({"--workers": self.workers, "--max-quarantined": share, "--json": self.json})

    def address_words(self) -> list[str]:
        """--address, where it is not `local`."""
        return words_of({"--address": None if self.address == "local" else self.address})


HERE = Placing()


def refuse_odd_n(n: int) -> None:
    """Raise InputError for a number of labels that no run has."""
    if not 1 <= n <= 10**12:
        raise InputError("--n", str(n), "is not between 1 and 10^12", "Say how many labels you want")


@contextmanager
def opening(words: Sequence[str], placing: Placing) -> Generator[float]:
    """Show that sources are being opened, and tell whoever interrupts that how to go on.

    Gives the moment at which it began, by the monotonic clock.
    """
    began_s = time.monotonic()
    with resumable([*words, *placing.address_words()]), Progress(placing.json) as shown:
        shown.phase("opening houses and objects")
        yield began_s


def absolute_source(ref: str) -> str:
    """A source reference with its file or folder made absolute: workers run elsewhere."""
    kind, _, text = ref.partition(":")
    # What names no file is a parameter of the source, as in builtin:400.
    is_path = bool(text) and kind != "builtin" and Path(text).expanduser().exists()
    return refuse_not_utf8(f"{kind}:{Path(text).expanduser().resolve()}" if is_path else ref)


def absolute_place(place: str) -> str:
    """A run's address as every folder and machine understands it."""
    if "://" in place and not place.startswith("file://"):
        return place
    return str(Path(place.removeprefix("file://")).expanduser().absolute())
