"""Ends what a launcher started and removes its folder, once the launcher is gone: also when that was killed.

    python -I -S reaper.py [FOLDER]

On standard input, a line each: `+PID`, the leader of a process group that was started, and `-PID`, one that has ended.
At its end, every group that is left is killed, and the folder removed. Imports nothing of ours, so that it is small
and soon there; it runs in a process group of its own, which Ctrl-C does not reach.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sys
import time

REAPER_ATTEMPTS = 50


def main() -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    started: set[int] = set()
    for line in sys.stdin:
        change, pid = line[0], int(line[1:])
        if change == "+":
            started.add(pid)
        else:
            started.discard(pid)
    for pid in started:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)
    for folder in sys.argv[1:]:
        # Those killed a moment ago may still write: again, until it is gone.
        for _ in range(REAPER_ATTEMPTS):
            shutil.rmtree(folder, ignore_errors=True)
            if not os.path.exists(folder):
                break
            time.sleep(0.1)


if __name__ == "__main__":
    main()
