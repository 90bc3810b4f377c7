"""`swarmtrack config new`: from a few answers to a commented config of a drone and of its team."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from swarmtrack.errors import ConfigError, SwarmtrackError
from swarmtrack.setup import answers, example
from swarmtrack.setup.texts import (
    DronePlan,
    TeamPlan,
    calibrated_lens,
    drone_text,
    guessed_lens,
    team_text,
)

USB_CAMERA = "v4l2:///dev/video0?width={width}&height={height}&fps=30"
SMALL_PICTURE = "640x480"
WEBCAM_DEG = "70"  # of the lens, from left to right
ANSWERED = (
    "id", "team", "camera", "size", "calibration", "fov", "autopilot", "start", "origin", "peer", "keys", "insecure",
)  # fmt: skip
OF_THE_TEAM = ("peer", "keys", "insecure", "origin")  # flags that say what stands in team.toml

_T = TypeVar("_T")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Write drone-ID.toml, and team.toml where there is none. On a terminal, it prompts for "
        "missing options."
    )
    tell = parser.add_argument
    kinds = ", ".join(answers.WIRINGS)
    tell("--id", metavar="N", help="the drone's ID, 1 … 65535, unique in the team")
    tell("--team", metavar="NAME", help="the team's name (default: that of team.toml, or swarm)")
    tell("--camera", metavar="SOURCE", help="usb, or an address: v4l2:///dev/video2, rtsp://… (default: usb)")
    tell(
        "--size",
        metavar="WxH",
        help=f"size of the images, if there is no calibration (default: {SMALL_PICTURE})",
    )
    tell(
        "--calibration",
        metavar="FILE",
        help="file of Kalibr, ROS, OpenCV or another tool; copied to DIR",
    )
    tell("--fov", metavar="DEG", help="horizontal field of view, if there is no calibration")
    tell("--autopilot", metavar="KIND", help=f"{kinds}, or a link's address (default: px4-uart)")
    tell("--start", nargs="+", metavar="S", help="NORTH EAST DOWN YAW in m and degrees; or gps, or local")
    tell(
        "--origin",
        nargs=3,
        type=float,
        metavar=("LAT", "LON", "ALT"),
        help="the team's origin, for --start gps",
    )
    tell("--peer", action="append", metavar="ID=HOST", help="one per drone of the team, including this one")
    tell("--keys", metavar="DIR", help="folder of keys; {id} stands for drone.id")
    tell("--insecure", action="store_true", help="connect beyond this machine without keys")
    tell(
        "--out",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="folder for the files (default: the current one)",
    )
    tell("--force", action="store_true", help="overwrite existing files")
    tell(
        "--example",
        action="store_true",
        help=f"write {example.NAME} instead: every key, explained; no prompts",
    )


def write_example(args: argparse.Namespace) -> None:
    """Raises ConfigError."""
    file = args.out / example.NAME
    given = [flag for flag in ANSWERED if getattr(args, flag)]
    if given:
        raise ConfigError(
            [f"--{given[0]}: given with --example, which asks nothing: expected --out and --force"]
        )
    if file.exists() and not args.force:
        raise ConfigError([f"{file}: already exists, expected another --out or --force"])
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        file.write_text(example.example(), encoding="utf-8")
    except OSError as error:
        raise ConfigError([f"--out: {args.out}: {error.strerror}, expected a folder for the file"]) from error
    print(f"written: {file}")
    print(f"next: change it, then swarmtrack config check {file}")


def create(args: argparse.Namespace) -> None:
    """Ask, write, check; what does not pass the check is taken away again. Raises SwarmtrackError."""
    from swarmtrack.runtime.check import check

    questions = Questions(args, person=sys.stdin.isatty() and sys.stdout.isatty())
    drone_id = questions.answer("id", "ID of the drone, 1 … 65535", None, answers.drone_id)
    team_file, drone_file = args.out / "team.toml", args.out / f"drone-{drone_id}.toml"
    if drone_file.exists() and not args.force:
        raise ConfigError([f"{drone_file}: already exists, expected another --id, --out or --force"])
    new_team = args.force or not team_file.exists()
    team = _new_team(args, questions) if new_team else _team_of(team_file, args)
    files, plan = _drone(args, questions, drone_id, team.name)
    try:
        files[drone_file] = drone_text(plan).encode()
        if new_team:
            files[team_file] = team_text(team).encode()
    except UnicodeEncodeError as error:  # a byte of an answer that is no character
        answer = error.object[max(error.start - 20, 0) : error.end].splitlines()[-1]
        raise ConfigError([f"found {answer!r}, expected text"]) from None
    before = {path: path.read_bytes() if path.exists() else None for path in files}
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        for path, content in files.items():
            path.write_bytes(content)
        check(drone_file)
    except OSError as error:
        _restore(before)
        raise ConfigError(
            [f"--out: {args.out}: {error.strerror}, expected a folder for the files"]
        ) from error
    except SwarmtrackError as error:
        _restore(before)
        raise ConfigError([f"nothing was written, because it would not work:\n{error}"]) from error
    kept = "" if new_team else f" ({team_file} is as it was)"
    print(f"written: {', '.join(map(str, files))}{kept}")
    if plan.guessed:
        print(
            "the lens is guessed: `swarmtrack calibrate intrinsics` measures it, which makes names more certain"
        )
    print(f"next: swarmtrack doctor --config {drone_file}")


def _restore(before: dict[Path, bytes | None]) -> None:
    for path, content in before.items():
        if content is None:
            path.unlink(missing_ok=True)
        else:
            path.write_bytes(content)


class Questions:
    """Answers from flags; for the rest a question where there is a person, else the default."""

    def __init__(self, args: argparse.Namespace, *, person: bool) -> None:
        self._args = args
        self._person = person

    def answer(self, flag: str, question: str, default: str | None, read: Callable[[str], _T]) -> _T:
        """read: makes a value of the answer, or raises ValueError or SwarmtrackError with a sentence."""
        given = getattr(self._args, flag)
        if given is None and not self._person:
            given = default
            if given is None:
                raise ConfigError([f"--{flag}: missing, expected the {question}"])
        if given is not None:
            try:
                return read(" ".join(given) if isinstance(given, list) else given)
            except (ValueError, SwarmtrackError) as error:
                raise ConfigError([f"--{flag}: {error}"]) from error
        while True:
            try:
                said = input(f"{question}{f' [{default}]' if default else ''}: ").strip() or default
            except EOFError:
                raise ConfigError([f"--{flag}: no answer, expected one or the flag"]) from None
            except UnicodeDecodeError:
                print("  not in this terminal's encoding")
                continue
            try:
                if said is not None:
                    return read(said)
            except (ValueError, SwarmtrackError) as error:
                print(f"  {error}")


# ── what is asked ────────────────────────────────────────────────────────────────────────────────────────────────────


def _new_team(args: argparse.Namespace, questions: Questions) -> TeamPlan:
    name = questions.answer("team", "name of the team", "swarm", str)
    try:
        peers = dict(map(answers.peer, args.peer or ()))
    except ValueError as error:
        raise ConfigError([f"--peer: {error}"]) from error
    return TeamPlan(name, args.origin, peers, args.keys, args.insecure)


def _team_of(file: Path, args: argparse.Namespace) -> TeamPlan:
    """A file of the team that is there stays as it is, and must be of the team that is told."""
    from swarmtrack.config.drone import load_team_config

    name = load_team_config(file).network.team
    if args.team not in (None, name):
        raise ConfigError([f"--team: {args.team}, expected {name} as in {file}, or --force"])
    for flag in OF_THE_TEAM:
        if getattr(args, flag):
            raise ConfigError([f"--{flag}: {file} already exists, expected that to be edited, or --force"])
    return TeamPlan(name)


def _drone(
    args: argparse.Namespace, questions: Questions, drone_id: int, team: str
) -> tuple[dict[Path, bytes], DronePlan]:
    """Files that go beside its config, and what the config says."""
    camera = questions.answer("camera", "camera: usb, or an address", "usb", answers.camera)
    files: dict[Path, bytes] = {}
    lens: list[str] = []
    size = (0, 0)
    guessed = False
    if not camera.startswith("sim:"):
        calibration = None
        if args.calibration or not args.fov:
            calibration = questions.answer(
                "calibration", "calibration file; - for none yet", "-", answers.calibration
            )
        if calibration is not None:
            files = _copy(calibration.file, args)
            size, lens = calibration.size, calibrated_lens(calibration.file.name)
        else:
            guessed = True
            size = questions.answer("size", "size of the images", SMALL_PICTURE, answers.size)
            angle = questions.answer(
                "fov", "angle of the lens from left to right, degrees", WEBCAM_DEG, answers.angle
            )
            lens = guessed_lens(size, angle)
    kinds = f"autopilot: {', '.join(answers.WIRINGS)}, or an address"
    wiring = questions.answer("autopilot", kinds, "px4-uart", answers.wiring)
    where = "start: NORTH EAST DOWN YAW in m and degrees, or gps, or local"
    return files, DronePlan(
        drone_id=drone_id,
        team=team,
        camera=USB_CAMERA.format(width=size[0], height=size[1]) if camera == "usb" else camera,
        lens=lens,
        guessed=guessed,
        link=wiring.link,
        notes=wiring.notes,
        start=questions.answer("start", where, "0 0 0 0", answers.start),
    )


def _copy(calibration: Path, args: argparse.Namespace) -> dict[Path, bytes]:
    """The calibration for the config's own folder, which can then be carried to the drone as it is."""
    copy, content = args.out / calibration.name, calibration.read_bytes()
    if copy.exists() and copy.read_bytes() == content:
        return {}
    if copy.exists() and not args.force:
        raise ConfigError([f"{copy}: already exists and another one, expected another name, or --force"])
    return {copy: content}
