"""A coverage-guided search for bytes that the reader cannot bear: `make fuzz`.

    python -m tests.support.fuzz_reader FOLDER [options of libFuzzer]

It begins with small logs in FOLDER, also with such as claim no CRC, so that what is behind the CRCs
is reached. Bytes that break something are written to `crash-...`; mend the cause, and keep them in
`tests/fuzz_corpus`, which `tests/recorder/columns/test_fuzz_corpus.py` tries ever after.
"""

from __future__ import annotations

import sys
from pathlib import Path


def main() -> None:
    """Search until stopped."""
    import atheris

    with atheris.instrument_imports(include=["mcaprl"]):
        from tests.support.fuzz_target import try_bytes, write_seeds
    write_seeds(Path(sys.argv[1]))
    atheris.Setup(sys.argv, try_bytes)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
