"""Expressions: Python arithmetic and comparisons with named columns, and no other Python code.

An expression is parsed by `ast` and evaluated for all rows at once. It may contain numbers,
strings for comparison, names, elements such as `pose[0]`, `+ - * / // % **`, comparisons, `and`,
`or`, `not`, `A if CONDITION else B`, and calls of the functions in `FUNCTIONS`. Attributes but
those of `labels`, other calls, and all other syntax are errors.

A missing number is NaN, and a missing text is None. Comparisons with a missing value are missing,
and logic has three values, as in SQL: `missing or 1` is 1, `missing or 0` is missing.

`labels.NAME` is the name of a label: NaN if it is `success`, empty if it is `note`, and otherwise
false, where there is none.
"""

from __future__ import annotations

import ast
import itertools
import operator
from collections.abc import Callable, Mapping
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import UnknownNameError, UsageError

Column = NDArray[Any]

FUNCTIONS: Final[dict[str, tuple[Callable[..., Any], int]]] = {
    "abs": (np.abs, 1),
    "sqrt": (np.sqrt, 1),
    "exp": (np.exp, 1),
    "log": (np.log, 1),
    "sin": (np.sin, 1),
    "cos": (np.cos, 1),
    "tan": (np.tan, 1),
    "atan2": (np.arctan2, 2),
    "hypot": (np.hypot, 2),
    "min": (np.minimum, 2),
    "max": (np.maximum, 2),
    "sign": (np.sign, 1),
    "isnan": (np.isnan, 1),
    "clip": (np.clip, 3),
}
"""By name: a function that expressions can call, and the number of its arguments."""
_PREFIX: Final = "labels."
"""Beginning of the name of a label."""
NEXT: Final = "next"
"""Name of the function that evaluates its argument at the next step."""
_MAX_CHARACTERS, _MAX_DEPTH, _MAX_SHOWN = 4000, 50, 200
_MAX_BITS = 1023
"""Bits of the largest integer that float64 can represent."""
_STRING = "a string can only be compared with a string, using == or !="

_BINARY: Final[dict[type[ast.operator], Callable[..., Any]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
}
_COMPARED: Final[dict[type[ast.cmpop], Callable[..., Any]]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}


class Expression:
    """A parsed expression.

    Attributes:
        text: Text of the expression.
        names: Names of the columns that the expression reads.
        labels: Names of the labels that the expression reads, without `labels.`.
        uses_next: Whether the expression calls `next`.
    """

    def __init__(self, text: str) -> None:
        """Parse the text."""
        self.text = text
        if len(text) > _MAX_CHARACTERS:
            raise UsageError(
                f"the expression has {len(text)} characters; the limit is {_MAX_CHARACTERS}"
            )
        try:
            self._tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise UsageError(f"'{self._shown}' is not an expression: {error}") from error
        names = set[str]()
        self._check(self._tree, 0, names)
        self.names = frozenset(names)
        self.labels = frozenset(
            name.removeprefix(_PREFIX) for name in names if name.startswith(_PREFIX)
        )
        self.uses_next = any(
            isinstance(node, ast.Name) and node.id == NEXT for node in ast.walk(self._tree)
        )

    def evaluate(self, columns: Mapping[str, Column], following: NDArray[np.int64]) -> Column:
        """Return the value at each step, (N,).

        Args:
            columns: (N,) or (N, K) column of each name.
            following: (N,) index of the row after each row, which `next` reads.
        """
        columns = self._with_labels(columns)
        for name in self.names:
            if name not in columns:
                raise UnknownNameError("name in an expression", name, columns)
        try:
            with np.errstate(all="ignore"):
                found = np.asarray(self._value(self._tree, columns, following))
        except (TypeError, ValueError, IndexError, OverflowError) as error:
            raise UsageError(f"'{self._shown}' cannot be evaluated: {error}") from error
        if found.ndim > 1 or found.dtype.kind not in "biuf":
            raise UsageError(f"'{self._shown}' must be one number for each row")
        return np.broadcast_to(found, following.shape)

    def is_condition(self, columns: Mapping[str, Column]) -> bool:
        """Return whether all values are true, false or missing."""
        columns = self._with_labels(columns)

        def holds(node: ast.AST) -> bool:
            match node:
                case ast.Compare() | ast.BoolOp() | ast.UnaryOp(op=ast.Not()):
                    return True
                case ast.Call(func=ast.Name(id="isnan")):
                    return True
                case ast.Name() | ast.Attribute():
                    return columns[ast.unparse(node)].dtype == np.bool_
                case ast.IfExp(body=body, orelse=other):
                    return holds(body) and holds(other)
                case _:
                    return False

        return holds(self._tree)

    def _with_labels(self, columns: Mapping[str, Column]) -> Mapping[str, Column]:
        """Add the values of the labels that nobody gave."""
        if not self.labels:
            return columns
        known = {"success": np.array(np.nan), "note": np.array("", object)}
        missing = {f"{_PREFIX}{name}": known.get(name, np.array(False)) for name in self.labels}
        return {**missing, **columns}

    def _check(self, node: ast.AST, depth: int, names: set[str]) -> None:
        if depth > _MAX_DEPTH:
            raise UsageError(f"'{self._shown}' is nested too deeply")
        allowed: tuple[type[ast.AST], ...] = (ast.Name, ast.Constant, ast.BinOp, ast.UnaryOp)
        allowed += (ast.BoolOp, ast.Compare, ast.IfExp, ast.Call, ast.Subscript, ast.Attribute)
        if not isinstance(node, allowed):
            raise self._refused(node)
        parts: list[ast.expr] = []
        match node:
            case ast.Name(id=name) if name in FUNCTIONS or name == NEXT:
                raise UsageError(f"'{self._shown}': {name} is a function; call it as {name}(...)")
            case ast.Name() | ast.Attribute(value=ast.Name(id="labels")):
                names.add(ast.unparse(node))
            case ast.Attribute():
                raise self._refused(node)
            case ast.Constant(value=value) if not isinstance(value, bool | int | float | str):
                raise self._refused(node)
            case ast.Constant(value=int(value)) if value.bit_length() > _MAX_BITS:
                raise UsageError(f"'{self._shown}' has a number that is too large")
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
                count = 1 if name == NEXT else FUNCTIONS.get(name, (None, -1))[1]
                if count < 0:
                    raise UnknownNameError("function", name, [*FUNCTIONS, NEXT])
                if len(args) != count:
                    raise UsageError(f"'{self._shown}': {name} needs {count} arguments")
                parts = args
            case ast.Call():
                raise self._refused(node)
            case ast.Subscript(value=value, slice=part):
                ast.literal_eval(part) if _is_integer(part) else self._refuse(node)
                parts = [value]
            case ast.BinOp(left=left, op=op, right=right):
                parts = [left, right] if type(op) in _BINARY else self._refuse(node)
            case ast.Compare(left=left, ops=ops, comparators=others):
                known = all(type(op) in _COMPARED for op in ops)
                parts = [left, *others] if known else self._refuse(node)
            case ast.UnaryOp(op=op, operand=operand):
                parts = [operand] if not isinstance(op, ast.Invert) else self._refuse(node)
            case ast.BoolOp(values=values):
                parts = values
            case ast.IfExp(test=test, body=body, orelse=other):
                parts = [test, body, other]
        for part in parts:
            self._check(part, depth + 1, names)

    @property
    def _shown(self) -> str:
        """Text for error messages."""
        return _shortened(self.text)

    def _refused(self, node: ast.AST) -> UsageError:
        try:
            part = _shortened(ast.unparse(node))
        # The expression may be nested more deeply than `_MAX_DEPTH`.
        except RecursionError:
            part = self._shown
        return UsageError(
            f"'{self._shown}': '{part}' is not allowed; use names, numbers, operators, and"
            f" {', '.join([*FUNCTIONS, NEXT])}"
        )

    def _refuse(self, node: ast.AST) -> Any:
        raise self._refused(node)

    def _value(
        self, node: ast.AST, columns: Mapping[str, Column], following: NDArray[np.int64]
    ) -> Any:
        def value(part: ast.AST) -> Any:
            return self._value(part, columns, following)

        match node:
            case ast.Constant(value=constant):
                # Use float64: NumPy integers can overflow, and Python integers have no size limit.
                return constant if isinstance(constant, str) else np.float64(cast(Any, constant))
            case ast.Name(id=name):
                return columns[name]
            case ast.Attribute(attr=name):
                return columns[f"{_PREFIX}{name}"]
            case ast.Subscript(value=inner, slice=part):
                found = np.asarray(value(inner))
                if found.ndim != 2:
                    raise ValueError(f"'{ast.unparse(inner)}' has no elements")
                return found[:, ast.literal_eval(part)]
            case ast.BinOp(left=left, op=op, right=right):
                return _BINARY[type(op)](_number(value(left)), _number(value(right)))
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                number = _number(value(operand))
                return np.where(np.isnan(number), np.nan, number == 0)
            case ast.UnaryOp(op=op, operand=operand):
                number = _number(value(operand))
                return -number if isinstance(op, ast.USub) else number
            case ast.BoolOp(op=op, values=parts):
                return _combined([_number(value(part)) for part in parts], isinstance(op, ast.Or))
            case ast.Compare(left=left, ops=ops, comparators=others):
                sides = [value(left), *map(value, others)]
                pairs = zip(ops, itertools.pairwise(sides), strict=True)
                return _combined([_compared(op, *pair) for op, pair in pairs], is_or=False)
            case ast.IfExp(test=test, body=body, orelse=other):
                condition = _number(value(test))
                found = np.where(condition != 0, value(body), value(other))
                nothing = np.nan if found.dtype.kind in "biuf" else None
                return np.where(np.isnan(condition), nothing, found)
            case ast.Call(func=ast.Name(id=name), args=args):
                if name == NEXT:
                    found = np.asarray(value(args[0]))
                    return found[following] if found.ndim else found
                return FUNCTIONS[name][0](*(_number(value(part)) for part in args))
            case _:
                raise AssertionError(f"{ast.dump(node)} was checked")


def _shortened(text: str) -> str:
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."


def _is_integer(node: ast.AST) -> bool:
    match node:
        case ast.Constant(value=int()):
            return True
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int())):
            return True
        case _:
            return False


def _number(value: Any) -> Any:
    """Return booleans and numbers as float64."""
    found = np.asarray(value)
    if found.dtype.kind not in "biuf":
        raise TypeError(_STRING)
    return found.astype(np.float64)


def _compared(op: ast.cmpop, left: Any, right: Any) -> Any:
    are_texts = [np.asarray(side).dtype.kind not in "biuf" for side in (left, right)]
    if any(are_texts):
        if not all(are_texts) or not isinstance(op, ast.Eq | ast.NotEq):
            raise TypeError(_STRING)
        left, right = np.asarray(left, object), np.asarray(right, object)
    holds = _COMPARED[type(op)](left, right)
    return np.where(_is_missing(left) | _is_missing(right), np.nan, holds)


def _is_missing(side: Any) -> NDArray[np.bool_]:
    values = np.asarray(side)
    if values.dtype.kind in "biuf":
        return np.asarray(np.isnan(values))
    return np.asarray(np.frompyfunc(lambda value: value is None, 1, 1)(values), bool)


def _combined(sides: list[Any], is_or: bool) -> NDArray[np.float64]:
    """Return the conjunction or disjunction of numbers, NaN where it depends on missing values."""
    numbers = np.stack(np.broadcast_arrays(*sides))
    is_missing = np.isnan(numbers)
    decides = ~is_missing & ((numbers != 0) == is_or)
    undecided = np.where(is_missing.any(axis=0), np.nan, float(not is_or))
    return np.where(decides.any(axis=0), float(is_or), undecided)
