"""The first hour of somebody who has just installed swarmtrack, in an empty folder, with no hardware.

It runs the installed program where there is one, as CI does, else this checkout. No command may show a traceback, name
a page or file that is not there, or promise a next step that does not work.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import secrets
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.request import urlopen

import cv2
import numpy as np
import pytest

from support.clips import shorten
from support.patience import PATIENCE
from support.places import DOCS, ROOT, SHARED

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

CLIP = SHARED / "drones_real" / "clips_more" / "V_DRONE_002.mp4"
FLOWN = {0, 1, 3}  # a busy machine may fail a flight
NOT_HERE = r"(?!\s+in\s+swarmtrack's\s+source)"
PLACES = re.compile(rf"(?<![\w/.])(?:/[\w./-]*)?(?:docs|configs|examples)/[\w/-]++(?:\.[\w/-]++)*+{NOT_HERE}")


class Stranger:
    """Types commands into a shell in a folder, and reads all that they say."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = {
            name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PYTEST"))
        }
        self.environment |= {"TMPDIR": str(folder), "COLUMNS": "80"}
        where = [sys.executable, "-c", "import swarmtrack.agents.main"]
        found = subprocess.run(where, check=False, cwd=folder, env=self.environment, capture_output=True)
        if found.returncode != 0:
            self.environment["PYTHONPATH"] = str(ROOT)

    def start(self, command: str) -> subprocess.Popen[str]:
        program, *words = shlex.split(command)
        ways = {
            "swarmtrack": ["-m", "swarmtrack.agents.main"],
            "swarmtrack-agent": ["-m", "swarmtrack.agents.vehicle"],
            "python": [],
        }
        return subprocess.Popen(
            [sys.executable, *ways[program], *words],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, cwd=self.folder, env=self.environment,
        )  # fmt: skip

    def types(self, command: str, *codes: int) -> str:
        """Everything that a command says; codes: with which it may end, 0 unless told."""
        return self.reads(command, self.start(command), *codes)

    def reads(self, command: str, process: subprocess.Popen[str], *codes: int, before: str = "") -> str:
        out, err = process.communicate(timeout=PATIENCE)
        said = before + out + err
        assert process.returncode in (codes or (0,)), f"{command}: {process.returncode}\n{said}"
        self.believes(command, said)
        return said

    def believes(self, command: str, said: str) -> None:
        for sign in ("Traceback (most recent", "Error: <", "\x1b"):
            assert sign not in said, f"{command}: {said}"
        # Help is wrapped, also within a path.
        for text in (said, re.sub(r"\n +", " ", said)):
            missing = [place for place in PLACES.findall(text) if not (self.folder / place).exists()]
            if not missing:
                return
        raise AssertionError(f"{command}: there is no {missing}\n{said}")


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Stranger:
    return Stranger(tmp_path_factory.mktemp("hour"))


def actions_of(text: str) -> Iterator[str]:
    """The actions that the help of a command lists."""
    listed = text.partition("positional arguments:\n")[2].partition("\n\n")[0]
    yield from re.findall(r"^    ([\w-]+)(?: |$)", listed, re.MULTILINE)


@pytest.mark.parametrize(
    "actions",
    [
        pytest.param(
            False,
            id="commands",
            marks=pytest.mark.long("twenty processes; the default run compares the golden help texts"),
        ),
        pytest.param(
            True, id="actions", marks=pytest.mark.long("forty processes more: the help of each action")
        ),
    ],
)
def test_help_of_every_command_and_action(stranger: Stranger, actions: bool) -> None:
    overview = stranger.types("swarmtrack --help")
    commands = re.findall(r"^  ([a-z]+) {2,}[a-z]", overview.partition("options:")[0], re.MULTILINE)
    assert len(commands) > 15
    with ThreadPoolExecutor(2) as pool:
        helps = list(pool.map(lambda name: stranger.types(f"swarmtrack {name} --help"), commands))
        deeper = [
            f"swarmtrack {name} {action} --help"
            for name, text in zip(commands, helps, strict=True)
            if name != "bench"
            for action in actions_of(text)
        ]
        assert "swarmtrack config check --help" in deeper
        list(pool.map(stranger.types, deeper if actions else ["swarmtrack config check --help"]))
    assert "received no message" in stranger.types(
        "swarmtrack echo 'health/*' --seconds 1 --team nobody-is-here"
    )
    stranger.types("swarmtrack --version")
    stranger.types("swarmtrack-agent --help")
    stranger.types("swarmtrack sim --list")


MISTAKES = {
    "swarmtrack sin": "did you mean sim?",
    "swarmtrack config chek drone.toml": "did you mean check?",
    "swarmtrack sim crosing": "did you mean",
    "swarmtrack config check wrong.toml": 'did you mean "source"?',
    "swarmtrack-agent --config wrong.toml": 'did you mean "source"?',
    "swarmtrack replay junk.mcap": "junk.mcap",
}
MORE_MISTAKES = {
    "swarmtrack sim --tracker jpdf": "did you mean jpdaf?",
    "swarmtrack config check nowhere.toml": "nowhere.toml",
    "swarmtrack doctor --config wrong.toml": 'did you mean "source"?',
    "swarmtrack video nowhere.mp4": "nowhere.mp4",
    "swarmtrack video wrong.toml": "wrong.toml",
    "swarmtrack replay nowhere": "nowhere",
    "swarmtrack log info junk.mcap": "junk.mcap",
    "swarmtrack monitor --recording nowhere": "nowhere",
    "swarmtrack keys list nowhere": "nowhere",
    "swarmtrack sim --drones 100000": "drones",
}


@pytest.mark.parametrize(
    "mistakes",
    [
        pytest.param(MISTAKES, id="short"),
        pytest.param(MORE_MISTAKES, id="long", marks=pytest.mark.long("ten processes more, a mistake each")),
    ],
)
def test_mistakes_are_answered_in_a_sentence(stranger: Stranger, mistakes: dict[str, str]) -> None:
    (stranger.folder / "wrong.toml").write_text('[drone]\nid = 0\n[camera]\nsorce = "v4l2:///dev/video0"\n')
    (stranger.folder / "junk.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(range(256)))
    for command, said in mistakes.items():
        assert said in stranger.types(command, 1, 2), command


@pytest.mark.long("fifteen processes; the commands of the docs run one after another in the default run")
def test_a_config_from_the_first_question_to_the_doctor_and_keys(stranger: Stranger) -> None:
    said = stranger.types("swarmtrack config new --id 1 --start 0 0 0 90 --autopilot px4-uart")
    (following,) = re.findall(r"next: (swarmtrack .*)", said)
    said = stranger.types("swarmtrack config new --id 2 --start 0 3 0 90")
    assert "camera, lens and autopilot as in drone-1.toml" in said
    assert "the lens is guessed: 70°" in said
    assert "agree with each other" in stranger.types("swarmtrack config check drone-1.toml drone-2.toml")
    stranger.types("swarmtrack-agent --config drone-1.toml --check")
    stranger.types("swarmtrack config new --ids 11-15 --grid 3 --fov 78 --out team")
    five = " ".join(f"team/drone-{number}.toml" for number in range(11, 16))
    assert "drones 11, 12, 13, 14, 15 agree" in stranger.types(f"swarmtrack config check {five}")
    stranger.types("swarmtrack config new --example")
    stranger.types("swarmtrack config check example.toml")
    stranger.types("swarmtrack config schema --out schema.json")
    json.loads((stranger.folder / "schema.json").read_text())
    # There is no camera and no autopilot: it says so, with what to do.
    assert "/dev/video0" in stranger.types(f"{following} --seconds 3", 1)

    stranger.types("swarmtrack keys init keys --team swarm")
    stranger.types("swarmtrack keys issue keys 1 2 3 monitor")
    assert "drone-3" in stranger.types("swarmtrack keys list keys")
    stranger.types("swarmtrack keys revoke keys 3")
    config = stranger.folder / "drone-1.toml"
    config.write_text(config.read_text() + '\n[network]\nkeys = "keys/drone-{id}"\n')
    stranger.types("swarmtrack config check drone-1.toml")


@pytest.mark.long(
    "a flight of its own; the default run listens to, records, replays and shows the flights that it has"
)
def test_a_flight_that_is_listened_to_recorded_replayed_and_looked_at(stranger: Stranger) -> None:
    team = f"hour-{secrets.token_hex(4)}"
    command = (
        f"swarmtrack sim crossing --drones 2 --detector oracle --seconds 5 --record flight --team {team}"
    )
    recorder = stranger.start(f"swarmtrack record heard --team {team}")
    flight = stranger.start(command)
    assert flight.stdout is not None
    told = ""
    while "listen:" not in told or "look:" not in told:
        line = flight.stdout.readline()
        assert line, told
        told += line
    (listen,) = re.findall(r"^listen: (.*)$", told, re.MULTILINE)
    assert stranger.types(f"{listen} --count 2").count('"key"') == 2
    said = stranger.reads(command, flight, *FLOWN, before=told)
    assert re.search("PASSED|FAILED|NOT JUDGED", said)
    recorder.send_signal(signal.SIGINT)
    stranger.reads("swarmtrack record", recorder)

    assert "tracks" in stranger.types("swarmtrack log info flight")
    stranger.types("swarmtrack log info heard")
    stranger.types("swarmtrack replay flight --json replay.json", *FLOWN)
    json.loads((stranger.folder / "replay.json").read_text())
    stranger.types("swarmtrack plot flight")
    assert (stranger.folder / "flight.png").stat().st_size > 20_000
    said = stranger.types("swarmtrack log csv flight --out tables")
    for name in ("tracks", "health", "ego", "truth"):
        assert len((stranger.folder / "tables" / f"{name}.csv").read_text().splitlines()) > 2, said
    shutil.copy(DOCS / "examples" / "plot_flight.py", stranger.folder)
    stranger.types("python plot_flight.py tables")
    assert (stranger.folder / "tables" / "paths.png").stat().st_size > 10_000
    assert "no pictures" in stranger.types("swarmtrack replay flight --detect", 1, 2)
    page = stranger.start("swarmtrack monitor --recording flight --port 0")
    assert page.stdout is not None
    line = page.stdout.readline()
    with urlopen(re.search(r"http\S+", line)[0], timeout=PATIENCE) as answer:
        assert b"swarmtrack" in answer.read()
    page.send_signal(signal.SIGTERM)
    stranger.reads("swarmtrack monitor --recording flight", page)


@pytest.mark.long(
    "once more from a folder of one's own; runtime/test_video_command.py has it in the default run"
)
@pytest.mark.shared
@pytest.mark.skipif(not CLIP.is_file(), reason="../shared/data is absent")
def test_a_video_of_ones_own(stranger: Stranger) -> None:
    shorten(CLIP, stranger.folder / "my clip.mp4", 45)
    said = stranger.types("swarmtrack video 'my clip.mp4' --out seen")
    for name in re.findall(r"seen/[\w.-]+", said):
        assert (stranger.folder / name).is_file(), said
    stranger.types("swarmtrack video 'my clip.mp4' --out seen --force")
    rows = (stranger.folder / "seen" / "tracks.csv").read_text().splitlines()
    assert len(rows) > 20
    # What stands in the config that it wrote.
    (again,) = re.findall(r"swarmtrack-agent .*", (stranger.folder / "seen" / "agent.toml").read_text())
    stranger.types(again.replace("agent.toml", "seen/agent.toml") if "seen/" not in again else again)


def test_a_network_of_ones_own(stranger: Stranger) -> None:
    pytest.importorskip("onnx", reason="a network is made here")
    nets = importlib.import_module("support.foreign_nets")
    names = nets.ultralytics("cat", "glider")
    nets.spot_net(stranger.folder / "own.onnx", "yolo_v8", scores=(0.1, 0.9), written=names)
    code = cv2.VideoWriter.fourcc(*"MJPG")
    video = cv2.VideoWriter(str(stranger.folder / "spot.avi"), code, 30.0, (160, 128))
    for k in range(40):
        image = np.zeros((128, 160, 3), np.uint8)
        cv2.circle(image, (30 + 2 * k, 64), 4, (255, 255, 255), -1)
        video.write(image)
    video.release()
    refused = stranger.types("swarmtrack video spot.avi --model own.onnx --out own", 2)
    assert "cat, glider" in refused
    assert "classes" in refused
    stranger.types("swarmtrack video spot.avi --model own.onnx --classes glider --out own-2")
    assert len((stranger.folder / "own-2" / "tracks.csv").read_text().splitlines()) > 20


def test_the_tutorial_from_its_first_command_to_ones_own_tracker(tmp_path: Path) -> None:
    """Each command of the page, in its order; the page's own change of the tracker included."""
    stranger, page = Stranger(tmp_path), (DOCS / "tutorial.md").read_text(encoding="utf-8")
    shutil.copy(DOCS / "examples" / "nearest_neighbour.py", tmp_path)
    (scenario,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "mine.toml").write_text(scenario, encoding="utf-8")
    blocks = re.findall(r"^(?!<!-- not run.*)\n```sh\n(.*?)```", page, re.DOTALL | re.MULTILINE)
    commands = [line for block in blocks for line in block.splitlines() if line]
    assert len(commands) > 7
    for command in commands:
        said = stranger.types(command, *FLOWN)
        if "replay" in command:
            assert ("nearest)" in said) is command.endswith("--tracker nearest")
            assert re.search("PASSED|FAILED|NOT JUDGED", said)
    tracker = tmp_path / "nearest_neighbour.py"
    (changed,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    text, replaced = re.subn(r"    for row in range\(.*\n", changed, tracker.read_text(encoding="utf-8"))
    assert replaced == 1
    tracker.write_text(text, encoding="utf-8")
    stranger.types("python nearest_neighbour.py replay flight --tracker nearest", *FLOWN)
