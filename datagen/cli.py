"""The program `datagen`: its verbs, its one-line errors and its exit codes.

Exit codes: 0 success, 1 finished with failures, findings or differences, 2 bad input, 130 interrupted, 141 if
the reader of the output closed it. A verb is imported when it is called, so that `--help` does not wait
for simulators.
"""

from __future__ import annotations

import os
import re
import sys
import threading
from difflib import get_close_matches
from inspect import getdoc
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App, Group, Parameter
from cyclopts.exceptions import (
    CycloptsError,
    MissingArgumentError,
    UnknownCommandError,
    UnusedCliTokensError,
)

from datagen import __version__
from datagen.cluster.ray_settings import ENDING_RAY
from datagen.console.command_lines import PRINTER, Interrupted, begin_with_process
from datagen.console.printing import drop_output
from datagen.display.progress import LossyStream
from datagen.schemas.errors import InputError, one_line, refuse_not_utf8
from datagen.workers.extras import missing_library
from datagen.workers.registry import allow

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Any

    from cyclopts import Argument
    from pydantic import ValidationError

EXIT_GOOD, EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_CLOSED_PIPE = 0, 2, 130, 141

# Headings of --help, each with its verbs: where a verb is defined, and its line. A verb returns an exit code,
# or None for 0. If it is also a Python function, it returns its result, and `prints` names the function that
# prints it.
_HEADINGS: dict[str, dict[str, tuple[str, str]]] = {
    "Make labels": {
        "submit": ("datagen.commands.submit:submit", "Make labels: start a run, or resume it."),
        "resume": ("datagen.commands.resume:resume", "Make the missing labels of a run; extend it."),
        "cancel": ("datagen.commands.cancel:cancel", "Ask the jobs of a run to stop; wait until they have."),
        "merge": ("datagen.commands.merge:merge", "Merge runs into one."),
        "relabel": ("datagen.commands.relabel:relabel", "Label a heuristic run by other parameters."),
    },
    "Look at runs": {
        "status": ("datagen.commands.status:status", "Show progress, failures and events of a run."),
        "show": ("datagen.commands.show:show", "Draw a picture of one scene of a run."),
        "view": ("datagen.commands.view:view", "Open scenes of a run in the viewer Rerun."),
        "audit": ("datagen.commands.audit:audit", "Show the cost of labels by stage."),
        "export": ("datagen.commands.export:export", "Write a run in the format of another program."),
    },
    "Check runs": {
        "verify": ("datagen.commands.verify:verify", "Check a run; repair, replay or clean it."),
    },
    "Models": {
        "train": ("datagen.commands.train:train_model", "Train a model on labels."),
        "evaluate": ("datagen.commands.evaluate:evaluate", "Compare models with baselines and the paper."),
        "calibrate": (
            "datagen.commands.calibrate:calibrate",
            "Fit the heuristic's parameters to trial labels.",
        ),
        "benchmark": ("datagen.commands.benchmark:app", "Make and score the frozen benchmark."),
        "predict": ("datagen.commands.predict:predict", "Find a base pose in a depth camera's frame."),
        "serve": ("datagen.commands.serve:serve", "Find base poses for programs, over HTTP."),
    },
    "This machine": {
        "assets": ("datagen.assets.cli:app", "List, fetch and split houses and objects."),
        "robot": ("datagen.commands.robot:robot", "Open a robot's file; print, measure and draw it."),
        "doctor": ("datagen.doctor:doctor", "Check this machine, and show how to fix what is missing."),
    },
}
VERBS = {verb: defined for verbs in _HEADINGS.values() for verb, defined in verbs.items()}

# The extra to name for a verb where several extras contain the missing library.
_EXTRA_OF: dict[str, str] = dict.fromkeys(_HEADINGS["Models"], "train") | {
    "benchmark": "predict",
    "predict": "predict",
    "serve": "serve",
}


def build_app(called: str = "") -> App:
    """The command line. Only the verb `called` is imported: its docstring is its help text."""
    headings = [(Group.create_ordered(name), verbs) for name, verbs in _HEADINGS.items()]
    groups = {verb: group for group, verbs in headings for verb in verbs}
    app = App(
        name="datagen",
        group_commands=Group.create_ordered("Options"),
        help="Labelled robot base poses from furnished houses.",
        version=f"datagen {__version__}",
        # `main` prints errors itself: one line each, without a frame.
        print_error=False,
        exit_on_error=False,
        suppress_keyboard_interrupt=False,
        # Every flag is off unless given, and has no negative form.
        default_parameter=Parameter(
            negative=(), show_default=lambda value: None if value is False else value
        ),
    )
    for number, (verb, (target, line)) in enumerate(VERBS.items()):
        text = None if verb == called else line
        app.command(target, name=verb, help=text, group=groups.get(verb), sort_key=number)
    return app


def _usage_line(error: CycloptsError) -> str:
    """One line for a wrong command line; for an unknown verb, no verb is imported."""
    error.verbose = False
    words = ["datagen", *(error.command_chain or ())]
    verb, see = " ".join(words), f"See: {' '.join(words)} --help"
    if isinstance(error, UnknownCommandError) and len(words) == 1:
        token = (error.unused_tokens or ["?"])[0]
        if token.startswith("-"):
            return f'unknown option "{token}" before the command. {see}'
        near = get_close_matches(token, VERBS, n=1)
        return f'unknown command "{token}". {f"Did you mean {near[0]}? " if near else ""}{see}'
    if isinstance(error, UnusedCliTokensError):
        return f'{verb}: unexpected argument "{" ".join(error.unused_tokens or ())}". {see}'
    if isinstance(error, MissingArgumentError) and error.argument is not None:
        named, lacks = error.keyword or error.argument.name, "has no value" if error.keyword else "is missing"
        problem = f"{named} {lacks}"
        if near := str(error).partition(" Did you mean ")[2]:  # a mistyped option
            return f"{verb}: {problem}. Did you mean {near} {see}"
        about = _help_of(error.argument, error.target).rstrip(".")
        example = re.search(r"For example: (.+)", getdoc(error.target) or "")
        return f"{verb}: {problem}: {about}. {f'{example[0]}. ' if example else ''}{see}"
    return re.sub(r'unable to convert (".*") into float', r"\1 is not a number", f"{error} {see}")


def _help_of(argument: Argument, verb: Callable[..., Any] | None) -> str:
    """The help of an option, from the verb's docstring; the argument of an error has none."""
    app = App()
    app.default(verb)
    documented = app.assemble_argument_collection(parse_docstring=True)
    return next((a.parameter.help for a in documented if a.name == argument.name), None) or ""


def _validation_lines(error: ValidationError) -> list[str]:
    """One line for each field that a pydantic model refused."""
    lines: list[str] = []
    for detail in error.errors(include_url=False, include_context=False):
        field = ".".join(str(part) for part in detail["loc"]) or "value"
        given = one_line(repr(detail["input"]))
        given = given if len(given) <= 80 else given[:77] + "..."
        lines.append(f"{error.title}: {field}: {detail['msg']}. Given: {given}")
    return lines


def _lines_for(error: Exception, verb: str) -> list[str] | None:
    """Lines for the user, or None where the error is a defect of this program."""
    if isinstance(error, InputError):
        return [str(error)]
    if isinstance(error, CycloptsError):
        return [_usage_line(error)]
    if isinstance(error, OSError):
        from datagen.schemas.storage.errors import machine_error

        return [str(known)] if (known := machine_error(error)) else None
    if (missing := missing_library(error, _EXTRA_OF.get(verb, "labels"))) is not None:
        return [str(missing)]
    # pydantic takes 0.1 s to import; its errors exist only where it is imported already.
    if "pydantic" in sys.modules:
        from pydantic import ValidationError

        if isinstance(error, ValidationError):
            return _validation_lines(error)
    return None


def run(arguments: Sequence[str]) -> int:
    """Run one command line and return its exit code; errors go to standard error.

    Defects of this program are not caught: a bug report needs their traceback.
    """
    verb = next(iter(arguments), "")
    allow(arguments)
    try:
        code = _call(build_app(verb), [_expand_home(refuse_not_utf8(word)) for word in arguments])
        sys.stdout.flush()
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return EXIT_INTERRUPTED
    except (BrokenPipeError, SystemExit) as error:
        # The reader closed the pipe (`datagen status | head`); rich raises SystemExit for it.
        if isinstance(error, SystemExit) and not isinstance(error.__context__, BrokenPipeError):
            raise
        drop_output()
        return EXIT_CLOSED_PIPE
    except Exception as error:
        lines = _lines_for(error, verb)
        if lines is None:
            raise
        for line in lines:
            sys.stderr.write(f"error: {one_line(line)}\n")
        return EXIT_BAD_INPUT
    return code


def _expand_home(word: str) -> str:
    """A word with its `~/` expanded, which shells leave as it is in `--out=~/FILE`."""
    return re.sub("^(--[^=]+=)?~(?=/)", lambda found: f"{found[1] or ''}{Path.home()}", word)


def _call(app: App, words: Sequence[str]) -> int:
    """Call the verb of a command line, print what it returns, and return the exit code."""
    command, bound, _ = app.parse_args(words)
    printer = getattr(command, PRINTER, None)
    try:
        result = command(*bound.args, **bound.kwargs)
    except Interrupted as interrupted:
        result = interrupted.result
    if printer is not None:
        bound.apply_defaults()
        return printer(result, **bound.arguments)
    return result if isinstance(result, int) else EXIT_GOOD


def main() -> None:
    """Run the console script `datagen`."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:  # closed by the shell (`>&-`): no other file may get its descriptor
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), "w" if number else "r"))
    sys.stderr = LossyStream(sys.stderr)
    begin_with_process()
    code = run(sys.argv[1:])
    if any(thread.name == ENDING_RAY for thread in threading.enumerate()):
        os._exit(code)  # the end of the interpreter would wait for Ray's stopped servers too
    sys.exit(code)


if __name__ == "__main__":
    main()
