"""The program `datagen`: its verbs, and what becomes of errors on the way out.

Exit codes: 0 good, 1 finished and something is wrong (too many failures, findings, differences), 2 bad input,
130 interrupted, 141 if the reader of the output closed it. Verbs are loaded only when called, so that
`datagen --help` does not wait for simulators.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from cyclopts import App, Parameter
from cyclopts.exceptions import CycloptsError, UnknownCommandError

from datagen import __version__
from datagen.cluster.environment import job_environment
from datagen.schemas.errors import InputError, one_line, refuse_not_utf8
from datagen.workers.extras import missing_library

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pydantic import ValidationError

EXIT_GOOD, EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_CLOSED_PIPE = 0, 2, 130, 141

# Verb -> (where it lives, its line in --help). Verbs return an exit code, or None for 0.
VERBS: dict[str, tuple[str, str]] = {
    "submit": ("datagen.commands.submit:submit", "Make labels: start a run, or resume it."),
    "resume": ("datagen.commands.resume:resume", "Make what is missing of a run, or of merged runs."),
    "extend": ("datagen.commands.extend:extend", "Want more labels of a run, and make them."),
    "cancel": ("datagen.commands.cancel:cancel", "Ask the jobs of a run to stop, and wait for their end."),
    "logs": ("datagen.commands.logs:logs", "What happened in a run, in order of time."),
    "status": ("datagen.commands.status:status", "How far a run is, and what failed."),
    "seal": ("datagen.commands.seal:seal", "One Zarr store over a run, that any zarr reader opens."),
    "unseal": ("datagen.commands.seal:unseal", "Remove that store; the run keeps every shard."),
    "merge": ("datagen.commands.merge:merge", "One run of several that were made apart."),
    "verify": ("datagen.commands.verify:verify", "Whether a run is what it says, to the last byte."),
    "repair": ("datagen.commands.repair:repair", "Mend what verify finds, and touch nothing else."),
    "replay": ("datagen.commands.replay:replay", "One sample's scene made again, beside what is stored."),
    "relabel": ("datagen.commands.relabel:relabel", "Labels by another rule, from stored distances."),
    "calibrate": ("datagen.commands.calibrate:calibrate", "Fit the heuristic's rule to labels of trials."),
    "audit": ("datagen.commands.audit:audit", "What labels cost, by stage, and what 180,000 would."),
    "gc": ("datagen.commands.gc:gc", "Remove what a run holds and nothing names."),
    "show": ("datagen.commands.show:show", "A picture of one scene of a run."),
    "train": (
        "datagen.commands.train:train",
        "Train a model on labels: stage 1, stage 2, or sim labels alone.",
    ),
    "evaluate": (
        "datagen.commands.evaluate:evaluate",
        "How good models are, beside baselines and the paper.",
    ),
    "predict": ("datagen.commands.predict:predict", "A base pose from a depth camera's frame."),
    "doctor": ("datagen.doctor:doctor", "What this machine can do, and how to mend what it cannot."),
    "assets": ("datagen.assets.cli:app", "List, fetch, lock and verify houses and objects."),
}

# The extra to name where a library that a verb lacks comes with several.
_EXTRA_OF: dict[str, str] = dict.fromkeys(("train", "evaluate", "predict", "calibrate"), "train")


def build_app(called: str = "") -> App:
    """The command line with every verb of `VERBS` registered and none imported.

    The verb that is called describes itself, by its docstring.
    """
    app = App(
        name="datagen",
        help="Labelled robot base poses from furnished houses.",
        version=f"datagen {__version__}",
        # `main` prints errors itself: one line each, without a frame.
        print_error=False,
        exit_on_error=False,
        suppress_keyboard_interrupt=False,
        result_action="return_value",
        # Every flag is off unless given.
        default_parameter=Parameter(show_default=lambda value: None if value is False else value),
    )
    for verb, (target, line) in VERBS.items():
        app.command(target, name=verb, help=None if verb == called else line)
    return app


def _usage_line(error: CycloptsError) -> str:
    """One line for a wrong command line; unknown verbs are answered without loading the known ones."""
    error.verbose = False
    if isinstance(error, UnknownCommandError) and not error.command_chain:
        token = (error.unused_tokens or ["?"])[0]
        word = "option" if token.startswith("-") else "command"
        return f'unknown {word} "{token}". Choose one of: {", ".join(VERBS)}'
    chain = " ".join(error.command_chain or ())
    return f"{error} See: datagen {chain} --help" if chain else f"{error} See: datagen --help"


def _validation_lines(error: ValidationError) -> list[str]:
    """One line for each field that a model refused."""
    lines: list[str] = []
    for detail in error.errors(include_url=False, include_context=False):
        field = ".".join(str(part) for part in detail["loc"]) or "value"
        given = one_line(repr(detail["input"]))
        given = given if len(given) <= 80 else given[:77] + "..."
        lines.append(f"{error.title}: {field}: {detail['msg']}. Given: {given}")
    return lines


def _lines_for(error: Exception, verb: str) -> list[str] | None:
    """What the user is told, or None when the error is a defect of this program."""
    if isinstance(error, InputError):
        return [str(error)]
    if isinstance(error, CycloptsError):
        return [_usage_line(error)]
    if isinstance(error, OSError):
        from datagen.schemas.storage.errors import machine_error

        return [str(known)] if (known := machine_error(error)) else None
    if (missing := missing_library(error, _EXTRA_OF.get(verb, "labels"))) is not None:
        return [str(missing)]
    # pydantic takes 0.1 s to import; whoever raised its error has imported it.
    if "pydantic" in sys.modules:
        from pydantic import ValidationError

        if isinstance(error, ValidationError):
            return _validation_lines(error)
    return None


def run(arguments: Sequence[str]) -> int:
    """Run one command line and return its exit code; messages go to standard error.

    Defects of this program are not caught: their traceback is what a report of them needs.
    """
    verb = next(iter(arguments), "")
    try:
        result = build_app(verb)([refuse_not_utf8(word) for word in arguments])
        sys.stdout.flush()
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return EXIT_INTERRUPTED
    except (BrokenPipeError, SystemExit) as error:
        # The reader went away (`datagen status | head`), which rich makes an exit of its own.
        if isinstance(error, SystemExit) and not isinstance(error.__context__, BrokenPipeError):
            raise
        # Python's own flush at exit would complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_CLOSED_PIPE
    except Exception as error:
        lines = _lines_for(error, verb)
        if lines is None:
            raise
        for line in lines:
            sys.stderr.write(f"error: {one_line(line)}\n")
        return EXIT_BAD_INPUT
    return result if isinstance(result, int) else EXIT_GOOD


def main() -> None:
    """The console script."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:  # closed by the shell (`>&-`): no file may get its number
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), "w" if number else "r"))
    with job_environment():
        code = run(sys.argv[1:])
    sys.exit(code)


if __name__ == "__main__":
    main()
