"""ROS 2 primitive types and the CDR encapsulation header."""

from __future__ import annotations

# The CDR encapsulation header "little endian, plain CDR": bytes 00 01 00 00.
ENCAPSULATION = 0x0100
ENCAPSULATION_BYTES = 4

ROS_TO_NUMPY = {
    "float64": "<f8",
    "int64": "<i8",
    "uint64": "<u8",
    "float32": "<f4",
    "int32": "<i4",
    "uint32": "<u4",
    "int16": "<i2",
    "uint16": "<u2",
    "int8": "i1",
    "uint8": "u1",
    "byte": "u1",
    "char": "u1",
    "bool": "u1",
}
"""NumPy type code of each ROS primitive type."""
