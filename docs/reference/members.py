"""What the reference shows of a module, in the words of its source."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from typing import Annotated, Any, ForwardRef, get_origin
from unittest.mock import patch

import pdoc.doc
import pdoc.doc_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo

#: How a constraint of a pydantic field reads.
CONSTRAINTS = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤", "min_length": "length ≥", "max_length": "length ≤"}


class Written(str):
    """Source text that pdoc prints as it stands."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


class _WithoutMetadata(ast.NodeTransformer):
    """Annotated[T, …] as T."""

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.value, ast.Name) and node.value.id == "Annotated":
            assert isinstance(node.slice, ast.Tuple)
            return node.slice.elts[0]
        return node


def written(source: str) -> Written:
    """`source` of an expression without what Annotated adds."""
    return Written(ast.unparse(_WithoutMetadata().visit(ast.parse(source, mode="eval"))))


@contextmanager
def written_annotations() -> Iterator[None]:
    """Within it pdoc leaves annotations as they are written; evaluated, `Array` takes a line."""

    def leave(annotation: Any, *_: Any) -> Any:
        if isinstance(annotation, ForwardRef):
            annotation = annotation.__forward_arg__
        if get_origin(annotation) is Annotated:
            return annotation.__origin__
        return written(annotation) if isinstance(annotation, str) else annotation

    def leave_all(annotations: dict[str, Any], *_: Any) -> dict[str, Any]:
        return {name: leave(annotation) for name, annotation in annotations.items()}

    with (
        patch.object(pdoc.doc, "safe_eval_type", leave),
        patch.object(pdoc.doc, "resolve_annotations", leave_all),
    ):
        yield


def present(module: pdoc.doc.Module) -> None:
    """Keep the variables that a `#:` comment describes, and say of fields and members what their types do not."""
    described = _described(inspect.getsource(module.obj))
    for name, member in list(module.members.items()):
        if isinstance(member, pdoc.doc.Variable):
            if name in described:
                member.docstring, member.default_value = described[name]
            else:
                del module.members[name]
        elif isinstance(member, pdoc.doc.Class):
            _present_class(member)


def exports(module: pdoc.doc.Module) -> list[pdoc.doc.Doc[Any]]:
    """What `module` offers under its own name though it is defined elsewhere: `from … import X as X`."""
    names = [
        alias.name
        for node in ast.parse(inspect.getsource(module.obj)).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name
    ]
    objects = [getattr(module.obj, name) for name in names]
    return [pdoc.doc.Module.from_name(item.__module__).members[item.__name__] for item in objects]


def _described(source: str) -> dict[str, tuple[str, Written]]:
    """Name → (comment, value) of the assignments at the top level that a `#:` comment precedes."""
    lines = source.splitlines()
    described = {}
    for node in ast.parse(source).body:
        match node:
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                pass
            case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
                pass
            case _:
                continue
        first = node.lineno - 1
        while lines[first - 1].startswith("#:"):
            first -= 1
        comment = " ".join(line.removeprefix("#:").strip() for line in lines[first : node.lineno - 1])
        if comment:
            described[name] = (comment, written(ast.unparse(value)))
    return described


def _present_class(shown: pdoc.doc.Class) -> None:
    kind: Any = shown.obj
    members: dict[str, Any] = shown.members
    if issubclass(kind, BaseModel):
        for name, info in kind.model_fields.items():
            _present_field(members[name], info)
    elif issubclass(kind, Enum):
        for item in kind:
            members[item.name].default_value = item.value
    elif issubclass(kind, tuple):
        # What NamedTuple says of its fields, "Alias for field number 0", tells nobody anything.
        for name in ("__init__", *kind._fields):
            members[name].docstring = ""


def _present_field(variable: Any, info: FieldInfo) -> None:
    allowed = ["required"] if info.is_required() else []
    for constraint in info.metadata:
        allowed += [
            f"{sign} {getattr(constraint, key):g}"
            for key, sign in CONSTRAINTS.items()
            if hasattr(constraint, key)
        ]
    if allowed:
        variable.annotation = Written(f"{variable.annotation} ({', '.join(allowed)})")
    default = info.default
    if info.is_required():
        variable.default_value = pdoc.doc_types.empty
    elif isinstance(default, BaseModel) and default == type(default).model_construct():
        variable.default_value = Written(f"{type(default).__name__}()")
