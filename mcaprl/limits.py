"""Limits of what a file may make this package do, one constant each."""

from __future__ import annotations

from typing import Final

MAX_UNPACKED_RATIO: Final = 200
"""Unpacked bytes for each stored byte of a dataset's file; real data compresses less than this."""
UNPACKED_ALLOWANCE_BYTES: Final = 256 << 20
"""Bytes that a dataset's file may always unpack to, because small files compress better."""
ARRAY_COST_BYTES: Final = 256
"""Bytes that each array counts in addition, because many empty arrays also take memory."""
MAX_NPY_HEADER_BYTES: Final = 10_000
"""Length of the header of an array in an .npz file, which is parsed as a Python literal."""
MAX_NESTED_GROUPS: Final = 32
"""Depth of the groups in an HDF5 file, because a group may contain itself."""
MAX_MEMBERS_SHOWN: Final = 20
"""Names of unread arrays in one warning, because a file may have any number of arrays."""
MAX_READ_RATIO: Final = 50
"""Bytes read of an HDF5 file for each of its bytes, because damaged structures can be circular."""
