"""`swarmtrack config new`: from a few answers to a commented config of a drone and of its team."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, TypeVar

from swarmtrack.config.drone import load_config
from swarmtrack.errors import ConfigError, SwarmtrackError
from swarmtrack.setup import answers, example
from swarmtrack.setup.answers import StartPlan, Wiring
from swarmtrack.setup.sibling import Sibling, newest_sibling
from swarmtrack.setup.team_check import contradictions
from swarmtrack.setup.texts import (
    NO_MOUNT,
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
    "id", "ids", "grid", "team", "camera", "size", "calibration", "fov", "autopilot", "start", "origin", "peer", "keys",
    "insecure",
)  # fmt: skip
OF_THE_TEAM = ("peer", "keys", "insecure", "origin")  # flags that say what stands in team.toml

_T = TypeVar("_T")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Write drone-ID.toml, and team.toml where there is none. Camera, lens and autopilot are those of the newest "
        "config in DIR, unless options say otherwise. On a terminal, it prompts for missing options."
    )
    tell = parser.add_argument
    kinds = ", ".join(answers.WIRINGS)
    tell("--id", metavar="N", help="the drone's ID, 1 … 65535, unique in the team")
    tell("--ids", metavar="A-B", help="the IDs of several drones, such as 11-15 or 11,13: a file for each")
    tell("--grid", metavar="M", help="with --ids: they stand M metres apart, the first at --start")
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
    questions = Questions(args, person=sys.stdin.isatty() and sys.stdout.isatty())
    ids = _ids(args, questions)
    team_file, drone_files = args.out / "team.toml", [args.out / f"drone-{number}.toml" for number in ids]
    for file in drone_files:
        if file.exists() and not args.force:
            raise ConfigError([f"{file}: already exists, expected another --id, --out or --force"])
    new_team = args.force or not team_file.exists()
    team = _new_team(args, questions) if new_team else _team_of(team_file, args)
    sibling = newest_sibling(args.out, drone_files)
    eye = _eye(args, questions, sibling)
    shared_link = sibling.wiring if sibling is not None and args.autopilot is None else None
    wiring = shared_link or _wiring(questions)
    files = dict(eye.files)
    try:
        for number, file, start in zip(ids, drone_files, _starts(args, questions, len(ids)), strict=True):
            plan = DronePlan(
                drone_id=number,
                team=team.name,
                camera=eye.source,
                lens=eye.lens,
                mount=eye.mount,
                link=wiring.link,
                notes=wiring.notes,
                start=start.value,
            )
            files[file] = drone_text(plan).encode()
        if new_team:
            files[team_file] = team_text(team).encode()
    except UnicodeEncodeError as error:  # a byte of an answer that is no character
        answer = error.object[max(error.start - 20, 0) : error.end].splitlines()[-1]
        raise ConfigError([f"found {answer!r}, expected text"]) from None
    _write(args.out, files, drone_files)
    kept = "" if new_team else f" ({team_file} is as it was)"
    print(f"written: {', '.join(map(str, files))}{kept}")
    alike = ["camera, lens"] * eye.from_sibling + ["autopilot"] * (shared_link is not None)
    if sibling is not None and alike:
        print(
            f"{' and '.join(alike)} as in {sibling.file}: --camera, --fov, --calibration and --autopilot change them"
        )
    if eye.angle_deg is not None:
        where = "" if args.fov or eye.from_sibling else " (no --fov given)"
        print(
            f"the lens is guessed: {eye.angle_deg:.3g}°{where}; `swarmtrack calibrate intrinsics` measures it, which "
            "makes names more certain"
        )
    print(f"next: swarmtrack doctor --config {drone_files[0]}")


def _write(folder: Path, files: dict[Path, bytes], drone_files: Sequence[Path]) -> None:
    """Write and check them; or leave all as it was, and raise ConfigError."""
    before = {path: path.read_bytes() if path.exists() else None for path in files}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, content in files.items():
            path.write_bytes(content)
        _check(drone_files)
    except OSError as error:
        _restore(before)
        raise ConfigError([f"--out: {folder}: {error.strerror}, expected a folder for the files"]) from error
    except SwarmtrackError as error:
        _restore(before)
        raise ConfigError([f"nothing was written, because it would not work:\n{error}"]) from error


def _check(files: Sequence[Path]) -> None:
    """Each by itself, which prints what differs from those before, and all together. Raises SwarmtrackError."""
    from swarmtrack.runtime.check import check

    printed: set[str] = set()
    for file in files:
        with redirect_stdout(io.StringIO()) as out:
            check(file)
        lines = [line for line in out.getvalue().splitlines() if line not in printed]
        print(*lines, sep="\n")
        printed.update(lines)
    problems = contradictions([load_config(file) for file in files])
    if problems:
        raise ConfigError(problems)


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


def _ids(args: argparse.Namespace, questions: Questions) -> list[int]:
    if args.ids and args.id:
        raise ConfigError(["--ids: given with --id, expected one of them"])
    if args.grid and not args.ids:
        raise ConfigError(["--grid: given without --ids, expected the IDs of the drones in the grid"])
    if args.ids:
        return questions.answer("ids", "IDs of the drones, such as 11-15", None, answers.drone_ids)
    return [questions.answer("id", "ID of the drone, 1 … 65535", None, answers.drone_id)]


class Eye(NamedTuple):
    """A camera as the config states it. files: that the config names; mount: value of body_from_camera; angle_deg:
    of a guessed lens."""

    source: str
    lens: list[str]
    mount: str = NO_MOUNT
    angle_deg: float | None = None
    files: Mapping[Path, bytes] = MappingProxyType({})
    from_sibling: bool = False


def _eye(args: argparse.Namespace, questions: Questions, sibling: Sibling | None) -> Eye:
    """A drone's camera is as its siblings', as far as no flag says otherwise."""
    mount = NO_MOUNT
    if sibling is not None and args.camera in (None, sibling.source):
        mount = sibling.mount
        if not (args.size or args.calibration or args.fov):
            lens = sibling.lens
            return Eye(sibling.source, lens.lines, mount, lens.angle_deg, from_sibling=True)
        camera = "usb" if sibling.source == _usb(sibling.lens.size) else sibling.source
    else:
        camera = questions.answer("camera", "camera: usb, or an address", "usb", answers.camera)
    if camera.startswith("sim:"):
        return Eye(camera, [])
    calibration = None
    if args.calibration or not args.fov:
        calibration = questions.answer(
            "calibration", "calibration file; - for none yet", "-", answers.calibration
        )
    if calibration is not None:
        files, size, angle = _copy(calibration.file, args), calibration.size, None
        lines = calibrated_lens(calibration.file.name)
    else:
        size = questions.answer("size", "size of the images", SMALL_PICTURE, answers.size)
        angle = questions.answer(
            "fov", "angle of the lens from left to right, degrees", WEBCAM_DEG, answers.angle
        )
        files, lines = {}, guessed_lens(size, angle)
    return Eye(_usb(size) if camera == "usb" else camera, lines, mount, angle, files)


def _usb(size: tuple[int, int]) -> str:
    return USB_CAMERA.format(width=size[0], height=size[1])


def _wiring(questions: Questions) -> Wiring:
    kinds = f"autopilot: {', '.join(answers.WIRINGS)}, or an address"
    return questions.answer("autopilot", kinds, "px4-uart", answers.wiring)


def _starts(args: argparse.Namespace, questions: Questions, drones: int) -> list[StartPlan]:
    """Each drone's; several measured ones stand in a grid."""
    where = "start: NORTH EAST DOWN YAW in m and degrees, or gps, or local"
    first = questions.answer("start", where, "0 0 0 0", answers.start)
    if first.stated:
        if args.grid:
            raise ConfigError([f"--grid: given with --start {args.start[0]}, which needs none"])
        return [first] * drones
    if drones == 1:
        return [first]
    between = "distance in metres between drones on the ground"
    return first.grid(drones, questions.answer("grid", between, None, answers.spacing))


def _copy(calibration: Path, args: argparse.Namespace) -> dict[Path, bytes]:
    """The calibration for the config's own folder, which can then be carried to the drone as it is."""
    copy, content = args.out / calibration.name, calibration.read_bytes()
    if copy.exists() and copy.read_bytes() == content:
        return {}
    if copy.exists() and not args.force:
        raise ConfigError([f"{copy}: already exists and another one, expected another name, or --force"])
    return {copy: content}
