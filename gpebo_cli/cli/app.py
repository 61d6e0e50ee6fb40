"""Entry point: dispatch on the first word, errors as one line, exit codes.

Dispatch is by hand because Hydra owns the rest of the command line and declines to share it with
argparse or click; and because ``gpebo --help`` should cost no more than starting Python. So this
module imports nothing but ``signal`` that the interpreter has not loaded already.
"""

from __future__ import annotations

import os
import signal
import sys

from gpebo_cli.errors import ConfigError, GpeboError

TYPE_CHECKING = False  # typing's, which nobody has loaded yet
if TYPE_CHECKING:
    from typing import NoReturn

COMMANDS = (
    "run", "check", "compare", "report", "figures", "reproduce", "list", "new", "completion",
)
"""Commands, which are ``main`` of the modules of ``gpebo_cli.cli`` with these names."""


def entry() -> None:
    """The process ``gpebo``: :func:`main`, and a Ctrl-C that comes when all is done is too late."""
    # Before main() is inside its own handler nothing is there that would have to be cleaned up.
    signal.signal(signal.SIGINT, lambda *_: _interrupted())
    if not sys.warnoptions:  # of libraries, for whoever writes programs; -W shows them
        import warnings

        warnings.simplefilter("ignore")
        os.environ["PYTHONWARNINGS"] = "ignore"  # of workers, too
    os.environ["MPLBACKEND"] = "agg"  # figures are files; a notebook's need not be installed here
    try:
        code = main()
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    except KeyboardInterrupt:
        code = _interrupted()
    workers = sys.modules.get("gpebo_cli.cli.workers")  # of a sweep
    if workers is not None and workers.stranded():
        _leave(code)
    sys.exit(code)


def main() -> int:
    """Run the command line in ``sys.argv``; the exit code: 0, 1, 2 or 130."""
    traceback_wanted = os.environ.get("HYDRA_FULL_ERROR") == "1"  # before a command sets it
    _open_streams()
    try:
        from gpebo_cli.cli import interrupts

        with interrupts.Remembered():
            code = _dispatch(sys.argv[1:])
            sys.stdout.flush()
    except BrokenPipeError:  # the reader, `head` for instance, has seen enough
        _drop_stdout()
        return 0
    except KeyboardInterrupt:
        return _interrupted()
    except Exception as error:  # noqa: BLE001  whatever it is, its user sees one line
        return _failed(error, traceback_wanted=traceback_wanted)
    return code


def _open_streams() -> None:
    """Streams that whoever started this has closed lead nowhere, as cron's may."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            os.dup2(os.open(os.devnull, os.O_RDWR), number)  # no file is to get its number,
            os.set_inheritable(number, True)  # nor one of a process that is started here
            mode = "w" if number else "r"
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115
    sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]


def _failed(error: Exception, *, traceback_wanted: bool) -> int:
    """Report an error as its user should see it; the exit code."""
    if _was_interrupted(error):
        return _interrupted()
    if traceback_wanted:
        import traceback

        traceback.print_exc()
    if isinstance(error, GpeboError):
        return _report(str(error), error.exit_code)
    if isinstance(error, MemoryError):
        return _report(f"there is not enough memory for this: {error}", 1)
    if isinstance(error, OSError):
        _drop_stdout()  # a full disk behind it would be reported again when Python exits
        where = f"{error.filename}: " if error.filename is not None else ""
        if isinstance(error, FileNotFoundError) and not where:  # os.getcwd's has no name
            where = "the current folder: "
        return _report(f"{where}{error.strerror or error}", 1)
    what = f"internal error: {type(error).__name__}: {error}"
    return _report(f"{what} (set HYDRA_FULL_ERROR=1 for the traceback)", 1)


def _was_interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C is behind an error; libraries wrap it into errors of their own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _dispatch(words: list[str]) -> int:
    command, rest = (words[0], words[1:]) if words else ("--help", [])
    if command in ("--version", "-V", "version") or (command == "run" and "--version" in rest):
        from gpebo_cli._version import __version__

        sys.stdout.write(f"gpebo {__version__}\n")
        return 0
    of_all = command in ("--help", "-h", "help")
    if of_all or (command in COMMANDS and not {"--help", "-h"}.isdisjoint(rest)):
        from gpebo_cli.cli.usage import help_of

        sys.stdout.write(help_of("gpebo" if of_all else command))
        return 0
    if command in COMMANDS:
        from importlib import import_module

        module = "listing" if command == "list" else command  # list is a type of Python's
        return int(import_module(f"gpebo_cli.cli.{module}").main(rest))
    if command == "__complete":  # asked by the scripts that `gpebo completion` prints
        from gpebo_cli.cli import completion

        return completion.answer(rest)
    raise ConfigError(_unknown(command))


def _unknown(command: str) -> str:
    from gpebo_cli.schema import nearest, shown

    text = f"unknown command {shown(command)}; known: {', '.join(COMMANDS)}"
    if "=" in command:
        return f"{text}; did you mean `gpebo run {command}`?"
    return text + (nearest(command, COMMANDS) or "; see gpebo --help")


def _report(message: str, code: int) -> int:
    line = " ".join(message.split())  # one line, whatever a library put into it
    sys.stderr.write(f"gpebo: error: {line}\n")
    return code


def _interrupted() -> int:
    """Say so, and end the process now.

    If SIGINT arrived inside an ``exec``, as dataclasses use it, CPython remembers that and ends the
    process by the signal whatever is returned here.
    """
    import atexit

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # once is enough
    _report("interrupted", 130)
    atexit._run_exitfuncs()  # noqa: SLF001  there is no public way to run them early
    _leave(130)


def _leave(code: int) -> NoReturn:
    """End the process now, whatever else there is in it."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:  # nobody reads any more
            continue
    os._exit(code)


def _drop_stdout() -> None:
    """Send what is still buffered nowhere, so that the interpreter's exit does not try again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
