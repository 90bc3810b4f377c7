"""What every benchmark leaves behind: NAME.json for programs, NAME.md for people, plots; and its line of progress.

Cells of a table are templates of what stands in its row, a dictionary or an object, as `str.format` has them:
"{runs}", "{rmse_px[p50]:.2f}". A number that is none is "–". `.1p` is percent, and `.1p%` with the sign; `.1m` is
thousandths; of an interval, with value, low and high, both ends follow in brackets. `?p` is percent with one decimal,
near none and near all with two.
"""

from __future__ import annotations

import json
import math
import os
import platform
import string
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from swarmtrack.arguments import require_extra
from swarmtrack.errors import SwarmtrackError

VERSIONS_OF = ("swarmtrack", "numpy", "scipy", "onnxruntime", "opencv-python-headless")


class BenchmarkError(SwarmtrackError):
    """A benchmark that cannot be run: a missing file, an agent that failed."""


@contextmanager
def progress(description: str, total: int) -> Iterator[Callable[[str], None]]:
    """A progress line on stderr; yields a function that advances it by one and says what comes next."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TextColumn("{task.fields[now]}"), console=Console(stderr=True)) as line:
        task = line.add_task(description, total=total, now="")

        def advance(now: str = "") -> None:
            line.update(task, advance=1, now=now)

        yield advance


def write(out: Path, name: str, result: dict[str, Any], markdown: str) -> None:
    """NAME.json (with the machine and the versions) and NAME.md in the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    document = {"benchmark": name, "machine": machine(), **_finite(result)}
    text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
    (out / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    (out / f"{name}.md").write_text(f"{markdown.rstrip()}\n\n{_machine_line()}\n", encoding="utf-8")


def table(header: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: bool = True) -> str:
    """A Markdown table, the first column to the left, numbers to the right."""
    lines = [header, ["---"] + ["---:" if numbers else "---"] * (len(header) - 1), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


Columns = Sequence[tuple[str, str | Callable[[Any], str]]]
"""Of a table: title, and a cell as a template, or as a function of the row."""


def table_of(columns: Columns, rows: Iterable[Any], *, numbers: bool = True) -> str:
    """A Markdown table of rows with these columns."""
    cells = [
        [filled(cell, row) if isinstance(cell, str) else cell(row) for _, cell in columns] for row in rows
    ]
    return table([title for title, _ in columns], cells, numbers=numbers)


def table_by_name(columns: Columns, rows: Mapping[str, Mapping[str, Any]]) -> str:
    """The same of rows by their names, which columns find as `name`."""
    return table_of(columns, [{"name": name, **row} for name, row in rows.items()])


def filled(template: str, row: Any) -> str:
    """See the module."""
    return _Filler(row).vformat(template, (), {})


class _Filler(string.Formatter):
    def __init__(self, row: Any) -> None:
        self._row = row

    def get_value(self, key: int | str, args: Any, kwargs: Any) -> Any:
        return self._row[key] if isinstance(self._row, Mapping) else getattr(self._row, str(key))

    def format_field(self, value: Any, spec: str) -> str:
        sign = " %" if spec.endswith("p%") else ""
        spec = spec.removesuffix("%") if sign else spec
        if isinstance(value, Mapping) and spec == "?p":
            if math.isnan(value["value"]):
                return "–"
            spec = ".2p" if value["high"] < 0.1 or value["low"] > 0.9 else ".1p"
        if isinstance(value, Mapping) and spec:
            middle, low, high = (self.format_field(value[name], spec) for name in ("value", "low", "high"))
            return f"{middle}{sign} ({low} … {high})"
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            return "–"
        # Percent, and thousandths.
        times = {"p": 100.0, "m": 1e3}.get(spec[-1:])
        return f"{times * value:{spec[:-1]}f}{sign}" if times else format(value, spec)


def number(value: float, digits: int = 2) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "–"


def verdict(ok: bool) -> str:
    return "holds" if ok else "**fails**"


def page(*parts: str) -> str:
    """Its paragraphs, tables and headings."""
    return "\n\n".join(part for part in parts if part)


def machine() -> dict[str, Any]:
    """Where the figures come from."""
    return {
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "load_1min": round(os.getloadavg()[0], 2),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {package: found for package in VERSIONS_OF if (found := _version(package))},
    }


def pyplot() -> Any:
    """matplotlib, drawing into files."""
    require_extra("bench", "matplotlib", of="a plot")
    import matplotlib  # noqa: PLC0415  # only who draws needs it: an extra

    matplotlib.use("Agg")
    from matplotlib import pyplot  # noqa: PLC0415

    return pyplot


def save(figure: Any, path: Path, dpi: int = 130) -> None:
    """A plot that is drawn."""
    figure.savefig(path, dpi=dpi)
    pyplot().close(figure)


def _machine_line() -> str:
    facts = machine()
    versions = ", ".join(f"{name} {found}" for name, found in facts["versions"].items())
    return f"{facts['cpu']}, {facts['cores']} cores, load {facts['load_1min']}; Python {facts['python']}, {versions}."


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    names = [line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model"))]
    return names[0] if names else "unknown"


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None  # from a checkout, not installed


def _finite(value: Any) -> Any:
    """NaN and infinity as null: JSON has no other word for them."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
