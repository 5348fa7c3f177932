"""What a job did: the answer of `submit`, `resume` and `extend`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, eq=False)
class JobResult:
    """What a job did, and what its run holds now. Quarantined shards are those that failed repeatedly."""

    path: str  # the run, as the user wrote it
    # detached: Ray makes the labels. failed: more shards are quarantined than allowed.
    end: Literal["complete", "failed", "interrupted", "aborted", "detached"]
    n: int = 0  # labels wanted
    made_from: str = ""  # houses, objects and robot
    labels: int = 0  # made by this job
    positives: int = 0  # of those
    shards: int = 0  # that were missing when the job began
    remaining: int = 0  # of those, still missing
    quarantined: tuple[int, ...] = ()
    retries: int = 0
    start_s: float = 0.0  # until the first shard began
    elapsed_s: float = 0.0  # from then on
    store: str = ""  # the sealed store, which zarr and xarray open
    cause: str = ""  # of an aborted job, and the most frequent one of a failed job
    resume: tuple[str, ...] = ()  # the words of the command that continues

    @property
    def complete(self) -> bool:
        """Whether the run has all labels that were wanted, but for the allowed share in quarantine."""
        return self.end == "complete"

    @property
    def exit_code(self) -> int:
        """The command line's exit status: 0 good, 1 too many failures, 2 bad place, 130 stopped."""
        return {"complete": 0, "detached": 0, "failed": 1, "aborted": 2, "interrupted": 130}[self.end]
