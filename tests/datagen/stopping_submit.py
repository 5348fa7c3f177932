"""`datagen` in a process that stops itself (SIGSTOP) at its second attempt.

Killed there, it leaves one commit and one attempt without an end, however fast the machine is.

    python -m tests.datagen.stopping_submit submit heuristic --workers 0 ...
"""

from __future__ import annotations

import os
import signal
import sys
from unittest import mock

from datagen import cli
from datagen.schemas.record_files import Ledger


def _main() -> None:
    start = Ledger.start
    begun: list[str] = []

    def start_once(ledger: Ledger, attempt: str, shard: int) -> None:
        start(ledger, attempt, shard)
        begun.append(attempt)
        if len(begun) > 1:
            os.kill(os.getpid(), signal.SIGSTOP)

    with mock.patch.object(Ledger, "start", start_once):
        sys.exit(cli.run(sys.argv[1:]))


if __name__ == "__main__":
    _main()
