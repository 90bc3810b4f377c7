"""The syntax of the project's own modules: parsed once by all tests of a process that read it."""

import ast
import functools
from pathlib import Path


@functools.cache
def tree(path: Path) -> ast.Module:
    """Of a module."""
    return ast.parse(path.read_text(encoding="utf-8"))
