"""Coverage-guided fuzzing of the reader: `make fuzz`.

    python -m tests.support.damage.fuzz_reader FOLDER [options of libFuzzer]

Fuzzing starts from small logs in FOLDER. Some have no CRCs, so that the code after the CRC checks
is reached. Inputs that fail are written to `crash-...`. Fix the cause, and add the inputs to
`tests/fuzz_corpus`, which `tests/recorder/columns/test_fuzz_corpus.py` reads.
"""

from __future__ import annotations

import sys
from pathlib import Path


def main() -> None:
    """Run the fuzzer until it is stopped."""
    import atheris

    with atheris.instrument_imports(include=["mcaprl"]):
        from tests.support.damage.fuzz_target import try_bytes, write_seeds
    write_seeds(Path(sys.argv[1]))
    atheris.Setup(sys.argv, try_bytes)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
