"""Export of a driver as a program of one file, which needs rclpy, ONNX Runtime and NumPy only.

Images that are compressed or resized need Pillow as well.

The file has the code of `node_main` and of all that it uses from this package, so that the node
does what `Driver` does; the mapping as resolved, and the policy as an ONNX model.
"""

from __future__ import annotations

import ast
import base64
import importlib
import inspect
import json
import textwrap
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mcaprl.drive.driver import Driver
from mcaprl.errors import PolicyError, UsageError
from mcaprl.files import replacing

_MAIN = "mcaprl.drive.node_main"
_REPLACED = {
    ("mcaprl.recorder.mapping.config", "Stamp"): (_MAIN, "NodeStamp"),
    ("mcaprl.errors", "import_extra"): (_MAIN, "node_import"),
}
_WIDTH = 96
_HEAD = '''"""Node that drives a robot by a trained policy; written by `mcaprl export --node`.

It needs rclpy, onnxruntime and numpy{more}: source your ROS 2, and run `python3 {name}`.
"""

from __future__ import annotations
'''


def export_node(driver: Driver, path: Path, *, overwrite: bool = False) -> None:
    """Write the node of a driver."""
    for name, reader in driver._plan.images.items():
        if reader.packets_ns is not None:
            raise UsageError(
                f"{name}: a node of one file cannot decode the video of {reader.topic}: train with"
                " a topic of images, or use `mcaprl drive`"
            )
    from mcaprl.offline.export import export_onnx

    with TemporaryDirectory() as folder:
        model = Path(folder) / "policy.onnx"
        export_onnx(driver.policy, model)
        data = base64.b64encode(model.read_bytes()).decode()
    spec = json.dumps(_spec(driver))
    text = "\n".join(
        [
            _HEAD.format(name=path.name, more=", and Pillow" if driver._plan.images else ""),
            _Bundle().text("main"),
            "import json\n",
            f"SPEC = json.loads(\n{_quoted(spec)}\n)",
            f"MODEL = (\n{_quoted(data)}\n)\n",
            'if __name__ == "__main__":\n    main(SPEC, MODEL)\n',
        ]
    )
    with replacing(path, PolicyError, overwrite=overwrite) as unfinished:
        unfinished.write_text(text)


def _quoted(text: str) -> str:
    return (
        "\n".join(f"    {part!r}" for part in textwrap.wrap(text, _WIDTH, drop_whitespace=False))
        or "''"
    )


def _spec(driver: Driver) -> dict[str, Any]:
    """Return what `NodePlan` reads."""
    plan, mapping = driver._plan, driver.mapping
    names = [*driver.inputs, *driver.outputs]
    infos = {
        name: {**vars(info), "unreadable": dict(info.unreadable)}
        for name, info in plan.bag.topics.items()
        if name in names
    }
    quantities = {
        name: {
            "quantity": wanted.quantity.model_dump(),
            "topic": wanted.source.topic,
            "fields": wanted.source.fields,
            "path": None if wanted.source.path is None else _path(wanted.source.path),
            "names": wanted.source.names,
            "stream": wanted.stream,
        }
        for name, wanted in plan.quantities.items()
    }
    used = {wanted.stream for wanted in plan.quantities.values()} | {plan.clock}
    streams = [
        [name, stream.topic, stream.fields, _dumped(stream.time)]
        for name, stream in plan.streams.items()
        if name in used
    ]
    return {
        "topics": infos,
        "clock": mapping.clock.model_dump(),
        "episodes": mapping.episodes.model_dump(),
        "drive": mapping.drive.model_dump(),
        "stack": mapping.stack,
        "observation": {name: each.model_dump() for name, each in mapping.observation.items()},
        "quantities": quantities,
        "streams": streams,
        "images": {name: reader.fields for name, reader in plan.images.items()},
        "conditions": {name: each.text for name, each in plan.conditions.items()},
        "constants": {name: int(each) for name, each in plan.constants.items()},
        "frames": {topic: plan.transform_time(topic) for topic in plan.frames},
        "clock_stream": plan.clock,
        "required": plan.required,
        "observed": plan.observed,
        "shapes": {name: list(shape) for name, shape in driver._robot.shapes.items()},
        "inputs": {leaf.name: "".join(leaf.path) for leaf in driver.policy.encoder.leaves},
        "frame_stack": driver.policy.frame_stack,
        "chunk": driver.policy.chunk.to_json(),
        "commands": driver._robot_commands.plain,
    }


def _path(path: Any) -> str:
    """Return a path in its message."""
    return str(path).removeprefix(path.topic).removeprefix(".")


def _dumped(time: Any) -> Any:
    return time if isinstance(time, str) else time.model_dump()


class _Module:
    """Definitions and imports at the top level of a module, by name."""

    def __init__(self, name: str) -> None:
        self.definitions: dict[str, ast.stmt] = {}
        self.imports: dict[str, tuple[str, str]] = {}
        for node in ast.parse(inspect.getsource(importlib.import_module(name))).body:
            match node:
                case ast.FunctionDef(name=own) | ast.ClassDef(name=own):
                    self.definitions[own] = node
                case (
                    ast.Assign(targets=[ast.Name(id=own)]) | ast.AnnAssign(target=ast.Name(id=own))
                ):
                    self.definitions[own] = node
                case ast.Assign(targets=[ast.Tuple(elts=targets)], value=ast.Tuple(elts=values)):
                    for target, value in zip(targets, values, strict=True):
                        assert isinstance(target, ast.Name), "constants have names"
                        self.definitions[target.id] = ast.Assign([target], value)
                case ast.Import(names=names):
                    self.imports |= {each.asname or each.name: (each.name, "") for each in names}
                case ast.ImportFrom(module=module, names=names):
                    self.imports |= {
                        each.asname or each.name: (str(module), each.name) for each in names
                    }


_module = cache(_Module)


class _Names(ast.NodeVisitor):
    """Names that are used when code runs: annotations are texts."""

    def __init__(self) -> None:
        self.found: dict[str, None] = {}

    def visit_Name(self, node: ast.Name) -> None:
        self.found[node.id] = None

    def visit_arg(self, node: ast.arg) -> None:
        pass

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for each in (*node.decorator_list, node.args, *node.body):
            self.visit(each)


class _Renamed(ast.NodeTransformer):
    """Other names of definitions, where two modules have the same name."""

    def __init__(self, names: dict[str, str]) -> None:
        self._names = names

    def visit_Name(self, node: ast.Name) -> ast.Name:
        node.id = self._names.get(node.id, node.id)
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.returns = None
        for each in ast.walk(node.args):
            if isinstance(each, ast.arg):
                each.annotation = None
        return self.generic_visit(node)


class _Bundle:
    """Code of a definition and of all that it uses, in an order in which it runs."""

    def __init__(self) -> None:
        self._own: dict[tuple[str, str], str] = {}
        self._parts: list[str] = []
        self._imports: dict[str, str] = {}

    def text(self, name: str) -> str:
        """Return the code with a definition of `node_main`."""
        self._add(_MAIN, name)
        return "\n".join([*self._imports.values(), *self._parts])

    def _add(self, module: str, name: str) -> str:
        """Add a definition after all that it uses; return its name in the file."""
        module, name = _REPLACED.get((module, name), (module, name))
        found = _module(module)
        if name in found.imports:
            return self._imported(*found.imports[name], name)
        key = (module, name)
        if key in self._own:
            return self._own[key]
        taken = {*self._own.values(), *self._imports}
        own = name if name not in taken else f"{name}_of_{module.rpartition('.')[2]}"
        self._own[key] = own
        node = found.definitions[name]
        names, renamed = _Names(), {name: own}
        names.visit(node)
        if isinstance(node, ast.AnnAssign) and node.value is None:
            return own
        for each in names.found:
            if each != name and (each in found.definitions or each in found.imports):
                renamed[each] = self._add(module, each)
        text = ast.unparse(
            _Renamed(renamed).visit(ast.parse(ast.unparse(ast.fix_missing_locations(node))))
        )
        kind = {ast.FunctionDef: "def ", ast.ClassDef: "class "}.get(type(node))
        if kind is not None:
            text = text.replace(f"{kind}{name}", f"{kind}{own}", 1)
        self._parts.append(f"\n{text}")
        return own

    def _imported(self, module: str, original: str, name: str) -> str:
        if module.startswith("mcaprl"):
            return self._add(module, original)
        line = f"from {module} import {original}" if original else f"import {module}"
        shown = original or module
        suffix = "" if shown == name else f" as {name}"
        known = self._imports.setdefault(name, f"{line}{suffix}")
        is_clear = known == f"{line}{suffix}" and name not in self._own.values()
        assert is_clear, f"{name} has two meanings in {_MAIN}"
        return name
