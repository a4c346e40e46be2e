"""Compare two builds of the sdist and the wheel, and check that they contain no stray files."""

from __future__ import annotations

import sys
import tarfile
import zipfile
from pathlib import Path

METADATA = {"METADATA", "RECORD", "WHEEL", "entry_points.txt", "top_level.txt"}
EXTENSION = "mcaprl/recorder/columns/_native.abi3.so"
NEEDED = {"CHANGELOG.md", "CITATION.cff", "LICENSE", "README.md", "SECURITY.md", "pyproject.toml"}


def main(first: Path, second: Path, source: Path) -> None:
    """Exit with a message if the builds differ, or a file is missing or stray."""
    names = sorted(path.name for path in first.iterdir())
    if names != sorted(path.name for path in second.iterdir()):
        sys.exit(f"the builds have different files: {names}")
    for name in names:
        if (first / name).read_bytes() != (second / name).read_bytes():
            sys.exit(f"{name} is not reproducible: two builds differ")
    (wheel,) = first.glob("*.whl")
    expected = {path.relative_to(source).as_posix() for path in modules(source)} | {EXTENSION}
    if stray := files_of_wheel(wheel) ^ expected:
        sys.exit(f"{wheel.name} and the packages differ in: {', '.join(sorted(stray))}")
    (sdist,) = first.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        found = {name.partition("/")[2] for name in archive.getnames()}
    if missing := NEEDED - found:
        sys.exit(f"{sdist.name} lacks {', '.join(sorted(missing))}")
    if strange := sorted(name for name in found if name.startswith(("tests", "docs", ".ci"))):
        sys.exit(f"{sdist.name} has {', '.join(strange)}")
    print(f"two builds are the same: {', '.join(names)}")


def modules(source: Path) -> list[Path]:
    """Return the files that belong in the wheel, with their names in the wheel."""
    folder = source / "mcaprl"
    # `mcaprl` contains symbolic links to the folders of the other packages.
    roots = [folder, *(path for path in folder.iterdir() if path.is_symlink())]
    return sorted(
        path
        for root in roots
        for path in root.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and not is_source(path)
    )


def is_source(path: Path) -> bool:
    """Return whether a file is only an input of a build: C code, or libraries of the page."""
    names = ("libraries.min.css", "libraries.min.js", "LICENSES.txt")
    return path.suffix == ".c" or ("vendor" in path.parts and path.name not in names)


def files_of_wheel(wheel: Path) -> set[str]:
    """Return the names of the files in a wheel, without its metadata."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    inside = {name for name in names if ".dist-info/" in name}
    if strange := {Path(name).name for name in inside} - METADATA - {"LICENSE", "LICENSES.txt"}:
        sys.exit(f"{wheel.name} has unknown metadata: {', '.join(sorted(strange))}")
    return set(names) - inside


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:4]))
