"""Public functions say what their parameters are: shapes, units, what is raised."""

import ast
from collections.abc import Iterator

import pytest
from helpers.paths import PACKAGE

MIN_DOCUMENTED = 0.9
# Experiments of the paper are read from top to bottom; their functions have the same parameters everywhere.
PACKAGES = sorted(
    path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists() and path.name != "paper"
)
Function = ast.FunctionDef | ast.AsyncFunctionDef


def public_functions(node: ast.AST) -> Iterator[tuple[Function, str]]:
    """Yield public functions and methods outside functions, with the docstring of their class."""
    for inner in ast.iter_child_nodes(node):
        if isinstance(inner, ast.ClassDef) and not inner.name.startswith("_"):
            yield from public_functions(inner)
        elif isinstance(inner, Function) and not inner.name.startswith("_"):
            yield inner, ast.get_docstring(inner) or ""


def parameters(function: Function) -> list[str]:
    given = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    return [one.arg for one in given if one.arg not in ("self", "cls")]


def is_override(name: str, docstring: str, documented: set[str]) -> bool:
    """Whether the base class documents the parameters: the docstring points there, or there is none."""
    return docstring.startswith("See `") or (not docstring and name in documented)


def is_command(function: Function) -> bool:
    """Whether it is a command of the shell, whose options carry their own help."""
    return any("command" in ast.unparse(decorator) for decorator in function.decorator_list)


def documents_parameters(function: Function, docstring: str) -> bool:
    """Whether a Parameters section names all, or the text names every parameter in backticks."""
    names = parameters(function)
    section = docstring.partition("Parameters\n")[2]
    listed = {name.strip() for line in section.splitlines() for name in line.split(":")[0].split(",")}
    return all(name in listed or f"`{name}`" in docstring for name in names)


def asked(package: str) -> list[tuple[str, bool]]:
    """Names of the functions with two or more parameters, and whether they document them."""
    paths = sorted((PACKAGE / package).rglob("*.py"))
    functions = [(path, *one) for path in paths for one in public_functions(ast.parse(path.read_text()))]
    documented = {function.name for _, function, docstring in functions if docstring}
    found = []
    for path, function, docstring in functions:
        override = is_override(function.name, docstring, documented)
        if len(parameters(function)) >= 2 and not (override or is_command(function)):
            name = f"{path.relative_to(PACKAGE)}:{function.lineno} {function.name}"
            found.append((name, documents_parameters(function, docstring)))
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_nine_in_ten_public_functions_document_their_parameters(package):
    functions = asked(package)
    missing = [name for name, documented in functions if not documented]
    assert len(missing) <= (1 - MIN_DOCUMENTED) * len(functions), "\n".join(missing)


@pytest.mark.parametrize("package", [*PACKAGES, "paper"])
def test_every_public_function_or_what_it_overrides_has_a_docstring(package):
    paths = sorted((PACKAGE / package).rglob("*.py"))
    functions = [one for path in paths for one in public_functions(ast.parse(path.read_text()))]
    documented = {function.name for function, docstring in functions if docstring}
    assert {function.name for function, docstring in functions} - documented == set()


def test_the_check_distinguishes_documented_from_undocumented():
    source = '''
def good(a_nm, b):
    """Add.

    Parameters
    ----------
    a_nm, b : float
    """

def named(a, b):
    """Add `a` to `b`."""

def poor(a, b):
    """Add."""
'''
    found = {f.name: documents_parameters(f, doc) for f, doc in public_functions(ast.parse(source))}
    assert found == {"good": True, "named": True, "poor": False}
