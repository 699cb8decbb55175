"""Mutants in the syntax tree of Cython, right behind its parser: `install` makes every compilation add those of its room.

    comparison   a < b -> a <= b and a >= b; == and != exchanged; `and` and `or` exchanged; `not` left out
    bound        min and max exchanged; fabs left out
    sign         + and - exchanged, * and /, & and |, << and >>; unary minus left out
    constant     an integer n -> n + 1 (n XOR 1 as an index), a float x -> 2 x (0 -> 1), True and False exchanged
    statement    an assignment, a call or a jump deleted

Left alone are declarations, default values, messages of exceptions, and functions that only give a test Python values.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from Cython.Compiler import ExprNodes, Nodes, Pipeline, StringEncoding

COMPARED = {
    "<": ("<=", ">="),
    "<=": ("<", ">"),
    ">": (">=", "<="),
    ">=": (">", "<"),
    "==": ("!=",),
    "!=": ("==",),
    "is": ("is_not",),
    "is_not": ("is",),
    "in": ("not_in",),
    "not_in": ("in",),
}
EXCHANGED = {"+": "-", "-": "+", "*": "/", "/": "*", "&": "|", "|": "&", "<<": ">>", ">>": "<<"}
FUNCTIONS = {"min": "max", "max": "min"}
DROPPED = ("fabs", "nearbyint", "ceil", "sqrt")
C_CODE = r'''
cdef extern from *:
    """
    #include <fcntl.h>
    #include <stdlib.h>
    #include <sys/mman.h>
    static volatile int jtqd_none = -1, *jtqd_chosen = &jtqd_none;
    static unsigned char *jtqd_reached = 0;
    static void __attribute__((constructor)) jtqd_map(void) {
        const char *path = getenv("JTQD_MUTANTS");
        int file = path ? open(path, O_RDWR) : -1;
        if (file >= 0) {
            void *memory = mmap(0, 4 + JTQD_NUMBERS, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
            if (memory != MAP_FAILED) {
                jtqd_chosen = (int *) memory;
                jtqd_reached = (unsigned char *) memory + 4;
            }
        }
    }
    static inline int jtqd_is(int number) {
        if (jtqd_reached) jtqd_reached[number] = 1;
        return number == *jtqd_chosen;
    }
    """
    bint jtqd_is(int number) noexcept nogil
'''
"""Behind the source of a room: the chosen mutant, and what was reached, lie in a file that all processes of a test share."""


class Mutator:
    """Mutants of one module: `table`, and `uses`: the names that each function and each statement of the module uses."""

    def __init__(self, first: int) -> None:
        self.next, self.function, self.compiled = first, "", False
        self.names: set[str] = set()
        self.table: list[dict[str, Any]] = []
        self.uses: dict[str, set[str]] = {}

    def chosen(self, node: Any, change: str) -> Any:
        """Return the call that is true where a new mutant is chosen."""
        self.table.append(
            {
                "number": self.next,
                "line": node.pos[1],
                "column": node.pos[2],
                "change": change,
                "function": self.function,
                "names": sorted(self.names),
            }
        )
        call = ExprNodes.SimpleCallNode(
            node.pos, function=name("jtqd_is", node.pos), args=[integer(self.next, node.pos)]
        )
        self.next += 1
        return call

    def either(self, node: Any, clean: Any, change: str, other: Any) -> Any:
        """Return `other if chosen else node`; where it is the place of the original, `clean` of it has no mutants."""
        chosen = self.chosen(clean, change)
        return ExprNodes.CondExprNode(node.pos, condition=chosen, true_val=other, false_val=node)

    # Walk ----------------------------------------------------------------------------------------------------------

    def walk(self, node: Any) -> Any:
        """Return the node with the mutants of all that is below it, and its own."""
        if node is None or isinstance(node, LEFT_ALONE):
            return node
        if isinstance(node, (Nodes.CFuncDefNode, Nodes.DefNode)):
            outer, self.function = self.function, f"{self.function}.{function_name(node)}".strip(".")
            self.uses[self.function] = {
                each.name for each in every(node.body) if isinstance(each, ExprNodes.NameNode)
            }
            self.compiled = isinstance(node, Nodes.CFuncDefNode)
            node.body = self.walk(node.body)
            self.function, self.compiled = outer, False
            return node
        if isinstance(node, (Nodes.CClassDefNode, Nodes.PyClassDefNode)):
            outer, self.function = self.function, str(getattr(node, "class_name", None) or node.name)
            node.body = self.walk(node.body)
            self.function = outer
            return node
        clean = clone(node)
        for attribute in node.child_attrs or ():
            child = getattr(node, attribute)
            if attribute in ("decorators", "base_type", "annotation") or child is None:
                continue
            if isinstance(child, list):
                made: Any = [self.top(each) if self.at_top(node) else self.walk(each) for each in child]
                if attribute == "args" and is_range(node):  # a loop whose step is no constant is no loop in C
                    made[2:] = child[2:]
            elif isinstance(node, ExprNodes.IndexNode) and isinstance(child, ExprNodes.IntNode):
                other = integer(int(child.value, 0) ^ 1, child.pos)
                made = self.either(child, child, f"[{child.value}] -> [{other.value}]", other)
            else:
                made = self.walk(child)
            setattr(node, attribute, made)
        if not isinstance(node, ExprNodes.ExprNode):
            return self.statement(node, clean) if self.function and isinstance(node, DELETED) else node
        for change, other in [] if holds_scope(clean) else variants(clean):
            if (
                isinstance(clean, ExprNodes.BoolBinopNode) and self.compiled
            ):  # its C values may differ in type
                node = self.either(truth(node), clean, change, truth(other))
            else:
                node = self.either(node, clean, change, other)
        return node

    def at_top(self, node: Any) -> bool:
        """Return whether the children of a node are statements of the module."""
        return not self.function and isinstance(node, Nodes.StatListNode)

    def top(self, node: Any) -> Any:
        """Walk a statement of the module: what it sets may carry its mutants to where that is used."""
        if isinstance(node, (Nodes.CFuncDefNode, Nodes.DefNode, Nodes.CClassDefNode, Nodes.PyClassDefNode)):
            return self.walk(node)
        self.names = targets(node)
        key = f"module {node.pos[1]}"
        self.uses[key] = {each.name for each in every(node) if isinstance(each, ExprNodes.NameNode)}
        self.uses[key + " sets"] = self.names
        node = self.walk(node)
        self.names = set()
        return node

    def statement(self, node: Any, clean: Any) -> Any:
        """Return `node` where a mutant does not delete it, or does something else instead."""
        if isinstance(node, Nodes.ExprStatNode) and not any(
            isinstance(each, ExprNodes.SimpleCallNode) for each in every(clean)
        ):
            return node  # a docstring
        if isinstance(node, Nodes.ReturnStatNode) and clean.value is not None:
            return node
        if (
            isinstance(node, Nodes.InPlaceAssignmentNode)
            and node.operator in EXCHANGED
            and not holds_scope(clean)
        ):
            other = clone(clean)
            other.operator = EXCHANGED[node.operator]
            chosen = self.chosen(clean, f"{node.operator}= -> {other.operator}=")
            node = condition(node.pos, chosen, other, node)
        chosen = self.chosen(clean, "statement deleted")
        return condition(node.pos, ExprNodes.NotNode(node.pos, operand=chosen), node, None)


LEFT_ALONE = (
    Nodes.RaiseStatNode, Nodes.AssertStatNode, Nodes.CEnumDefNode, Nodes.CArgDeclNode, Nodes.CStructOrUnionDefNode,
    Nodes.FromImportStatNode, Nodes.FromCImportStatNode, Nodes.CImportStatNode, Nodes.CDefExternNode,
    Nodes.CArrayDeclaratorNode, Nodes.CBaseTypeNode, ExprNodes.JoinedStrNode, ExprNodes.SizeofVarNode,
    ExprNodes.SizeofTypeNode, ExprNodes.NameNode, ExprNodes.ImportNode,
)  # fmt: skip
DELETED = (
    Nodes.SingleAssignmentNode, Nodes.InPlaceAssignmentNode, Nodes.CascadedAssignmentNode, Nodes.ExprStatNode,
    Nodes.ReturnStatNode, Nodes.BreakStatNode, Nodes.ContinueStatNode,
)  # fmt: skip


def every(node: Any) -> Any:
    """Yield a node and all below it."""
    if node is None:
        return
    yield node
    for attribute in node.child_attrs or ():
        child = getattr(node, attribute, None)
        for each in child if isinstance(child, list) else [child]:
            yield from every(each)


def clone(node: Any) -> Any:
    """Return a copy of a node and of all below it."""
    if node is None:
        return None
    copy = node.clone_node()
    for attribute in copy.child_attrs or ():
        child = getattr(copy, attribute, None)
        if child is not None:
            setattr(
                copy, attribute, [clone(each) for each in child] if isinstance(child, list) else clone(child)
            )
    return copy


def holds_scope(node: Any) -> bool:
    """Return whether a comprehension is in a node: it refers to itself, and cannot be cloned."""
    return any(isinstance(each, (ExprNodes.ScopedExprNode, ExprNodes.LambdaNode)) for each in every(node))


def is_range(node: Any) -> bool:
    """Return whether a node is a call of range."""
    function = getattr(node, "function", None)
    return isinstance(function, ExprNodes.NameNode) and function.name == "range"


def targets(node: Any) -> set[str]:
    """Return the names of the module that a statement sets."""
    found = set()
    for each in every(node):
        if isinstance(each, Nodes.CNameDeclaratorNode):
            found.add(str(each.name))
        for side in [*getattr(each, "lhs_list", ()), getattr(each, "lhs", None)]:
            found |= {str(part.name) for part in every(side) if isinstance(part, ExprNodes.NameNode)}
    return {each for each in found if each and not each.startswith("_")}


def function_name(node: Any) -> str:
    """Return the name of a function."""
    declarator = getattr(node, "declarator", None)
    while declarator is not None and not hasattr(declarator, "name"):
        declarator = declarator.base
    return str(node.name if declarator is None else declarator.name)


def name(text: str, pos: Any) -> Any:
    return ExprNodes.NameNode(pos, name=StringEncoding.EncodedString(text))


def truth(node: Any) -> Any:
    return ExprNodes.NotNode(node.pos, operand=ExprNodes.NotNode(node.pos, operand=node))


def integer(value: int, pos: Any) -> Any:
    return ExprNodes.IntNode(pos, value=str(value))


def condition(pos: Any, test: Any, body: Any, otherwise: Any) -> Any:
    clause = Nodes.IfClauseNode(pos, condition=test, body=body)
    return Nodes.IfStatNode(pos, if_clauses=[clause], else_clause=otherwise)


def variants(clean: Any) -> list[tuple[str, Any]]:
    """Return the changes of one expression, each with its text; what is below it stays."""
    made: list[tuple[str, Any]] = []
    pos = clean.pos
    if isinstance(clean, ExprNodes.PrimaryCmpNode):
        depth, link = 0, clean
        while link is not None:
            for operator in COMPARED.get(link.operator, ()):
                other = part = clone(clean)
                for _ in range(depth):
                    part = part.cascade
                part.operator = operator
                made.append(
                    (f"{link.operator} -> {operator}{f' (link {depth + 1})' if depth else ''}", other)
                )
            link, depth = link.cascade, depth + 1
    elif isinstance(clean, ExprNodes.BoolBinopNode):
        operator = {"and": "or", "or": "and"}[clean.operator]
        other = clone(clean)
        other.operator = operator
        made.append((f"{clean.operator} -> {operator}", other))
    elif isinstance(clean, ExprNodes.NotNode):
        made.append(("not left out", ExprNodes.NotNode(pos, operand=clone(clean))))
    elif isinstance(clean, ExprNodes.UnaryMinusNode):
        made.append(("minus left out", clone(clean.operand)))
    elif isinstance(clean, ExprNodes.BinopNode) and clean.operator in EXCHANGED:
        operator = EXCHANGED[clean.operator]
        parts = clone(clean.operand1), clone(clean.operand2)
        made.append((f"{clean.operator} -> {operator}", ExprNodes.binop_node(pos, operator, *parts)))
    elif isinstance(clean, ExprNodes.SimpleCallNode) and isinstance(clean.function, ExprNodes.NameNode):
        called = str(clean.function.name)
        if called in FUNCTIONS:
            other = clone(clean)
            other.function = name(FUNCTIONS[called], pos)
            made.append((f"{called} -> {FUNCTIONS[called]}", other))
        elif called in DROPPED:
            made.append((f"{called} left out", clone(clean.args[0])))
        elif called in ("isnan", "isfinite"):
            made.append((f"not {called}", ExprNodes.NotNode(pos, operand=clone(clean))))
    elif isinstance(clean, ExprNodes.BoolNode):
        made.append((f"{clean.value} -> {not clean.value}", ExprNodes.BoolNode(pos, value=not clean.value)))
    elif isinstance(clean, ExprNodes.IntNode):
        value = int(clean.value.rstrip("uUlL"), 0)
        made.append((f"{value} -> {value + 1}", integer(value + 1, pos)))
    elif isinstance(clean, ExprNodes.FloatNode):
        number = float(clean.value.replace("_", ""))
        text = repr(2.0 * number or 1.0)
        made.append((f"{clean.value} -> {text}", ExprNodes.FloatNode(pos, value=text)))
    return made


def install(rooms: dict[str, int], tables: Path) -> None:
    """From now on Cython adds mutants to the modules of `rooms` (name -> first number), and writes a table of each."""
    original: Callable[..., Any] = Pipeline.parse_stage_factory

    def factory(context: Any) -> Callable[[Any], Any]:
        parse = original(context)

        def stage(source: Any) -> Any:
            tree = parse(source)
            module = str(source.full_module_name)
            if module in rooms:
                mutator = Mutator(rooms[module])
                tree.body = mutator.walk(tree.body)
                uses = {key: sorted(names) for key, names in mutator.uses.items()}
                text = json.dumps({"mutants": mutator.table, "uses": uses})
                (tables / f"{module}.json").write_text(text)
            return tree

        return stage

    Pipeline.parse_stage_factory = factory
