"""Small mistakes that a test should notice: the places of a module where they can be planted, and the planting.

Mistakes are those that numerical code suffers from: a comparison the other way round, plus for minus, a number off by
one, `any` for `all`, a root left out, arguments or entries swapped, a matrix not transposed or on the other side of a
product. Messages, annotations, docstrings and decorators are let alone.
"""

from __future__ import annotations

import ast
import copy
import functools
import hashlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

_NEGATED = {
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_BOUNDARY = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
_OPERATORS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
_PAIRS = (("min", "max"), ("minimum", "maximum"), ("amin", "amax"), ("all", "any"), ("sin", "cos"), ("floor", "ceil"))
_FUNCTIONS = {a: b for pair in _PAIRS for a, b in (pair, pair[::-1])}
# Swapped arguments change nothing, or only the type.
_SYMMETRIC = {"min", "max", "minimum", "maximum", "hypot", "isinstance", "zip", "equal", "logical_and", "logical_or"}
_LEFT_OUT = {"abs", "sqrt", "square", "log", "exp", "radians", "degrees", "deg2rad", "rad2deg"}
_NOT_ENTERED = (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom, ast.Global, ast.Nonlocal)
_NOT_FIELDS = {"annotation", "returns", "decorator_list", "bases", "type_params"}
_NOT_KEYWORDS = {"dtype", "device", "indexing", "prog", "help", "key", "encoding", "strict", "keepdim"}


class Site(NamedTuple):
    """A mistake that can be planted.

    Attributes:
        line: in the module's text.
        kind: of the mistake.
        before: the code that it changes.
        after: what it becomes.
        first: line of the statement, or of what stands at its head, that contains it.
        last: its last line.
        function: qualified name of the innermost function around it; empty outside of functions.
        key: the same as long as the statement of the module that contains it is.
        plant: changes the tree.
    """

    line: int
    kind: str
    before: str
    after: str
    first: int
    last: int
    function: str
    key: str
    plant: Callable[[], None]


def sites(tree: ast.Module, path: str) -> list[Site]:
    r"""List all mistakes that can be planted in the tree of a module, in the order of its text; plant one at most.

    Example:
        >>> tree = ast.parse("def area(a, b):\n    return a * b")
        >>> [(site.kind, site.before, site.after) for site in sites(tree, "area.py")]
        [('arithmetic', 'a * b', 'a / b'), ('sign', 'return a * b', 'return -(a * b)')]
    """
    found = []
    for statement in tree.body:
        text = f"{path}\n{ast.unparse(statement)}"
        for number, (place, kind, new, function) in enumerate(_walk(ast.Module([statement], []), "", "", (0, 0))):
            node = place.get()
            found.append(
                Site(
                    line=getattr(node, "lineno", 0),
                    kind=kind,
                    before=ast.unparse(node),
                    after=ast.unparse(ast.fix_missing_locations(new)),
                    first=place.lines[0],
                    last=place.lines[1],
                    function=function,
                    key=hashlib.sha256(f"{text}\n{number}".encode()).hexdigest()[:16],
                    plant=functools.partial(place.put, new),
                )
            )
    return sorted(found, key=lambda site: site.line)


class _Place(NamedTuple):
    """Where a node hangs; first and last line of what is executed with it."""

    parent: ast.AST
    field: str
    number: int | None
    lines: tuple[int, int]

    def get(self) -> ast.AST:
        value = getattr(self.parent, self.field)
        return value if self.number is None else value[self.number]

    def put(self, new: ast.AST) -> None:
        if self.number is None:
            setattr(self.parent, self.field, new)
        else:
            getattr(self.parent, self.field)[self.number] = new


def _walk(
    parent: ast.AST, scope: str, function: str, lines: tuple[int, int]
) -> Iterator[tuple[_Place, str, ast.AST, str]]:
    """Places below a node, each with its function; `scope` is what qualified names begin with there."""
    for field, value in ast.iter_fields(parent):
        for index, node in enumerate(value if isinstance(value, list) else [value]):
            if not isinstance(node, ast.AST) or field in _NOT_FIELDS or _is_left_alone(node):
                continue
            if isinstance(node, ast.stmt) or (isinstance(node, ast.expr) and isinstance(parent, ast.stmt)):
                whole = parent if isinstance(parent, ast.stmt) and not hasattr(parent, "body") else node
                span = getattr(whole, "lineno", 0), getattr(whole, "end_lineno", 0)
            else:
                span = lines
            place = _Place(parent, field, index if isinstance(value, list) else None, span)
            for kind, new in _variants(node, field, bool(function)):
                yield place, kind, ast.copy_location(new, node), function
            match node:
                case ast.FunctionDef(name=name):
                    # Defaults belong to what is around the function.
                    yield from _walk(node.args, scope, function, span)
                    body = ast.Module(node.body, [])
                    yield from _walk(body, f"{scope}{name}.<locals>.", f"{scope}{name}", span)
                case ast.ClassDef(name=name):
                    yield from _walk(node, f"{scope}{name}.", function, span)
                case _:
                    yield from _walk(node, scope, function, span)


def _is_left_alone(node: ast.AST) -> bool:
    if isinstance(node, _NOT_ENTERED):
        return True
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Constant)
    if isinstance(node, ast.keyword):
        return node.arg in _NOT_KEYWORDS
    if isinstance(node, ast.If):
        return "TYPE_CHECKING" in ast.unparse(node.test)
    return isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"


def _variants(node: ast.AST, field: str, inside: bool) -> Iterator[tuple[str, ast.AST]]:
    """Kinds of mistakes, each with the node that takes the place of this one."""
    new = copy.deepcopy(node)
    match node, new:
        case ast.Compare(ops=[op]), ast.Compare():
            yield "comparison", _with(new, ops=[_NEGATED[type(op)]()])
            counts = any(isinstance(side, ast.Constant | ast.Call) for side in (node.left, *node.comparators))
            if type(op) in _BOUNDARY and counts and not any(_is_float(n) for n in ast.walk(node)):
                yield "boundary", _with(new, ops=[_BOUNDARY[type(op)]()])
        case ast.BoolOp(op=op), ast.BoolOp():
            yield "boolean", _with(new, op=ast.Or() if isinstance(op, ast.And) else ast.And())
        case ast.UnaryOp(op=ast.Not() | ast.Invert()), ast.UnaryOp():
            yield "boolean", new.operand
        case ast.UnaryOp(op=ast.USub(), operand=operand), ast.UnaryOp() if not isinstance(operand, ast.Constant):
            yield "sign", new.operand
        case ast.BinOp(op=ast.MatMult()), ast.BinOp():
            yield "order", _with(new, left=new.right, right=new.left)
        case ast.BinOp(op=op), ast.BinOp() if type(op) in _OPERATORS and (inside or not isinstance(op, ast.BitOr)):
            yield "arithmetic", _with(new, op=_OPERATORS[type(op)]())
        case ast.AugAssign(op=op), ast.AugAssign() if type(op) in _OPERATORS:
            yield "arithmetic", _with(new, op=_OPERATORS[type(op)]())
        case ast.Constant(value=bool(value)), _:
            yield "constant", ast.Constant(not value)
        case ast.Constant(value=int() | float() as value), _:
            yield "constant", ast.Constant(value + 1)
        case ast.Attribute(attr="T" | "mT"), ast.Attribute():
            yield "transposed", new.value
        case ast.Call(func=ast.Attribute(attr="transpose")), ast.Call(func=ast.Attribute() as method):
            yield "transposed", method.value
        case ast.Call(), ast.Call():
            yield from _calls(new)
        case ast.List() | ast.Tuple(), ast.List(elts=elements) | ast.Tuple(elts=elements) if inside:
            # The order of what is searched or indexed with does not matter.
            matters = isinstance(node.ctx, ast.Load) and field not in ("slice", "comparators", "iter")
            if matters and len(elements) > 1 and _are_alike(elements[:2]):
                yield "order", _with(new, elts=[elements[1], elements[0], *elements[2:]])
        case ast.Slice(upper=upper), ast.Slice() if upper is not None and not isinstance(upper, ast.Constant):
            yield "slice", _with(new, upper=ast.BinOp(copy.deepcopy(upper), ast.Sub(), ast.Constant(1)))
        case ast.Return(value=ast.BinOp() as value), ast.Return() if not isinstance(value.op, ast.BitAnd | ast.BitOr):
            yield "sign", _with(new, value=ast.UnaryOp(ast.USub(), copy.deepcopy(value)))
    if field == "test" and isinstance(node, ast.Name | ast.Attribute | ast.Call):
        yield "boolean", ast.UnaryOp(ast.Not(), copy.deepcopy(node))


def _calls(new: ast.Call) -> Iterator[tuple[str, ast.AST]]:
    name = new.func.attr if isinstance(new.func, ast.Attribute) else getattr(new.func, "id", "")
    if name in _FUNCTIONS:
        other = copy.deepcopy(new)
        func: ast.AST = other.func
        setattr(func, "attr" if isinstance(func, ast.Attribute) else "id", _FUNCTIONS[name])
        yield "function", other
    if name in _LEFT_OUT and (inner := new.args[0] if new.args else getattr(new.func, "value", None)) is not None:
        yield "function left out", inner
    first = 1 if name == "where" else 0
    pair = new.args[first : first + 2]
    if len(pair) == 2 and name not in _SYMMETRIC and _are_alike(pair):
        yield "arguments", _with(new, args=[*new.args[:first], pair[1], pair[0], *new.args[first + 2 :]])


def _are_alike(pair: list[ast.expr]) -> bool:
    """Whether two expressions may be taken for each other: neither is a literal, a list or unpacked."""
    odd = ast.Constant | ast.List | ast.Tuple | ast.Starred | ast.Lambda | ast.JoinedStr | ast.Dict
    return not any(isinstance(one, odd) for one in pair) and ast.unparse(pair[0]) != ast.unparse(pair[1])


def _is_float(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, float)


def _with(node: ast.AST, **fields: object) -> ast.AST:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed
