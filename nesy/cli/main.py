"""`nesy`: finds the command, parses its options, runs it, and turns what went wrong into one clear line.

Exit status: 0 done, 1 a bug of ours, 2 a mistake of the caller's, 130 interrupted. Modules are imported only
when their command is called, so `nesy --help` answers at once.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import io
import json
import os
import re
import signal
import sys
from collections.abc import Sequence
from types import FrameType
from typing import Any

COMMANDS = {
    "run": "the main job: collect, train, extract, compare, report",
    "collect": "collect experience on the crossing and the person-following task",
    "train": "train the discrete world model",
    "extract": "extract the symbolic 2DBN, print it, write it in other formats",
    "query": "ask what factors and values mean, and run any ASP program over the model",
    "show": "print or draw the 2DBN: its graph, its tables, what the values of a factor look like",
    "compare": "compare DQN, POMDP planner and references on the same maps",
    "report": "write report.html from the run folder",
    "bench": "measure speeds, each against a named peer in the same run",
    "doctor": "check the installation and a run folder, say what to do",
    "play": "drive the robot in a terminal, watch a policy, record an episode",
}


def _help() -> str:
    lines = [
        "usage: nesy COMMAND [OPTIONS]",
        "",
        "Perspective-shifted neuro-symbolic world models: learn, extract, query, plan, compare.",
        "",
        "commands:",
        *(f"  {name:9} {text}" for name, text in COMMANDS.items()),
        "",
        "nesy COMMAND --help lists the options of a command; nesy --version prints the version.",
    ]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_help())
        return 0 if arguments else 2
    if arguments[0] == "--version":
        from nesy import __version__

        print(f"nesy {__version__}")
        return 0
    name = arguments[0]
    if name not in COMMANDS:
        return _mistake(f"no command '{name}'{_did_you_mean(name)}; the commands are {', '.join(COMMANDS)}")
    return _run(name, arguments[1:])


def _run(name: str, arguments: list[str]) -> int:
    # numba and torch stay single-threaded per process: one process per core is faster here.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from domains.core import DomainError
    from nesy.errors import UserError

    command = importlib.import_module(f"nesy.cli.commands.{name}")
    try:
        options = parse(command, f"nesy {name}", arguments)
    except SystemExit as request:  # --help was asked for and has been printed
        return int(request.code or 0)
    except (UserError, DomainError) as error:
        return _mistake(str(error))
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        result = command.run(options)
        if options.json:
            print(json.dumps(result, allow_nan=False))
        else:
            command.show(result)
        sys.stdout.flush()
    except (UserError, DomainError) as error:
        return _mistake(str(error))
    except BrokenPipeError:
        # The reader of our output went away (`nesy ... | head`); silence the interpreter's own complaint.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        print(f"nesy {name}: interrupted; the same command goes on where it stopped", file=sys.stderr)
        return 130
    except Exception as error:
        reason = _cannot_write(error)
        if reason is None:
            raise
        return _mistake(f"{reason}; make room, and the same command goes on where it stopped")
    finally:
        signal.signal(signal.SIGTERM, before)
    return 0


def parse(command: Any, program: str, arguments: list[str]) -> Any:
    """Parse `arguments` into the command's `Arguments` dataclass.

    Raises:
        UserError: an option is unknown, missing or has a wrong value; one line saying which.
        SystemExit: help was asked for.
    """
    import tyro

    from nesy.errors import UserError

    default = command.defaults(arguments) if hasattr(command, "defaults") else None
    keywords = {} if default is None else {"default": default}
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(command.Arguments, prog=program, args=arguments, description=command.__doc__, **keywords)
    except SystemExit as stop:
        if not stop.code:
            raise
        said = re.sub(r"^Error parsing [\w.]+: ", "", _first_paragraph(complaint.getvalue()))
        said = said.replace("'None', ", "").replace(", 'None'", "")  # nobody types that
        raise UserError(f"{said} (see: {program} --help)") from None


def _first_paragraph(box: str) -> str:
    """What tyro says below the title of its frame, up to the first rule, as one line.

    The frame is of plain characters where standard output is not UTF-8.
    """
    words: list[str] = []
    for line in box.splitlines()[1:]:
        text = line.strip().strip("│").strip()
        if not text or set(text) <= set("─╰╯-"):
            if words:
                break
            continue
        words.append(text)
    return " ".join(words) or "wrong options"


def _did_you_mean(name: str) -> str:
    import difflib

    close = difflib.get_close_matches(name, COMMANDS, n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


def _mistake(message: str) -> int:
    print("nesy: " + " ".join(message.split()), file=sys.stderr)
    return 2


def _cannot_write(error: BaseException) -> str | None:
    """Why a file could not be written, where that is the reason of an error; libraries say it in many ways."""
    full = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}
    causes: list[BaseException] = [error]
    while (cause := causes[-1].__cause__ or causes[-1].__context__) is not None and cause not in causes:
        causes.append(cause)
    for cause in causes:
        number = getattr(cause, "errno", None)
        if isinstance(number, int) and number in full:
            where = getattr(cause, "filename", None)
            return f"{where}: cannot be written ({os.strerror(number)})" if where else os.strerror(number)
        text = str(cause)
        found = next((n for n in full if os.strerror(n) in text or f"os error {n}" in text), None)
        if found is not None:
            return os.strerror(found)
        if isinstance(cause, OSError) and "requested and" in text and "written" in text:  # numpy's way
            return os.strerror(errno.ENOSPC)
    return None


def _interrupt(signum: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
