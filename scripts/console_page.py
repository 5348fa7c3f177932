"""Run the commands of a document in order, to fill in their output or to test it.

    python scripts/console_page.py docs/tutorials/make-labels.md --folder build/runs --set ASSETS=DIR --write

A block fenced as `console` holds commands after `$ `, their further lines after `> `, and their output. A
last line `[exit 1]` is an exit code other than 0. Progress, which goes to standard error, is left out.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

_BLOCK = re.compile(r"^```console\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_EXIT = re.compile(r"\[exit ([0-9]+)\]")


@dataclass(frozen=True)
class Command:
    """One command of a page, with its output there."""

    lines: tuple[str, ...]
    output: tuple[str, ...]
    exit_code: int

    @property
    def text(self) -> str:
        return "\n".join(self.lines)

    def page_lines(self) -> Iterator[str]:
        yield from ("$ " + self.lines[0], *("> " + line for line in self.lines[1:]), *self.output)
        if self.exit_code:
            yield f"[exit {self.exit_code}]"


def commands_of(page: str) -> list[Command]:
    """All commands of a page, in order."""
    return [command for block in _BLOCK.findall(page) for command in _commands(block)]


def run_command(command: Command, folder: Path, environment: Mapping[str, str]) -> Command:
    """Run the command; return it with its output and exit code now."""
    done = subprocess.run(
        ["bash", "-c", command.text], cwd=folder, env={**os.environ, **environment}, text=True,
        capture_output=True, check=False,
    )  # fmt: skip
    errors = [line for line in done.stderr.splitlines() if line.startswith(("error:", "Traceback"))]
    here = str(folder.resolve())  # pages name no folder of this machine
    output = tuple(line.rstrip().replace(here, ".") for line in [*done.stdout.splitlines(), *errors])
    return Command(command.lines, output, done.returncode)


def labels_of(output: tuple[str, ...]) -> list[str]:
    """The words that begin the lines of an output, up to the first with a digit in it or a wide gap."""
    starts = (re.split(r"\s{2,}|\b\w*[0-9]", line.strip(), maxsplit=1)[0].strip() for line in output)
    return [start for start in starts if start]


def _commands(block: str) -> Iterator[Command]:
    lines: list[str] = []
    output: list[str] = []
    exit_code = 0
    for line in [*block.splitlines(), "$ "]:
        if line.startswith("$ "):
            if lines:
                while output and not output[-1]:
                    output.pop()
                yield Command(tuple(lines), tuple(output), exit_code)
            lines, output, exit_code = [line[2:]], [], 0
        elif line.startswith("> ") and not output:
            lines.append(line[2:])
        elif found := _EXIT.fullmatch(line):
            exit_code = int(found[1])
        else:
            output.append(line)


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("--folder", type=Path, required=True, help="where the commands run; made if absent")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="environment")
    parser.add_argument("--write", action="store_true", help="put what they print into the page")
    chosen = parser.parse_args()
    chosen.folder.mkdir(parents=True, exist_ok=True)
    environment = dict(pair.split("=", 1) for pair in chosen.set)
    page = chosen.page.read_text()

    def filled(match: re.Match[str]) -> str:
        lines: list[str] = []
        for command in _commands(match[1]):
            now = run_command(command, chosen.folder, environment)
            print("\n".join(now.page_lines()), flush=True)
            lines += now.page_lines()
            if now.exit_code != command.exit_code:
                sys.exit(f"error: exit {now.exit_code}, where the page says {command.exit_code}")
        return "```console\n" + "\n".join(lines) + "\n```"

    filled_page = _BLOCK.sub(filled, page)
    if chosen.write:
        chosen.page.write_text(filled_page)


if __name__ == "__main__":
    _main()
