"""Limits on what a foreign file or server can make a program read, allocate or compute.

Each limit is far above what real files need. A file that exceeds a limit is refused with an error
that names it.
"""

from __future__ import annotations

from typing import Final

MAX_IMAGE_PIXELS: Final = 64_000_000
"""Pixels of one image: more than any camera of a robot has; a few kB of PNG can declare 10^9."""
MAX_TYPE_FIELDS: Final = 10_000
"""Leaf fields of a message type with all nested types: nested types can multiply them."""
MAX_TYPE_DEPTH: Final = 64  # Levels of nested messages in a type: types are read by recursion
MAX_FIXED_MESSAGES: Final = 1_000
"""Messages and strings in all fixed arrays of a type: compiling the code for each takes 1 ms."""
MAX_MESSAGES_PER_BYTE: Final = 16
"""Nested messages for each byte of a message, beyond 64: empty messages take memory, but no bytes
of the file."""
MAX_LABEL_BYTES: Final = 2**16
"""Size of a request of the page that saves a label: a note has at most 10,000 characters."""
MAX_TIME_NS: Final = 2**62
"""Time of a message in nanoseconds, until the year 2116: differences of times fit into 64 bits."""
MAX_DEFINITION_BYTES: Final = 2**20
"""Size of the definition of a message type as text: parsing takes seconds per MiB."""
MAX_DEFINITION_FILES: Final = 100_000
"""Files and folders that are searched for definitions of message types."""
MAX_METADATA_BYTES: Final = 2**21
"""Size of a YAML file, such as a bag's `metadata.yaml`: parsing takes seconds per 100 kB."""
MAX_DOCUMENT_VALUES: Final = 100_000
"""Values in a YAML file, with all aliases: a few hundred bytes can declare any number."""
MAX_METADATA_DEPTH: Final = 20  # Levels of nested values in a bag's `metadata.yaml`
MAX_CHUNK_BYTES: Final = 2**28
"""Decompressed size of a chunk or message: 32 KB of zstd data can become 1 GiB in memory."""
MAX_UNPACKED_BYTES: Final = 2**30
"""Decompressed size of a file that is decompressed to disk, whatever its compressed size."""
MAX_UNPACKED_RATIO: Final = 200
"""Decompressed bytes for each compressed byte of a larger file; real data compresses less."""
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
MAX_REMOTE_BYTES: Final = 2**42
"""Size of a remote file; a server may declare any size, and marks of its blocks take memory."""
MAX_LISTING_BYTES: Final = 64 << 20
"""Bytes of an HTTP answer to a request without a range, such as the page of a folder."""
MAX_FETCHED_BYTES: Final = 64 << 20
"""Bytes that are requested from a server at the same time, because they are held in memory."""
MAX_REQUESTS: Final = 32
"""Requests that run at the same time, so that each gets a share of a slow connection."""
CONNECT_TIMEOUT_S: Final = 10.0
"""Time for a connection to an HTTP server, which takes milliseconds to a few seconds."""
SILENCE_TIMEOUT_S: Final = 12.0
"""Time without a byte from an HTTP server, because a silent server would be awaited for ever."""
SLOW_AFTER_S: Final = 12.0
"""Time after which the rate of an answer is checked, because the first bytes may take long."""
MIN_BYTES_PER_S: Final = 500.0
"""Mean rate of an HTTP answer, because a dripping server would be awaited for ever."""
MAX_OPEN_LOGS: Final = 1000
"""Logs that a stream keeps open, because each takes memory and one of the system's 65,530 maps."""
CLIENT_TIMEOUT_S: Final = 10.0
"""Time that a viewer may take for its request or for the next part of an answer."""
STEP_LIMIT: Final = "step_limit"
"""Reason of an episode's end: the caller's limit on its steps, not the environment, ended it."""
