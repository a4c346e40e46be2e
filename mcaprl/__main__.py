"""The command-line program, as `python -m mcaprl`."""

from mcaprl.cli import main

if __name__ == "__main__":
    main()
