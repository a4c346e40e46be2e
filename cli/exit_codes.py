"""Exit codes of the program; docs/cli.md lists them."""

from __future__ import annotations

from typing import Final

from mcaprl._interrupt import INTERRUPTED
from mcaprl.errors import McaprlError, UsageError

WITH_LOSSES: Final = 3
"""Exit code of `recover` if data is lost."""

EXIT_CODES: Final[dict[int, str]] = {
    0: "Success.",
    McaprlError.exit_code: (
        "A log, policy, run or other file cannot be read, written or used. Also: `check`,"
        " `info --strict` or `replay --verify` found a problem, and `recover` can keep nothing."
    ),
    UsageError.exit_code: (
        "The request is invalid: an unknown command, option, name or policy, a value out of range,"
        " options that exclude each other, an output that exists, or a package that is not"
        " installed."
    ),
    WITH_LOSSES: "`recover` wrote a log, but some data is lost.",
    INTERRUPTED: (
        "The command was interrupted by Ctrl-C, SIGTERM or SIGHUP. The last line says what is kept."
    ),
}
"""Meaning of each exit code."""
