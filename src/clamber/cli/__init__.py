"""The command line: `main` parses the flags of a command and runs it.

Exit codes: 0 success (or the command did its work), 1 failure, 2 bad
input, 130 interrupted, 141 nobody reads the output any more.
"""

from __future__ import annotations

import difflib
import os
import sys
from collections.abc import Sequence
from typing import Any

import tyro

import clamber
from clamber.cli.commands import COMMANDS
from clamber.cli.flags import REGISTRY
from clamber.cli.output import BAD_INPUT, INTERRUPTED, REACHED, READER_GONE
from clamber.errors import ClamberError, InputError

DESCRIPTION = (
    "Turns a recording of a person climbing over an obstacle into a motion that a "
    "humanoid robot executes in physics. Try: clamber climb --video"
)


def parse(args: Sequence[str]) -> Any:
    """The command that flags ask for.

    Raises:
        InputError: There is no such command.
        SystemExit: With 2, what is wrong written on stderr; with 0 after help.
    """
    name = args[0] if args and not args[0].startswith("-") else None
    config: dict[str, Any] = {
        "config": (tyro.conf.FlagCreatePairsOff,),
        "registry": REGISTRY,
    }
    if name in COMMANDS:  # alone, so that mistakes are told of this command
        of = f"clamber {name}"
        return tyro.cli(COMMANDS[name], prog=of, args=list(args[1:]), **config)
    if name is not None:
        near = difflib.get_close_matches(name, COMMANDS, n=1, cutoff=0.7)
        known = f"did you mean {near[0]}?" if near else ", ".join(COMMANDS)
        raise InputError(f"there is no command {name!r}: {known}")
    return tyro.extras.subcommand_cli_from_dict(
        COMMANDS, prog="clamber", description=DESCRIPTION, args=list(args), **config
    )


def main(args: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    argv = list(sys.argv[1:] if args is None else args)
    if "--version" in argv:
        sys.stdout.write(f"clamber {clamber.__version__}\n")
        return REACHED
    lead = [a for a in argv[:2] if a in ("--json", "--quiet")]
    if argv[: len(lead)] == lead:  # also before the command
        argv = argv[len(lead) :] + lead
    try:
        return parse(argv).run()
    except SystemExit as e:  # help, or flags that are wrong
        return e.code if isinstance(e.code, int) else REACHED
    except ClamberError as e:
        error = _by_flag(e) if isinstance(e, InputError) else e
        sys.stderr.write(f"clamber: {error}\n")
        return BAD_INPUT
    except KeyboardInterrupt as e:
        said = str(e) or "interrupted; every file that was written is whole"
        sys.stderr.write(f"clamber: {said}\n")
        return INTERRUPTED
    except BrokenPipeError:  # `clamber ... | head` has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return READER_GONE


def _by_flag(error: InputError) -> InputError:
    """A value that came from no file, under its name on the command line."""
    from clamber.study.climb import FLAGS

    if error.source is not None or error.field not in FLAGS:
        return error
    return InputError(error.expected, source=f"--{error.field}", value=error.value)
