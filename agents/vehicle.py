"""`swarmtrack-agent`: the agent of one drone."""

from __future__ import annotations

import argparse
import asyncio
import gc
import logging
import os
import shlex
import signal
import sys
import threading
from pathlib import Path

from swarmtrack import __version__
from swarmtrack.arguments import add_file, add_flag, add_seconds
from swarmtrack.ending import end_at_once_if_stuck, print_in_any_encoding, reader_may_leave
from swarmtrack.errors import ConfigError, SwarmtrackError, TransportError, ungrouped
from swarmtrack.log_lines import AGENT_FORMAT, log_to_stderr

DONE, FAILED, WRONG_USAGE = 0, 1, 2
# s, for the interpreter's own end: together with CLOSE_TIMEOUT below the 2 s that a supervisor is promised
LAST_WORD = 0.3
# systemd has started us.
_IS_SERVICE = "INVOCATION_ID" in os.environ


def main(argv: list[str] | None = None) -> int:
    """The console script. Exit codes: 0 done, 2 wrong usage or config, 1 anything else."""
    # Before NumPy is imported: for matrices of 4 x 4 its threads only cost, in time and in memory.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if argv is None and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # As a program: Ctrl-C while NumPy loads, seconds on a Pi, ends it without a traceback.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    code = DONE
    print_in_any_encoding()
    with reader_may_leave():
        code = _run(parser().parse_args(argv))
    return code


def _run(arguments: argparse.Namespace) -> int:
    log_to_stderr(logging.getLevelNamesMapping()[arguments.log.upper()], AGENT_FORMAT)
    try:
        return _check(arguments.config) if arguments.check else _fly(arguments)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return WRONG_USAGE
    except TransportError as error:  # the config is right; a port is taken, an interface not up yet
        print(f"{arguments.config}: {error}", file=sys.stderr)
        return FAILED
    except SwarmtrackError as error:
        print(f"{arguments.config}: {error}", file=sys.stderr)
        return WRONG_USAGE
    except KeyboardInterrupt:
        return DONE


def parser() -> argparse.ArgumentParser:
    """Of the program's command line."""
    parser = argparse.ArgumentParser(
        prog="swarmtrack-agent",
        description="Track the drones in this drone's camera, and identify teammates.",
        epilog="a first look, without any hardware:\n"
        f"  swarmtrack-agent --config {shlex.quote(shipped('sim.toml'))} --seconds 20",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_file(parser, "--config", "the drone's config, TOML", required=True)
    add_flag(parser, "--check", "validate the config and the files it refers to, then exit")
    add_seconds(parser, "--seconds", "stop after S seconds (default: never)")
    add_flag(parser, "--quiet", "print no status line per second, only the log (default under systemd)")
    parser.add_argument(
        "--log",
        default="warning",
        choices=["debug", "info", "warning", "error"],
        help="level of the log on stderr (default: warning)",
    )
    parser.add_argument("--version", action="version", version=f"swarmtrack {__version__}")
    return parser


def shipped(config: str) -> str:
    """The path of a config that comes with the program, in a checkout or installed, as short as can be typed here."""
    file = Path(__file__).parents[1] / "configs" / config
    return os.path.relpath(file) if file.is_relative_to(Path.cwd()) else str(file)


def _check(config: Path) -> int:
    from swarmtrack.runtime.check import check

    check(config)
    return DONE


def _fly(arguments: argparse.Namespace) -> int:
    gc.disable()  # while hundreds of modules load it finds nothing, at a tenth of the start's cost
    try:
        from swarmtrack.clock import SystemClock
        from swarmtrack.config.drone import load_config
        from swarmtrack.outputs.console import Console
        from swarmtrack.runtime.agent import Agent
        from swarmtrack.runtime.assembly import assemble

        parts = assemble(load_config(arguments.config), SystemClock())
    finally:
        gc.freeze()  # what is loaded by now stays for good: no collection need look at it again
        gc.enable()
    if parts.detector is not None:
        import cv2

        cv2.setNumThreads(1)  # its pool costs more than it gains on images of this size

    async def fly() -> None:
        agent = Agent(parts, console=Console(*parts.lenses, quiet=arguments.quiet or _IS_SERVICE))
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, agent.stop)
        if _IS_SERVICE:
            loop.add_signal_handler(signal.SIGHUP, agent.look_at_keys)
        elif signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            # The terminal has gone (ssh over a weak radio). Files are closed before the end; nohup keeps us flying.
            loop.add_signal_handler(signal.SIGHUP, agent.stop)
        await agent.run(arguments.seconds)
        agent.summarise()
        _end_soon()

    with ungrouped():  # a source that can never work says so only when it is opened
        asyncio.run(fly())
    return DONE


def _end_soon() -> None:
    """Everything is closed and written; a thread that hangs (a net, a name look-up) must not keep the process."""
    end_at_once_if_stuck(DONE)
    last_word = threading.Timer(LAST_WORD, os._exit, [DONE])
    last_word.daemon = True
    last_word.start()


if __name__ == "__main__":
    sys.exit(main())
