"""Warp sets a variable for a constant where a kernel first casts it. If that is inside a branch and the
kernel names the constant again outside, the variable has no value whenever the branch was not taken:
compilers that optimise put the constant there, others do not."""

import ast
import inspect
import pathlib
import textwrap

import pytest

PACKAGE = pathlib.Path(__file__).resolve().parents[1] / "biotac_mj"


def misplaced(function: ast.FunctionDef) -> list[str]:
    """Constants, in capitals, that the function names outside the block that casts them first."""
    first, cast, wrong = {}, set(), []
    own = {node.arg for node in ast.walk(function) if isinstance(node, ast.arg)}
    own |= {n.id for n in ast.walk(function) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}

    def visit(node, block):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "wp.static":
            return
        if isinstance(node, ast.Call) and len(node.args) == 1 and isinstance(node.args[0], ast.Name):
            if ast.unparse(node.func) != "range" and node.args[0].id not in first:
                cast.add(node.args[0].id)
        if isinstance(node, ast.Name) and node.id.isupper() and node.id not in own:
            known = first.setdefault(node.id, block)
            if node.id in cast and block[: len(known)] != known:
                wrong.append(f"{function.name}: {node.id}, line {node.lineno}")
        for name, value in ast.iter_fields(node):
            for k, child in enumerate(value if isinstance(value, list) else [value]):
                inner = name in ("body", "orelse") and isinstance(node, (ast.If, ast.For, ast.While))
                inner |= name == "values" and k > 0  # what follows `and` and `or`
                if isinstance(child, ast.AST):
                    visit(child, (*block, (id(node), name)) if inner else block)

    for statement in function.body:
        visit(statement, ())
    return wrong


def kernel_functions(text: str) -> list[ast.FunctionDef]:
    return [
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef)
        and any(ast.unparse(mark).startswith(("wp.func", "wp.kernel")) for mark in node.decorator_list)
    ]


@pytest.mark.law
def test_a_constant_is_set_where_it_is_read():
    texts = (path.read_text() for path in PACKAGE.rglob("*.py"))
    functions = [function for text in texts if "@wp." in text for function in kernel_functions(text)]
    assert len(functions) > 500
    assert [found for function in functions for found in misplaced(function)] == []


def test_a_constant_that_a_branch_sets_is_found():
    def sample(x: float):
        if x > 0.0:
            x += float(LIMIT)  # noqa: F821
        return x * LIMIT  # noqa: F821

    function = ast.parse(textwrap.dedent(inspect.getsource(sample))).body[0]
    assert misplaced(function) == ["sample: LIMIT, line 4"]
