"""One finding of the doctor, and the probe that runs code in a separate process."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import dataclass
from typing import Literal

Status = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class Check:
    """One line of the report. `fail`: labels cannot be made; `warn`: a feature is missing."""

    name: str
    status: Status
    detail: str
    fix: str = ""


@dataclass(frozen=True)
class Probe:
    """The result of a probe: its last line of output, or why there is none."""

    succeeded: bool
    text: str

    def check(self, name: str, failed: Status, fix: str) -> Check:
        """The check of that name: ok, or `failed` with its fix."""
        return Check(name, "ok", self.text) if self.succeeded else Check(name, failed, self.text, fix)


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1][:200] if lines else ""


def probe(code: str, timeout_s: float = 60.0) -> Probe:
    """Run Python code in a new interpreter, so that a crash or a hang is only a finding."""
    try:
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", code],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired:
        return Probe(False, f"no result within {timeout_s:.0f} s")
    except OSError as error:
        return Probe(False, f"cannot start an interpreter: {error.strerror}")
    if done.returncode == 0:
        return Probe(True, _last_line(done.stdout))
    if done.returncode < 0:
        return Probe(False, f"crashed with {signal.Signals(-done.returncode).name}")
    return Probe(False, _last_line(done.stderr) or f"exit code {done.returncode}")
