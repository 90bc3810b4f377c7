"""Runs a module on a computer whose wall clock is wrong.

    python -m swarmtrack.lab.swarm.skewed_clock SECONDS MODULE [ARGUMENT …]

The wall clock of a whole machine cannot be set for one process. So `time.time` is shifted, which is all that our
programs read, and the module is run as `python -m MODULE` would; nothing in it knows.
"""

from __future__ import annotations

import runpy
import sys
import time


def main() -> None:
    seconds, module, *arguments = sys.argv[1:]
    shift, true_time = float(seconds), time.time
    time.time = lambda: true_time() + shift
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
