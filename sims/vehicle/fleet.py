"""Base class of fleets, which single and batched environments use to step N vehicles."""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numba.core import cgutils, types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

from mcaprl.compiled import compiled, ready
from mcaprl.sims.vehicle.controls import Controls

GOING_ON = 0  # Value of `Fleet.ends` while an episode runs
CAR_INFO = ("lateral_offset_m", "heading_error_rad", "speed_m_s", "progress_m")
"""Keys of the `info` of cars."""


class Fleet(ABC):
    """N independent vehicles, each with its own episodes.

    Attributes:
        count: Number of vehicles N.
        observation_space: Observation space of one vehicle.
        observation_names: Names of the observed numbers; empty for images.
        controls: Parts of a command, and the actions.
        step_duration_s: Simulated time of one step.
        commands: (N, P) valid commands of the next step.
        rewards: (N,) rewards of the last step; 0 after a start.
        ends: (N,) indices in `reasons`; `GOING_ON` while the episode runs.
        noise: (N, K) standard normal numbers that the environment draws for the next step. If steps
            are deterministic, K is 0.
    """

    reasons: ClassVar[tuple[str, ...]]
    """Reasons why an episode ends, indexed by `ends`."""
    truncates: ClassVar[tuple[bool, ...]]
    """Whether each reason truncates the episode instead of terminating it."""
    _seen: NDArray[np.float32]
    """(N, numbers) last observations, for fleets that observe numbers."""

    def __init__(
        self,
        count: int,
        observation_space: spaces.Space[Any],
        observation_names: tuple[str, ...],
        controls: Controls,
        step_duration_s: float,
        noise_size: int = 0,
    ) -> None:
        """Allocate the arrays that all fleets have."""
        self.count = count
        self.observation_space = observation_space
        self.observation_names = observation_names
        self.controls = controls
        self.step_duration_s = step_duration_s
        self.commands = np.zeros((count, len(controls.names)))
        self.rewards = np.zeros(count)
        self.ends = np.zeros(count, dtype=np.int64)
        self.noise = np.zeros((count, noise_size))

    @abstractmethod
    def begin(self, i: int, random: np.random.Generator, options: dict[str, Any] | None) -> None:
        """Start an episode of vehicle i, with the options of `reset`.

        Raises:
            UsageError: `options` has an unknown key or an invalid pose.
        """

    def begin_all(self, chosen: NDArray[np.int64], randoms: Sequence[np.random.Generator]) -> None:
        """Call `begin` for the vehicles with the indices `chosen` (K,).

        `randoms` has one generator for each of the N vehicles.
        """
        for i in chosen.tolist():
            self.begin(i, randoms[i], None)

    def set_actions(self, actions: Any) -> None:
        """Set the actions of the next step.

        Args:
            actions: (N,) integers, or (N, P) parts of continuous actions.

        Raises:
            UsageError: The number of actions is wrong, or an action is not valid. The attribute
                `commands` is then invalid.
        """
        controls = self.controls
        found = controls.array(actions, (self.count,))
        given, read = self._given
        given[:] = found
        wrong = read()
        if wrong >= 0:
            raise controls.error(found, wrong)

    @cached_property
    def _given(self) -> tuple[NDArray[Any], Callable[[], int]]:
        """Array for the actions of a step, and the function that writes their commands."""
        space = self.controls.space
        actions = np.zeros((self.count, *(space.shape or ())), space.dtype)
        return actions, self.controls.reader(actions, self.commands)

    @abstractmethod
    def advance(self) -> None:
        """Advance each vehicle by one step with its command in `commands`."""

    def step_one(self, command: Sequence[float]) -> tuple[Any, float, int, dict[str, Any]]:
        """Advance the only vehicle of a fleet of one, with a valid command.

        Returns:
            Observation, reward, element of `ends`, and `info`.
        """
        self.commands[0] = command
        self.advance()
        return self.observation(0), self.rewards.item(), self.ends.item(), self.info(0)

    def start_one(
        self, random: np.random.Generator, options: dict[str, Any] | None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode of the only vehicle of a fleet of one, like `begin`.

        Returns:
            Observation and `info`.
        """
        self.begin(0, random, options)
        return self.observation(0), self.info(0)

    @abstractmethod
    def _kernel(self) -> tuple[Any, ...]:
        """Return the compiled function, and its arguments, always the same objects."""

    @cached_property
    def _step(self) -> Callable[[], None]:
        """Function that `_kernel` returns, with its arguments bound; compiled on first use."""
        return ready(*self._kernel())

    @cached_property
    def _observe_only(self) -> Callable[[], NDArray[np.float32]]:
        """Bound method that copies the first vehicle's observed numbers."""
        # `flatten` takes half the time of `copy`.
        copy: Callable[[], NDArray[np.float32]] = self._seen[0].flatten
        return copy

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without cached properties, which refer to the arrays of this fleet."""
        kind = type(self)
        return {
            name: value
            for name, value in vars(self).items()
            if not isinstance(getattr(kind, name, None), cached_property)
        }

    def imitate(self, i: int, other: Fleet, j: int) -> None:
        """Copy the state of vehicle j of another fleet of the same class into vehicle i.

        A fleet stores state in arrays with one row for each vehicle, and in dicts that cache values
        by the vehicle's index.
        """
        for name, theirs in vars(other).items():
            mine = getattr(self, name)
            if isinstance(theirs, np.ndarray) and theirs.shape[:1] == (other.count,):
                mine[i] = theirs[j]
            elif isinstance(theirs, dict):
                mine.pop(i, None)
                mine |= {i: theirs[j]} if j in theirs else {}

    def observation(self, i: int) -> Any:
        """Return a new copy of the observation of vehicle i."""
        return self._seen[i].copy()

    def observations(self) -> Any:
        """Return a new copy of all observations, with a leading dimension of N."""
        return self._seen.copy()

    @abstractmethod
    def places(self) -> NDArray[np.float64]:
        """Return a new (N, 2) array of the positions x and y in the map, meters."""

    @abstractmethod
    def info(self, i: int) -> dict[str, Any]:
        """Return the `info` of vehicle i, without the reason why an episode ended."""

    @abstractmethod
    def infos(self) -> dict[str, NDArray[Any]]:
        """Return the `info` of all vehicles, each value as a new (N,) array."""


class _BitGenerator(ctypes.Structure):
    """State and functions of a generator, as declared in `numpy/random/bitgen.h`."""

    _fields_: ClassVar = [
        ("state", ctypes.c_void_p),
        ("next_uint64", ctypes.c_void_p),
        ("next_uint32", ctypes.c_void_p),
        ("next_double", ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p)),
        ("next_raw", ctypes.c_void_p),
    ]


_STATE, _NEXT_DOUBLE = 0, 3  # Indices of two fields. All fields are pointers.
_capsule_pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)


class Generators:
    """Generators of N vehicles for compiled code, which draws faster than a call in Python."""

    def __init__(self, count: int) -> None:
        """Prepare to draw from `count` generators."""
        self._generators: list[np.random.Generator | None] = [None] * count
        self._missing = count
        # (N,) addresses of the generators, for `draw`; 0 before `use`.
        self.addresses = np.zeros(count, dtype=np.intp)

    def use(self, i: int, generator: np.random.Generator) -> None:
        """Assign a generator to vehicle i."""
        # The address is valid only as long as the generator exists.
        before = self._generators[i]
        if before is not generator:
            self._generators[i], self.addresses[i] = generator, _address_of(generator)
            self._missing -= before is None

    def complete(
        self, chosen: NDArray[np.int64], generators: Sequence[np.random.Generator]
    ) -> None:
        """Assign to each of the chosen vehicles (K,) that has none its generator of the N."""
        if self._missing:
            for i in chosen.tolist():
                if self._generators[i] is None:
                    self.use(i, generators[i])

    def __getstate__(self) -> list[np.random.Generator | None]:
        """Return the generators for copying or pickling."""
        return self._generators

    def __setstate__(self, generators: list[np.random.Generator | None]) -> None:
        """Look up the addresses of the copied generators."""
        Generators.__init__(self, len(generators))
        for i, generator in enumerate(generators):
            if generator is not None:
                self.use(i, generator)


@compiled
def draw(address: int, shares: NDArray[np.float64]) -> None:
    """Fill an array with a generator's next numbers in [0, 1), like `Generator.random`."""
    for k in range(len(shares)):
        shares[k] = _next_double(address)


@compiled
def spread(share: float, most: float) -> float:
    """Map [0, 1] linearly to [-most, most]."""
    return (2.0 * share - 1.0) * most


def _address_of(generator: np.random.Generator) -> int:
    """Return the address of a generator's `_BitGenerator`."""
    return int(_capsule_pointer(generator.bit_generator.capsule, b"BitGenerator"))


def _next_double(address: int) -> float:
    """Return the next number of a generator."""
    one = _BitGenerator.from_address(int(address))
    return float(one.next_double(one.state))


@overload(_next_double, inline="always")  # type: ignore[untyped-decorator]
def _compiled_next_double(address: Any) -> Any:
    def next_double(address: Any) -> Any:
        return _call_next_double(address)

    return next_double


@intrinsic  # type: ignore[untyped-decorator]
def _call_next_double(context: Any, address: Any) -> Any:
    """Return code that calls `next_double` of the `_BitGenerator` at an address."""
    function = cgutils.ir.FunctionType(cgutils.ir.DoubleType(), [cgutils.voidptr_t])

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        fields = builder.inttoptr(values[0], cgutils.voidptr_t.as_pointer())
        state, next_double = (
            builder.load(cgutils.gep_inbounds(builder, fields, k)) for k in (_STATE, _NEXT_DOUBLE)
        )
        return builder.call(builder.bitcast(next_double, function.as_pointer()), [state])

    return types.float64(types.intp), code
