"""Options of the verbs that run jobs, and their words for the command that resumes."""

from __future__ import annotations

import io
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypedDict

from cyclopts import Parameter
from rich.console import Console

from datagen.cluster.budget import Budget
from datagen.cluster.ray_cluster import refuse_unusable
from datagen.console.beginning import beginning_s
from datagen.console.command_lines import resumable, words_of
from datagen.console.options import Whole
from datagen.display.progress import Progress
from datagen.jobs.budget_option import parse_budget
from datagen.reports.prices import read_prices
from datagen.schemas.errors import InputError, refuse_not_utf8
from datagen.workers.extras import refuse_missing

DEFAULT_SHARE = 0.01
# Environment variables of a detached job: its submission id at Ray, and the address of Ray's Jobs API.
SUBMISSION, JOBS_API = "DATAGEN_SUBMISSION", "DATAGEN_JOBS_API"
_DETACH = (
    "Run as a Ray job that continues after this shell ends: on the cluster of --address (its dashboard "
    "http://HOST:8265 or the cluster itself), else on a Ray head of this machine."
)


class JobKeywords(TypedDict, total=False):
    """Where and how a job runs; no option changes a sample."""

    workers: Annotated[
        Whole | None, Parameter(help="Worker processes [one per core]; 0: this process, for debuggers.")
    ]
    address: Annotated[str, Parameter(help="local, or the address of a Ray cluster [local].")]
    max_quarantined: Annotated[
        float, Parameter(help="Largest quarantined share of the run's shards in a successful job [0.01].")
    ]
    detach: Annotated[bool, Parameter(help=_DETACH)]
    dry_run: Annotated[
        bool,
        Parameter(help="Make nothing: print shards, time, CPU time, bytes and money with 80% intervals."),
    ]
    budget: Annotated[
        str | None,
        Parameter(help="End before the first shard beyond a time (2h), CPU time (5cpu-h) or money (3usd)."),
    ]
    prices: Annotated[
        str | None, Parameter(help="TOML file with prices of core-hours and stored bytes [list prices].")
    ]
    json: Annotated[bool, Parameter(help="Print progress as JSON lines to standard error.")]
    quiet: Annotated[bool, Parameter(parse=False)]  # the command line always reports progress


@dataclass(frozen=True)
class JobOptions:
    """The values of JobKeywords."""

    workers: int | None = None
    address: str = "local"
    max_quarantined: float = DEFAULT_SHARE
    detach: bool = False
    dry_run: bool = False
    budget: str | None = None
    prices: str | None = None
    json: bool = False
    quiet: bool = False

    def refuse_bad(self) -> None:
        """Raise InputError for values out of range and, unless detached, for an unreachable cluster."""
        if self.workers is not None and not 0 <= self.workers <= 4096:
            fix = "Omit it for one per core"
            raise InputError("--workers", str(self.workers), "is not between 0 and 4096", fix)
        if not 0 <= self.max_quarantined <= 1:
            given = str(self.max_quarantined)
            raise InputError("--max-quarantined", given, "is not a share", "Give 0.01 for one in a hundred")
        if self.dry_run and self.detach:
            raise InputError("--dry-run", "--detach", "a forecast is made in this shell", "Omit one of them")
        read_prices(self.prices)
        _ = self.limit
        if self.workers != 0 or self.detach:
            refuse_missing("cluster", "" if self.detach else "or work in this process: --workers 0")
        if self.workers != 0 and not self.detach:
            refuse_unusable(self.address)

    @property
    def limit(self) -> Budget | None:
        """The budget; None without one. InputError for another text than `parse_budget` accepts."""
        return None if self.budget is None else parse_budget(self.budget, self.prices)

    def display(self) -> Progress:
        """The display of progress on standard error."""
        return Progress(self.json, console=Console(file=io.StringIO()) if self.quiet else None)

    def words(self) -> list[str]:
        """The words of these options, without --detach, --address and --dry-run."""
        share = None if self.max_quarantined == DEFAULT_SHARE else self.max_quarantined
        prices = self.prices and str(Path(self.prices).expanduser().absolute())
        words = {"--workers": self.workers, "--max-quarantined": share, "--budget": self.budget}
        return words_of(words | {"--prices": prices, "--json": self.json})

    def address_words(self) -> list[str]:
        """The words of --address, where it is not `local`."""
        return words_of({"--address": None if self.address == "local" else self.address})


def refuse_odd_n(n: int) -> None:
    """Raise InputError for a number of labels out of range."""
    if not 1 <= n <= 10**12:
        raise InputError("--n", str(n), "is not between 1 and 10^12", "Give the number of labels wanted")


@contextmanager
def opening(words: Sequence[str], job_options: JobOptions) -> Generator[float]:
    """Report that sources are opened, and how to resume after an interrupt; yield `beginning_s()`."""
    began_s = beginning_s()
    with resumable([*words, *job_options.address_words()]), job_options.display() as shown:
        shown.phase("opening houses and objects")
        yield began_s


def absolute_source(ref: str) -> str:
    """A source reference with its file or folder made absolute: workers run elsewhere."""
    kind, _, text = ref.partition(":")
    # Text that is not an existing path is a parameter of the source, as in builtin:400.
    is_path = bool(text) and kind != "builtin" and Path(text).expanduser().exists()
    return refuse_not_utf8(f"{kind}:{Path(text).expanduser().resolve()}" if is_path else ref)


def absolute_path(path: str | Path) -> str:
    """A run's absolute path or its address, valid in every folder."""
    path = str(path)
    if "://" in path and not path.startswith("file://"):
        return path
    return str(Path(path.removeprefix("file://")).expanduser().absolute())
