"""Jobs on an S3 server behind a proxy that fails, resumed until they are done, as a table.

    python -m benchmarks.faults.s3 [--shards 24] [--seeds 2] [--rate 0.05]

The server is moto's, on the loopback address. A share `rate` of all requests fails: two fifths of them are
refused with 500 or 503; one fifth each is done and answered 500, done and cut off in its answer, and held
until the client times out, done or not. Every third create-only put is done and answered 500. The store is
down for a while five times per campaign, twice right after it has stored a commit. Each campaign ends with a
check of every byte: committed objects and the sealed store equal those of an undisturbed
local run, and the ledger has every execution once, with its end. Anything else raises AssertionError.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

from datagen.schemas.storage import errors
from tests.faults.s3_campaign import Outcome, campaign
from tests.s3_servers import Faults, environment, faulty_proxy, make_bucket, moto_server

TIMEOUT_S = 2.0


def one(upstream: int, shards: int, seed: int, rate: float, folder: Path) -> Outcome:
    """One campaign in a bucket of its own."""
    make_bucket(upstream, f"faults-{seed}")
    share = rate / 5
    faults = Faults(
        error=2 * share,
        lost_answer=share,
        cut=share,
        lost_creates=3,
        hold=share,
        hold_s=1.5 * TIMEOUT_S,
        seed=seed,
        down_after=[100, 20 * shards, 30 * shards],
        down_for_s=1.75 * TIMEOUT_S,
        down_at_commits=[shards // 3, 2 * shards // 3],
    )
    errors.JOBS_WAIT_S = 0.0  # so that jobs give up, and are resumed
    with faulty_proxy(upstream, faults) as port:
        os.environ.update(environment(port) | {"DATAGEN_STORE_TIMEOUT_S": str(TIMEOUT_S)})
        return campaign(f"s3://faults-{seed}/runs/a", shards, faults, folder)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--shards", type=int, default=24)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--rate", type=float, default=0.05)
    options = parser.parse_args()
    kinds = ("error", "lost_answer", "lost_commit", "cut", "hold_before", "hold_after", "down")
    heads = ("seed", "shards", "jobs", "executions", "requests", *kinds)
    print("  ".join(f"{head:>11}" for head in heads))
    with (
        tempfile.TemporaryDirectory(prefix="s3-faults-") as folder,
        moto_server(Path(folder) / "moto.log") as upstream,
    ):
        for seed in range(options.seeds):
            below = Path(folder) / str(seed)
            below.mkdir()
            seen = one(upstream, options.shards, seed, options.rate, below)
            counts = [seen.faults[kind] for kind in kinds]
            row = (seed, seen.shards, seen.jobs, seen.executions, seen.requests, *counts)
            print("  ".join(f"{value:>11,}" for value in row), flush=True)
    print("nothing lost, nothing doubled, every execution in the ledger")


if __name__ == "__main__":
    main()
