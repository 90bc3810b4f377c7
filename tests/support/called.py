"""How a console script ends, called within this process: what a process of its own for each mistake would cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import pytest


class Ended(NamedTuple):
    code: int | str | None
    out: str
    err: str


def called(main: Callable[[list[str]], int], words: list[str], capsys: pytest.CaptureFixture[str]) -> Ended:
    try:
        code: int | str | None = main(words)
    except SystemExit as end:
        code = end.code
    out, err = capsys.readouterr()
    return Ended(code, out, err)
