"""Compare this checkout with the golden set: `.venv/bin/python tests/golden [PART ...]`.

Parts: flights, wire, help, tables (all by default; tables take minutes). Exit code 1 where something moved.
`--accept` keeps what was computed now: a commit that does so says what moved, and why.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1])]

from support.golden import differences
from support.golden.parts import PARTS


def main() -> int:
    parser = argparse.ArgumentParser(prog="python tests/golden", description=__doc__.partition("\n")[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)} (default: all)")
    parser.add_argument("--accept", action="store_true", help="keep what is computed now")
    args = parser.parse_args()
    if unknown := set(args.parts) - set(PARTS):
        parser.error(f"found {', '.join(sorted(unknown))}, expected of {', '.join(PARTS)}")
    moved = 0
    for name in args.parts or PARTS:
        part = PARTS[name]
        if args.accept:
            part.save(part.compute())
            print(f"{name}: kept")
            continue
        found = differences(part)
        moved += len(found)
        print(f"{name}: {'the same bit for bit' if not found else f'{len(found)} moved'}")
        for each in found:
            print(f"  {each.name}: {each.how}{'' if each.beyond_rounding else ' (rounding)'}")
    return 1 if moved else 0


if __name__ == "__main__":
    sys.exit(main())
