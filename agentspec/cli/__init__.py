"""The command line: `agentspec run | eval | train | report | compare | export | audit | list | view`.

Thin: every command parses its arguments, calls the library and prints. Input that cannot work is one line on stderr
that names the remedy, and exit code 2; an episode that failed while running is exit code 1; anything unexpected keeps
its traceback.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from agentspec.cli.errors import expected_errors, fail

__all__ = ["expected_errors", "fail", "main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: arguments without the program's name; default: those of the process.

    Returns:
        The exit code. Errors of the input end the process with code 2 instead (`SystemExit`).
    """
    from agentspec.cli.ours import claim_packages
    from agentspec.cli.parser import build_parser
    from agentspec.registry import import_modules

    arguments = build_parser().parse_args(argv)
    with expected_errors():
        claim_packages()
        try:
            import_modules(arguments.imports)
            code: int = arguments.command(arguments)
            sys.stdout.flush()
            return code
        except BrokenPipeError:  # the reader (head, less) has seen enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is still buffered goes nowhere
            return 0
        except KeyboardInterrupt:
            again = "; the same command goes on where it stopped" if hasattr(arguments, "out_resumes") else ""
            sys.stderr.write(f"agentspec: stopped{again}\n")
            return 130
