"""Settings of algorithms and networks: frozen dataclasses that validate themselves.

The string below a field describes the field. It is also the help of the command-line option.

Two encoders of images are available, which `ENCODERS` describes. `nature` has the convolutions of
"Human-level control through deep reinforcement learning" (https://doi.org/10.1038/nature14236).
`compact` first averages squares of pixels, so that the image's shorter edge has about 42 pixels; it
has two small convolutions. A gradient step with `compact` takes a fraction of the time of a step
with `nature`. Images that are too small for both have the convolutions of `SMALL`.
"""

from __future__ import annotations

import ast
import functools
import inspect
import numbers
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from typing import Any, Final, get_type_hints

from mcaprl.errors import UsageError

_MAX_FRAME_STACK = 1_000
_KINDS: dict[object, str] = {
    bool: "true or false",
    int: "an integer",
    str: "a text",
    tuple[int, ...]: "a list of integers",
}
"""What the values of a field must be, by its type."""


@dataclass(frozen=True)
class Settings:
    """Settings of all algorithms, offline and online; subclasses choose their own defaults.

    Raises:
        UsageError: A setting is outside its range.
    """

    learning_rate: float = 1e-3
    """initial learning rate of Adam"""
    final_learning_rate_fraction: float = 1.0
    """final learning rate as a fraction of the initial one; the decay is linear"""
    hidden: tuple[int, ...] = (256, 256)
    """widths of the hidden layers; for images, of the layers after the convolutions"""
    frame_stack: int = 1
    """number of successive observations that the network receives"""
    checkpoint_interval: int = 1_000
    """number of updates (offline) or environment steps (online) between checkpoints"""

    def __post_init__(self) -> None:
        """Validate the types and ranges of the settings."""
        for name, kind in get_type_hints(type(self)).items():
            self._require(name, _is_of(getattr(self, name), kind), _KINDS.get(kind, "a number"))
        self._require_positive("frame_stack", "checkpoint_interval")
        allowed = f"at most {_MAX_FRAME_STACK}"
        self._require("frame_stack", self.frame_stack <= _MAX_FRAME_STACK, allowed)
        self._require("learning_rate", self.learning_rate > 0, "above 0")
        self._require_fraction("final_learning_rate_fraction")
        self._require("hidden", all(width >= 1 for width in self.hidden), "widths of at least 1")

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON types; `settings_from_json` is the inverse."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    def _require(self, name: str, holds: bool, allowed: str) -> None:
        if not holds:
            raise UsageError(f"{name} must be {allowed}, got {getattr(self, name)}")

    def _require_positive(self, *names: str) -> None:
        for name in names:
            self._require(name, getattr(self, name) >= 1, "at least 1")

    def _require_fraction(self, *names: str) -> None:
        for name in names:
            self._require(name, 0 <= getattr(self, name) <= 1, "within [0, 1]")


def _is_of(value: object, kind: object) -> bool:
    """Return whether a value has the type of a field; fields of other types are not checked."""
    if kind == tuple[int, ...]:
        return isinstance(value, tuple | list) and all(_is_of(each, int) for each in value)
    if kind not in (int, float):
        return not isinstance(kind, type) or isinstance(value, kind)
    number = numbers.Integral if kind is int else numbers.Real
    # Larger integers cannot be converted to a float.
    is_large = isinstance(value, int) and abs(value) > sys.float_info.max
    return isinstance(value, number) and not isinstance(value, bool) and not is_large


def check_settings(algo: str, config: Settings | type[Settings], given: Iterable[str]) -> None:
    """Check that an algorithm has the given settings.

    Args:
        algo: Name of the algorithm.
        config: Settings of the algorithm, or their type.
        given: Names of the settings that the user chose.

    Raises:
        UsageError: The algorithm has no such setting.
    """
    known = [field.name for field in fields(config)]
    for name in given:
        if name not in known:
            options = ", ".join(f"`{each}=`" for each in known)
            raise UsageError(f"{algo} has no setting `{name}=`; it has {options}")


def settings_from_json(found: object) -> dict[str, Any]:
    """Return the settings in a `config.json`, with lists converted to tuples."""
    settings = found if isinstance(found, dict) else {}
    return {k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()}


def flag(name: str) -> str:
    """Return the command line option of a setting.

    >>> flag("batch_size")
    '--batch-size'
    """
    return f"--{name.replace('_', '-')}"


def field_help(config_type: type) -> dict[str, str]:
    """Return the help texts of a dataclass by the names of the fields, inherited fields first."""
    assert is_dataclass(config_type)
    lines: dict[str, str] = {}
    for base in reversed(config_type.__mro__):
        if is_dataclass(base):
            lines |= _lines_under_fields(base)
    return {field.name: lines[field.name] for field in fields(config_type) if field.name in lines}


def _lines_under_fields(config_type: type) -> dict[str, str]:
    tree = _classes_of(config_type.__module__)[config_type.__qualname__]
    lines = {}
    for field, below in zip(tree.body, tree.body[1:], strict=False):
        match field, below:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(text))),
            ):
                lines[name] = inspect.cleandoc(text)
    return lines


@functools.cache
def _classes_of(module: str) -> dict[str, ast.ClassDef]:
    """Return the parsed classes of a module by qualified name.

    Python does not store the docstrings of fields, so the source is parsed.
    """
    found: dict[str, ast.ClassDef] = {}
    parts: list[tuple[str, ast.AST]] = [("", ast.parse(inspect.getsource(sys.modules[module])))]
    while parts:
        prefix, node = parts.pop()
        for child in ast.iter_child_nodes(node):
            name = prefix
            if isinstance(child, ast.ClassDef):
                name = f"{prefix}{child.name}."
                found[name.removesuffix(".")] = child
            elif isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                name = f"{prefix}{child.name}.<locals>."
            parts.append((name, child))
    return found


AUTO = "auto"
"""Setting of the encoder that selects `compact` for images with one channel, else `nature`."""


@dataclass(frozen=True)
class Encoder:
    """Convolutions of an encoder.

    Attributes:
        channels: Default output channels of the convolutions.
        kernels: Kernel size and stride of each convolution, in pixels.
        edge: Approximate length in pixels of an image's shorter edge after average pooling by an
            integer factor; None for no pooling.
    """

    channels: tuple[int, ...]
    kernels: tuple[tuple[int, int], ...]
    edge: int | None = None

    def pool(self, image_shape: Sequence[int]) -> int:
        """Return the average-pooling factor for images (height, width, ...). 1 means no pooling."""
        return 1 if self.edge is None else max(1, round(min(image_shape[:2]) / self.edge))

    def pixels(self, image_shape: Sequence[int]) -> int:
        """Return the number of pixels after the last convolution; 0 if the image is too small."""
        pool, count = self.pool(image_shape), 1
        for edge in image_shape[:2]:
            left = edge // pool
            for kernel, stride in self.kernels:
                left = (left - kernel) // stride + 1 if left >= kernel else 0
            count *= left
        return count


ENCODERS: Final[dict[str, Encoder]] = {
    "nature": Encoder((32, 64, 64), ((8, 4), (4, 2), (3, 1))),
    "compact": Encoder((16, 32), ((4, 4), (3, 2)), edge=42),
}
SMALL: Final = Encoder((16, 32), ((3, 1), (3, 2)))
"""Encoder of images with an edge of fewer than `SMALL_EDGE` pixels, such as grids of cells."""
SMALL_EDGE: Final = 36
"""Smallest edge in pixels for which the output of all convolutions in `ENCODERS` is not empty."""


def choose_encoder(name: str, widths: Sequence[int], channels: Iterable[int]) -> str:
    """Return the encoder that a setting selects."""
    if name != AUTO:
        return name
    if widths:
        counts = {len(encoder.kernels): key for key, encoder in ENCODERS.items()}
        return counts[len(widths)]
    return "compact" if all(count == 1 for count in channels) else "nature"


@dataclass(frozen=True)
class Architecture:
    """Architecture of a network.

    Attributes:
        hidden: Widths of the fully connected hidden layers; each input has its own first layer.
        channels: Output channels of the convolutions over each image; empty selects those of the
            encoder.
        layer_norm: Whether the hidden layers are normalized before each ReLU
            (https://arxiv.org/abs/1607.06450).
        dueling: Whether outputs are the sum of a value and of advantages with mean 0, computed by
            separate last hidden layers (https://arxiv.org/abs/1511.06581).
        encoder: Key of `ENCODERS`, for images that are not small.
    """

    hidden: tuple[int, ...]
    channels: tuple[int, ...] = ()
    layer_norm: bool = False
    dueling: bool = False
    encoder: str = "nature"

    def encoder_of(self, image_shape: Sequence[int]) -> Encoder:
        """Return the encoder for an image (height, width, ...), with its output channels."""
        is_small = min(image_shape[:2]) < SMALL_EDGE
        encoder = SMALL if is_small else ENCODERS[self.encoder]
        channels = self.channels[: len(encoder.kernels)] or encoder.channels
        return replace(encoder, channels=channels)

    def features(self, image_shape: Sequence[int]) -> int:
        """Return the number of features of the convolutions for an image (height, width, ...)."""
        encoder = self.encoder_of(image_shape)
        return encoder.pixels(image_shape) * encoder.channels[-1]


def architecture_of(found: Mapping[str, Any]) -> Architecture:
    """Return the architecture that a file describes."""
    lists = {key: tuple(value) for key, value in found.items() if isinstance(value, list)}
    return Architecture(**{**found, **lists})


@dataclass(frozen=True)
class NetworkSettings(Settings):
    """Settings of all algorithms with networks; each algorithm adds its own in a subclass.

    Raises:
        UsageError: A setting is outside its range.
    """

    encoder: str = AUTO
    """convolutions over images: nature, compact, or auto (compact for images with one channel)"""
    channels: tuple[int, ...] = ()
    """output channels of the convolutions; by default, nature has 32,64,64 and compact 16,32"""
    center_images: bool = True
    """subtract the mean image, and divide by the standard deviation of all pixels"""
    layer_norm: bool = False
    """normalize the hidden layers"""

    def __post_init__(self) -> None:
        """Validate the settings."""
        super().__post_init__()
        known = (AUTO, *ENCODERS)
        self._require("encoder", self.encoder in known, f"one of {', '.join(known)}")
        encoders = ENCODERS.values() if self.encoder == AUTO else [ENCODERS[self.encoder]]
        counts = {len(encoder.kernels) for encoder in encoders}
        fits = len(self.channels) in counts and all(count >= 1 for count in self.channels)
        allowed = f"{' or '.join(map(str, sorted(counts)))} numbers of at least 1"
        self._require("channels", fits or not self.channels, allowed)

    def architecture_for(self, channels: Iterable[int]) -> Architecture:
        """Return the architecture of the networks."""
        encoder = choose_encoder(self.encoder, self.channels, channels)
        return Architecture(self.hidden, self.channels, self.layer_norm, encoder=encoder)
