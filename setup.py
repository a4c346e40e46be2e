"""Build the C extension, and a reproducible sdist. pyproject.toml has all other settings."""

from __future__ import annotations

import gzip
import os
import tarfile
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.sdist import sdist


class ReproducibleSdist(sdist):
    """Give all files the time SOURCE_DATE_EPOCH, no owner, and the same permissions."""

    def make_archive(self, base_name, format, root_dir=None, base_dir=None, **owner):
        """Return the path of the archive of `base_dir`."""
        seconds = os.environ.get("SOURCE_DATE_EPOCH")
        if format != "gztar" or seconds is None:
            return super().make_archive(base_name, format, root_dir, base_dir, **owner)

        def same(member: tarfile.TarInfo) -> tarfile.TarInfo:
            member.mtime = int(seconds)
            member.uid = member.gid = 0
            member.uname = member.gname = ""
            member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            return member

        path = Path(f"{base_name}.tar.gz")
        path.parent.mkdir(parents=True, exist_ok=True)
        # The header of gzip contains a name and a time, too.
        with (
            path.open("wb") as file,
            gzip.GzipFile("", "wb", fileobj=file, mtime=int(seconds)) as packed,
            tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive,
        ):
            # Folders are added with their contents in the order of the names.
            archive.add(base_dir, filter=same)
        return str(path)


NATIVE = Extension(
    "mcaprl.recorder.columns._native",
    ["recorder/columns/_native.c"],
    # Debug information contains the path of the build.
    extra_compile_args=["-O3", "-g0"] if os.name == "posix" else [],
    py_limited_api=True,
    # Without a C compiler, NumPy does the same in more time.
    optional=True,
)

setup(
    ext_modules=[NATIVE],
    cmdclass={"sdist": ReproducibleSdist},
    # The module works with all versions of Python from 3.11 on.
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
