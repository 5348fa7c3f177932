"""Verbs that are also Python functions, options declared once, command lines to copy, and interruptions."""

from __future__ import annotations

import inspect
import shlex
import signal
import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import wraps
from pathlib import Path
from threading import current_thread, main_thread
from types import FrameType
from typing import Any, ParamSpec, TypeVar, get_type_hints

from datagen.schemas.errors import refuse_not_utf8

Verb = TypeVar("Verb", bound=Callable[..., Any])
Parameters = ParamSpec("Parameters")
Options = TypeVar("Options")
Result = TypeVar("Result")
PRINTER = "print_result"


def options_of(
    kind: Callable[Parameters, Options],
) -> Callable[[Callable[[Options], Result]], Callable[Parameters, Result]]:
    """Give a verb the arguments of a dataclass, `kind`, in Python and on the command line.

    The verb gets the dataclass as its only argument. Fields that are not keyword-only are positional. Their
    help is in their annotations or in the section `Args:` of the dataclass's docstring, and `__post_init__`
    checks them.
    """

    def with_options(verb: Callable[[Options], Result]) -> Callable[Parameters, Result]:
        @wraps(verb)
        def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
            return verb(kind(*args, **kwargs))

        plain = get_type_hints(kind)
        only = {inspect.Parameter.POSITIONAL_OR_KEYWORD: inspect.Parameter.POSITIONAL_ONLY}
        parameters = [
            each.replace(annotation=plain[name], kind=only.get(each.kind, each.kind))
            for name, each in inspect.signature(kind).parameters.items()
        ]
        # Its own fields before inherited ones.
        parameters.sort(key=lambda each: (each.kind, each.name not in kind.__annotations__))
        arguments = (inspect.getdoc(kind) or "").partition("\n\n")[2]
        returned = get_type_hints(verb)["return"]
        vars(call)["__signature__"] = inspect.Signature(parameters, return_annotation=returned)
        call.__doc__ = f"{inspect.getdoc(verb)}\n\n{arguments}\n"
        # The command line takes conversion and help from these.
        call.__annotations__ = get_type_hints(kind, include_extras=True)
        return call

    return with_options


def prints(printer: Callable[..., int]) -> Callable[[Verb], Verb]:
    """Name the function that prints what a verb returns, on the command line, and gives the exit code.

    It is called with the result and, by name, with the arguments of the verb.
    """

    def with_printer(verb: Verb) -> Verb:
        setattr(verb, PRINTER, printer)
        return verb

    return with_printer


def given_options(options: Any) -> dict[str, Any]:
    """The options of a dataclass that differ from their defaults, by their names on the command line."""
    own, given = type(options).__annotations__, dict[str, Any]()
    for each in sorted(fields(options), key=lambda each: each.name not in own):
        value = getattr(options, each.name)
        if each.kw_only and each.name != "quiet" and value != each.default:
            given["--" + each.name.replace("_", "-")] = value
    return given


def words_of(options: Mapping[str, object]) -> list[str]:
    """Options as words of a command line; None and False are omitted."""
    words: list[str] = []
    for name, value in options.items():
        if value is True:
            words.append(name)
        elif value is not None and value is not False:
            words += [name, str(value)]
    return words


def absolute_source(ref: str) -> str:
    """A source reference with its file or folder made absolute."""
    kind, _, text = ref.partition(":")
    # Text that is not an existing path is a parameter of the source, as in builtin:400.
    is_path = bool(text) and kind != "builtin" and Path(text).expanduser().exists()
    return refuse_not_utf8(f"{kind}:{Path(text).expanduser().resolve()}" if is_path else ref)


def absolute_robot(robot: str | Path) -> str:
    """A robot's name, or the path of its file made absolute."""
    return absolute_path(robot) if str(robot).endswith(".toml") else str(robot)


def absolute_path(path: str | Path) -> str:
    """A run's absolute path or its address, valid in every folder."""
    path = str(path)
    if "://" in path and not path.startswith("file://"):
        return path
    return str(Path(path.removeprefix("file://")).expanduser().absolute())


class Interrupted(KeyboardInterrupt):
    """The command stopped cleanly on request; `result` is what it would have returned."""

    def __init__(self, message: str, result: Any) -> None:
        self.result = result
        super().__init__(message)


def command_line(words: Sequence[str]) -> str:
    """The quoted command line."""
    return shlex.join(["datagen", *words])


def resume_with(words: Sequence[str]) -> str:
    """The sentence that names the command that resumes."""
    return f"Resume with:\n  {command_line(words)}"


def print_interrupted(how: str, words: Sequence[str]) -> None:
    """Print that the command was interrupted, and the command that resumes it."""
    sys.stderr.write(f"interrupted{how}. {resume_with(words)}\n")


@contextmanager
def resumable(words: Sequence[str]) -> Generator[None]:
    """Print how to resume where the block is interrupted."""
    try:
        yield
    except KeyboardInterrupt:
        print_interrupted("; committed shards are kept", words)
        raise


@contextmanager
def interruptible() -> Generator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C or SIGTERM came. A second Ctrl-C ends the block."""
    came = False

    def note(_number: int, _frame: FrameType | None) -> None:
        nonlocal came
        came = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    numbers = (signal.SIGINT, signal.SIGTERM) if current_thread() is main_thread() else ()
    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield lambda: came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


_began_s: float | None = None


def begin_with_process() -> None:
    """Let the command of this process begin with it, so that its time includes imports."""
    import psutil

    global _began_s
    _began_s = time.monotonic() - max(0.0, time.time() - psutil.Process().create_time())


def beginning_s() -> float:
    """Monotonic time at which a command began: its process on the command line, else now."""
    return time.monotonic() if _began_s is None else _began_s
