"""A command's time counts its imports; a Python call's does not count what the process did before."""

from __future__ import annotations

import time

from datagen.console.beginning import began_with_process, beginning_s

LOADED_S = time.monotonic()


def test_a_command_begins_with_its_process_and_a_call_with_itself() -> None:
    before_s = time.monotonic()
    assert before_s <= beginning_s() <= time.monotonic()
    with began_with_process():
        assert beginning_s() < LOADED_S
    assert beginning_s() >= before_s
