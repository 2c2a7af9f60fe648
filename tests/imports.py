"""The package's modules and what each imports, read from the sources: imports inside functions count too."""

import ast
import pathlib

REPO = pathlib.Path(__file__).parents[1]


def modules() -> dict:
    """Name -> file of every module of biotac_mj."""
    out = {}
    for path in sorted((REPO / "biotac_mj").rglob("*.py")):
        parts = path.relative_to(REPO).with_suffix("").parts
        out[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return out


def imports(known: dict) -> dict:
    """Module -> modules of the package that it imports by name."""
    return {name: _imported(name, path, known) for name, path in known.items()}


def _imported(name, path, known):
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    out = set()
    tree = ast.parse(path.read_text())
    if path.name == "__init__.py":  # what a package loads late is named there for editors, and is above it
        tree.body = [
            node
            for node in tree.body
            if not isinstance(node, ast.If) or "TYPE_CHECKING" not in ast.unparse(node.test)
        ]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            out |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            out |= {f"{base}.{a.name}" if f"{base}.{a.name}" in known else base for a in node.names}
    return (out & set(known)) - {name}


def circles(graph: dict) -> list:
    """Sets of modules that import each other, each sorted: the strongly connected components (Tarjan)."""
    number, low, stack, out = {}, {}, [], []

    def visit(name):
        number[name] = low[name] = len(number)
        stack.append(name)
        for other in sorted(graph[name]):
            if other not in number:
                visit(other)
            if other in stack:
                low[name] = min(low[name], low[other])
        if low[name] == number[name]:
            component = [stack.pop()]
            while component[-1] != name:
                component.append(stack.pop())
            if len(component) > 1:
                out.append(sorted(component))

    for name in graph:
        if name not in number:
            visit(name)
    return out
