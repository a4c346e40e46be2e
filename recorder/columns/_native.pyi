from typing import Any

from numpy.typing import NDArray

def copy_fields(
    records: memoryview,
    index: NDArray[Any],
    size: int,
    expected: list[tuple[int, bytes]],
    targets: list[tuple[int, NDArray[Any]]],
    row: int,
) -> bool: ...
