"""`swarmtrack review DIR…`: what was wrong in a recorded flight of a team, and all of it on one page."""

from __future__ import annotations

import argparse
import json
import sys
import webbrowser
from pathlib import Path

from swarmtrack.arguments import add_file, add_flag
from swarmtrack.errors import RecordingError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(
        parser,
        "paths",
        "recordings of one flight, or folders of several, such as sim --record writes",
        metavar="FILE|DIR",
        nargs="+",
    )
    add_file(parser, "--out", "the page (default: NAME.html in the current folder)")
    add_flag(parser, "--force", "replace a page that already exists")
    add_flag(parser, "--open", "open the page in this machine's browser")
    add_flag(parser, "--json", "print the findings as JSON")


def run(args: argparse.Namespace) -> int:
    from swarmtrack.review.checks import review
    from swarmtrack.review.html import as_records, headline, render, subject
    from swarmtrack.review.read import read_flight

    out: Path = args.out or Path(f"{args.paths[0].resolve().stem}.html")
    if out.exists() and not args.force:
        raise RecordingError(
            f"--out {out}: already exists, expected the name of a new file, or --force to replace it"
        )
    flight = read_flight(args.paths, _progress if sys.stderr.isatty() else None)
    lines = review(flight)
    try:
        out.write_text(render(flight, lines), encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"--out {out}: {error.strerror}, expected a file that can be written") from error
    if args.json:
        print(json.dumps(as_records(lines), indent=1, ensure_ascii=False))
    else:
        print(headline(flight, lines))
        for line in lines[:5]:
            finding = line.first.finding
            print(f"  {finding.level:8} {subject(line)}: {finding.found} -> {finding.remedy}")
        print(f"{out}: {len(lines)} lines, {out.stat().st_size / 1e6:.1f} MB")
    if args.open:
        webbrowser.open(out.resolve().as_uri())
    return 0


def _progress(name: str, number: int, of: int) -> None:
    print(f"swarmtrack review: reading {number} of {of}: {name}", file=sys.stderr)
