"""Calibrations against truths that are known: turned by hand, and shown a board."""

from __future__ import annotations

import asyncio
import json
import math
import struct
import time
import tomllib
from contextlib import AsyncExitStack

import cv2
import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from support.drone_on_the_bench import SMALL, Server, TurnedAutopilot, camera_at, written
from support.fake_autopilot import serve_udp
from support.ports import free_port
from swarmtrack.agents.main import main
from swarmtrack.benchmarks import calibration as bench
from swarmtrack.calibration.board import BOARD_KINDS, Board, Seen, as_pdf
from swarmtrack.calibration.extrinsics import (
    doubts,
    for_the_config,
    rpy_deg,
    toml_lines,
    with_lines,
    write_into,
)
from swarmtrack.calibration.image_motion import ImageMotion
from swarmtrack.calibration.intrinsics import as_yaml, fit
from swarmtrack.calibration.views import BoardViews
from swarmtrack.config.camera_files import load_calibration
from swarmtrack.config.drone import load_config, mount_camera
from swarmtrack.errors import CalibrationError, SourceError
from swarmtrack.geometry import rotation
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.world.boards import BoardScene, board_poses
from swarmtrack.lab.world.hand_turned import HandTurned, Room
from swarmtrack.motion.hand_eye import GyroTurns, HandEye, Turns, compare, solve

FORWARD = rotation.BODY_FROM_FORWARD_CAMERA


# ── the mathematics, without images ──────────────────────────────────────────────────────────────────────────────────


def turned(
    seed,
    *,
    offset=0.03,
    rpy=(0.1, -0.2, 0.3),
    bias=(0.01, -0.02, 0.005),
    noise=3e-4,
    seconds=30.0,
    amplitude=(0.4, 0.4, 0.6),
):
    """(turns, gyro, camera_from_body) of a drone turned by hand whose image is understood to `noise` rad."""
    rng = np.random.default_rng(seed)
    hand = HandTurned(rng, amplitude=amplitude)
    R = rotation.from_euler(*rpy) @ FORWARD
    exposures = np.arange(0.0, seconds, 1 / 20)
    eyes = hand.world_from_body(exposures) @ R
    vectors = rotation.log(np.swapaxes(eyes[:-1], 1, 2) @ eyes[1:]) + rng.normal(0, noise, (len(eyes) - 1, 3))
    t = np.arange(-1.0, seconds + 1.0, 1 / 200)
    gyro = GyroTurns(t, hand.rates(t) + bias + rng.normal(0, 0.003, (len(t), 3)))
    return Turns(exposures[:-1] - offset, exposures[1:] - offset, vectors), gyro, R.T


def angle_deg(found, C):
    return math.degrees(float(np.linalg.norm(rotation.log(found.camera_from_body @ C.T))))


@pytest.mark.parametrize("offset", [-0.12, 0.0, 0.03, 0.2])
def test_mounting_offset_and_bias_are_found_together(offset):
    turns, gyro, C = turned(1, offset=offset)
    found = solve(turns, gyro)
    assert angle_deg(found, C) < 0.05
    assert found.time_offset_s == pytest.approx(offset, abs=5e-4)
    assert found.bias == pytest.approx((0.01, -0.02, 0.005), abs=1e-3)
    assert not doubts(found, compare(turns, gyro, found.camera_from_body), seconds=30.0, reach=0.3)


def test_sigmas_are_as_large_as_the_errors():
    scores = []
    for seed in range(12):
        turns, gyro, C = turned(seed, noise=3e-3, seconds=10.0)
        found = solve(turns, gyro)
        scores.append((found.time_offset_s - 0.03) / found.time_offset_sigma_s)
        error = rotation.log(found.camera_from_body @ C.T)
        scores.extend(error / found.rotation_sigma)
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.5


def test_a_third_of_the_frames_may_be_nonsense():
    turns, gyro, C = turned(2)
    rng = np.random.default_rng(0)
    wild = rng.random(len(turns.start)) < 0.3
    turns.vector[wild] += rng.normal(0.0, 0.1, (int(wild.sum()), 3))
    found = solve(turns, gyro)
    assert angle_deg(found, C) < 0.2
    assert found.time_offset_s == pytest.approx(0.03, abs=2e-3)
    assert found.outliers > 0.2


def test_what_was_hardly_turned_about_is_not_believed():
    turns, gyro, _ = turned(3, amplitude=(0.0, 0.01, 0.6))
    found = solve(turns, gyro)
    problems = doubts(found, compare(turns, gyro, found.camera_from_body), seconds=30.0, reach=0.3)
    assert any("hardly turned in roll" in problem and "pitch" in problem for problem in problems)


def test_an_offset_beyond_what_is_searched_is_said():
    turns, gyro, _ = turned(4, offset=0.4)
    found = solve(turns, gyro)
    assert any("--reach" in problem for problem in doubts(found, None, seconds=30.0, reach=0.3))
    farther = solve(turns, gyro, reach=0.6)
    assert farther.time_offset_s == pytest.approx(0.4, abs=1e-3)


def test_a_mirrored_gyro_is_no_rotation():
    turns, gyro, C = turned(5)
    mirrored = Turns(turns.start, turns.end, turns.vector * (1.0, -1.0, 1.0))
    gains = compare(mirrored, gyro, C).gain
    assert gains == pytest.approx((1.0, -1.0, 1.0), abs=0.05)
    found = solve(mirrored, gyro)
    problems = doubts(found, compare(mirrored, gyro, found.camera_from_body), seconds=30.0, reach=0.3)
    assert any("do not fit by any rotation" in problem for problem in problems)


def test_too_few_turns_say_nothing():
    turns, gyro, C = turned(6)
    few = Turns(turns.start[:10], turns.end[:10], turns.vector[:10])
    assert solve(few, gyro) is None
    assert compare(few, gyro, C) is None
    assert solve(Turns(np.empty(0), np.empty(0), np.empty((0, 3))), gyro) is None


# ── by hand, through rendered images ─────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("seed", [101, pytest.param(102, marks=pytest.mark.long("another seed of the same"))])
def test_a_turn_by_hand_gives_rotation_and_offset(seed):
    # A quarter of the benchmark's pixels: the claims of `swarmtrack bench calibration` hold with them too.
    minute = bench.hand_turned(seed, seconds=15.5, camera=bench.EYE.scaled(160, 120))
    assert math.degrees(minute.rotation_error) < 0.5
    assert abs(minute.offset_error) < 3e-3
    assert minute.believed


def test_an_image_without_anything_in_it_says_nothing():
    motion = ImageMotion(SMALL)
    for k in range(3):
        assert motion.add_frame(0.1 * k, np.full((120, 160), 128, np.uint8)) is None
    assert len(motion.turns().start) == 0


def test_frames_far_apart_are_not_compared():
    rng = np.random.default_rng(0)
    room = Room(rng, SMALL)
    motion = ImageMotion(SMALL)
    image = room.image(FORWARD, np.zeros(3))
    assert motion.add_frame(0.0, image) is None
    assert motion.add_frame(1.0, image) is None
    assert motion.add_frame(1.1, image).turn == pytest.approx(np.zeros(3), abs=1e-5)
    assert motion.add_frame(1.05, image) is None  # the clock went back


async def test_the_command_measures_a_live_drone_and_writes_its_config(tmp_path, capsys):
    """A real HTTP camera, a real UDP autopilot, the real command; its clock is 20 ms off and its camera looks up."""
    hand = HandTurned(np.random.default_rng(8), amplitude=(0.5, 0.5, 0.6), sway_m=0.0)
    room = Room(np.random.default_rng(9), SMALL)
    mount = rotation.from_euler(0.05, 0.2, -0.1) @ FORWARD
    late = 0.02

    def seen(t):
        # Stamped `late` before t, exposed another 20 ms before: the camera's clock is ahead.
        exposed = np.array([t - late - 0.02])
        return room.image(hand.world_from_body(exposed)[0] @ mount, np.zeros(3))

    port = free_port()
    fake = TurnedAutopilot(hand, (1.0, 1.0, 1.0), time.monotonic() - 40.0)
    async with AsyncExitStack() as stack:
        server = await stack.enter_async_context(Server(seen, fps=15.0, late=late))
        await stack.enter_async_context(serve_udp(fake, "127.0.0.1", port))
        link = f'link = "udpin:127.0.0.1:{port}"'
        path = written(tmp_path, camera=camera_at(server.url), autopilot=link)
        code = await _in_thread(
            [
                "calibrate",
                "extrinsics",
                "--config",
                str(path),
                "--seconds",
                "13",
                "--json",
                "--write",
                str(path),
            ]
        )
    record = json.loads(capsys.readouterr().out)
    assert record["rpy_deg"] == pytest.approx(np.degrees((0.05, 0.2, -0.1)), abs=0.7), record
    # A busy machine knows the autopilot's clock to some milliseconds; the offset of the other sign is 40 off.
    assert record["time_offset_s"] == pytest.approx(-0.02, abs=0.015)
    assert (code == 0) == (not record["doubts"])
    if code == 0:
        assert mount_camera(load_config(path).camera).time_offset_s == pytest.approx(
            record["time_offset_s"], abs=1e-4
        )


async def _in_thread(argv):
    return await asyncio.to_thread(main, argv)


def test_a_recorded_video_and_its_telemetry_do_as_well(tmp_path, capsys):
    """The video begins 0.4 s after the telemetry."""
    hand = HandTurned(np.random.default_rng(12), amplitude=(0.5, 0.5, 0.6), sway_m=0.0)
    room = Room(np.random.default_rng(13), SMALL)
    mount = rotation.from_euler(-0.1, 0.15, 0.3) @ FORWARD
    writer = cv2.VideoWriter(str(tmp_path / "turned.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 20.0, (160, 120))
    for k in range(20 * 17):
        t = np.array([0.4 + k / 20])
        image = room.image(hand.world_from_body(t)[0] @ mount, np.zeros(3))
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    autopilot = TurnedAutopilot(hand, (1.0, 1.0, 1.0), boot_at=-40.0)
    autopilot.set_interval(common.MAVLINK_MSG_ID_HIGHRES_IMU, 5000.0, 0.0)
    with (tmp_path / "turned.tlog").open("wb") as log:
        for ms in range(0, 19_000, 5):
            for datagram in autopilot.step(1e-3 * ms):
                log.write(struct.pack(">Q", 1_700_000_000_000_000 + 1000 * ms) + datagram)
    (tmp_path / "cam.yaml").write_text(
        "image_width: 160\nimage_height: 120\ncamera_matrix: {rows: 3, cols: 3, data: "
        "[160, 0, 79.5, 0, 160, 59.5, 0, 0, 1]}\ndistortion_model: none\n"
    )
    files = [("--video", "turned.mp4"), ("--tlog", "turned.tlog"), ("--calibration", "cam.yaml")]
    arguments = [word for option, name in files for word in (option, str(tmp_path / name))]
    code = main(["calibrate", "extrinsics", *arguments, "--json"])
    record = json.loads(capsys.readouterr().out)
    assert record["rpy_deg"] == pytest.approx(np.degrees((-0.1, 0.15, 0.3)), abs=0.5), record
    # The first record lies some milliseconds in.
    assert record["time_offset_s"] == pytest.approx(0.4, abs=0.006)
    assert record["turns"] > 200  # the reach is left out at both ends
    assert code == 0, record["doubts"]


def test_without_camera_or_autopilot_it_says_what_is_missing(tmp_path, capsys):
    path = written(tmp_path, autopilot=f'link = "udpin:127.0.0.1:{free_port()}"')
    assert main(["calibrate", "extrinsics", "--config", str(path), "--seconds", "0.5"]) == 1
    said = capsys.readouterr().err
    assert "too little data for a result" in said
    assert "no data from the autopilot" in said


def test_a_config_and_a_recording_together_are_a_wrong_usage(capsys):
    assert main(["calibrate", "extrinsics", "--video", "a.mp4"]) == 2
    assert "--tlog" in capsys.readouterr().err


# ── the lines for the config ─────────────────────────────────────────────────────────────────────────────────────────


def found_with(rpy, offset):
    C = (rotation.from_euler(*np.radians(rpy)) @ FORWARD).T
    return HandEye(
        C, offset, np.zeros(3), np.full(3, 1e-3), 1e-4, np.ones(3), np.ones(3), 1e-4, 0.0, 500, False
    )


def test_the_lines_mean_in_the_config_what_was_found(tmp_path):
    found = found_with((3.0, -25.0, 90.0), 0.0421)
    path = written(tmp_path)
    write_into(path, toml_lines(found, np.array([0.1, 0.0, -0.02])))
    mounted = mount_camera(load_config(path).camera)
    assert mounted.body_from_camera.rotation == pytest.approx(found.camera_from_body.T, abs=2e-4)
    assert mounted.body_from_camera.position == pytest.approx((0.1, 0.0, -0.02))
    assert mounted.time_offset_s == 0.0421
    assert rpy_deg(found) == pytest.approx((3.0, -25.0, 90.0))


def test_lines_replace_those_of_their_keys_and_leave_the_rest():
    text = '[drone]\nid = 1\n\n[camera]  # mine\nsource = "x"\ntime_offset_s = 0.5  # old\n\n[network]\nteam = "red"\n'
    assert with_lines(text, ["time_offset_s = 0.1", "body_from_camera = {}"]) == (
        '[drone]\nid = 1\n\n[camera]  # mine\nsource = "x"\ntime_offset_s = 0.1\nbody_from_camera = {}\n\n'
        '[network]\nteam = "red"\n'
    )
    assert with_lines("[drone]\nid = 1\n", ["time_offset_s = 0.1"]).endswith(
        "[camera]\ntime_offset_s = 0.1\n"
    )


def test_a_config_that_would_be_spoilt_stays_as_it_was(tmp_path):
    path = tmp_path / "drone.toml"
    path.write_text('drone.id = 1\ncamera.source = "sim://hover-triangle"\n')
    with pytest.raises(SourceError, match="left as it was"):
        write_into(path, ["time_offset_s = 0.1"])
    assert path.read_text() == 'drone.id = 1\ncamera.source = "sim://hover-triangle"\n'
    assert list(tmp_path.iterdir()) == [path]


# ── boards and intrinsics ────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("kind", BOARD_KINDS)
def test_a_drawn_board_is_found_where_its_corners_are(kind):
    board = Board(kind, 6, 5, 0.03)
    image = np.pad(board.draw(80), 60, constant_values=255)
    seen = board.find(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    assert seen is not None
    expected = seen.points[:, :2] / 0.03 * 80 + 60 - 0.5
    if kind == "checkerboard" and np.linalg.norm(seen.pixels[0] - expected[0]) > 80:
        expected = expected[::-1]  # it looks the same upside down
    assert seen.pixels == pytest.approx(expected, abs=0.6)
    assert board.find(np.full((100, 100), 200, np.uint8)) is None


@pytest.mark.parametrize(
    ("kind", "model"),
    [
        ("aprilgrid", "radtan"),
        ("charuco", "equidistant"),
        pytest.param(
            "charuco",
            "radtan",
            marks=pytest.mark.long("each board and each lens is in the default run"),
        ),
    ],
)
def test_a_camera_is_found_by_the_boards_it_was_shown(kind, model):
    shown = bench.board_shown(5, kind, model, views=9)
    truth = bench.LENSES[model]
    assert shown.focal_error < 0.005
    assert shown.ray_error_px < 0.5
    assert (shown.found.camera.width, shown.found.camera.height) == (truth.width, truth.height)
    assert (
        np.abs(np.array([shown.found.camera.fx - truth.fx, shown.found.camera.fy - truth.fy]))
        < 8 * shown.found.sigma[:2]
    ).all()


def exact_views(count, seed=0):
    """Views without any noise, as if every corner were seen."""
    truth = bench.LENSES["radtan"]
    board = Board()
    grid = np.stack(np.meshgrid(np.arange(1, 9), np.arange(1, 6)), axis=-1).reshape(-1, 2) * board.square_m
    points = np.column_stack([grid, np.zeros(len(grid))])
    views = []
    for pose in board_poses(np.random.default_rng(seed), truth, board.size_m, count):
        pixels, _, valid = truth.project(pose.transform(points))
        inside = valid & truth.contains(np.nan_to_num(pixels))
        if inside.sum() >= 12:
            views.append(Seen(np.flatnonzero(inside), points[inside], pixels[inside]))
    return views, truth


def test_exact_corners_give_the_exact_camera_and_a_file_that_the_agent_reads(tmp_path):
    views, truth = exact_views(16)
    found = fit(views, (truth.width, truth.height))
    assert found.camera.fx == pytest.approx(truth.fx, abs=0.05)
    path = tmp_path / "front.yaml"
    path.write_text(as_yaml(found, "front"))
    read = load_calibration(path)
    assert read.camera == found.camera
    assert read.name == "front"


def test_views_that_do_not_fit_are_left_out():
    views, truth = exact_views(16)
    spoilt = views[3]._replace(
        pixels=views[3].pixels + np.random.default_rng(0).normal(0, 6.0, views[3].pixels.shape)
    )
    found = fit([*views[:3], spoilt, *views[4:]], (truth.width, truth.height))
    assert found.rejected == (3,)
    assert found.camera.fx == pytest.approx(truth.fx, abs=0.1)


def test_too_few_views_are_an_error_with_a_number():
    views, truth = exact_views(4)
    with pytest.raises(CalibrationError, match="expected 6 at least"):
        fit(views, (truth.width, truth.height))


def test_what_is_still_missing_is_said_until_it_was_shown():
    views, truth = exact_views(60)
    chosen = BoardViews((truth.width, truth.height), still=False)
    assert len(chosen.missing()) == 5
    assert not chosen.offer(None)
    assert chosen.offer(views[0])
    assert not chosen.offer(views[0])  # the same again
    for view in views:
        chosen.offer(view)
    assert chosen.missing() == []
    assert chosen.cells().all()


@pytest.mark.parametrize(
    ("turn", "nearer"),
    [((0, 0.5, 0), "right"), ((0, -0.5, 0), "left"), ((-0.5, 0, 0), "lower"), ((0.5, 0, 0), "upper")],
)
def test_the_edge_that_is_towards_the_camera_is_called_by_its_name(turn, nearer):
    truth = bench.LENSES["radtan"]
    grid = np.stack(np.meshgrid(np.arange(1, 9), np.arange(1, 6)), axis=-1).reshape(-1, 2) * 0.028
    points = np.column_stack([grid, np.zeros(len(grid))])
    pose = Pose(rotation.exp(turn), np.zeros(3))
    middle = pose.transform(points).mean(axis=0)
    at = pose.transform(points) - middle + [0.0, 0.0, 0.5]
    depth = {
        "left": at[:, 0].argmin(),
        "right": at[:, 0].argmax(),
        "upper": at[:, 1].argmin(),
        "lower": at[:, 1].argmax(),
    }
    assert at[depth[nearer], 2] < 0.5
    chosen = BoardViews((truth.width, truth.height), still=False)
    assert chosen.offer(Seen(np.arange(len(points)), points, truth.project(at)[0]))
    (line,) = [line for line in chosen.missing() if "tilted" in line]
    assert nearer not in line
    assert line.count("edge") == 3


def test_a_board_that_moves_is_not_kept():
    views, truth = exact_views(2)
    chosen = BoardViews((truth.width, truth.height))
    moved = views[0]._replace(pixels=views[0].pixels + 20.0)
    assert not chosen.offer(moved)
    assert not chosen.offer(views[0])
    assert chosen.offer(views[0])


def test_a_folder_of_images_becomes_a_calibration(tmp_path, capsys):
    truth, board = bench.LENSES["radtan"], Board()
    scene = BoardScene(board.draw(60), 60, board.square_m, truth)
    rng = np.random.default_rng(3)
    folder = tmp_path / "views"
    folder.mkdir()
    for i, pose in enumerate(board_poses(rng, truth, board.size_m, 7)):
        cv2.imwrite(str(folder / f"{i:02}.png"), scene.image(pose, rng))
    out = tmp_path / "cam.yaml"
    code = main(["calibrate", "intrinsics", f"images://{folder}", "--out", str(out), "--json"])
    record = json.loads(capsys.readouterr().out)
    assert code == (1 if record["doubts"] else 0)
    assert load_calibration(out).camera.fx == pytest.approx(truth.fx, rel=0.005)


def test_a_camera_that_shows_no_board_is_said(tmp_path, capsys):
    folder = tmp_path / "views"
    folder.mkdir()
    cv2.imwrite(str(folder / "0.png"), np.full((120, 160, 3), 90, np.uint8))
    assert main(["calibrate", "intrinsics", f"images://{folder}", "--out", str(tmp_path / "x.yaml")]) == 1
    assert "expected charuco of 9 x 6 squares" in capsys.readouterr().err
    assert not (tmp_path / "x.yaml").exists()


def test_a_printed_board_is_to_scale_and_fits_its_paper(tmp_path, capsys):
    page = as_pdf(Board(), "A4")
    assert page.startswith(b"%PDF")
    assert f"{252.0 * 72 / 25.4:.4f} 0 0 {168.0 * 72 / 25.4:.4f}".encode() in page
    with pytest.raises(ValueError, match="fewer or smaller squares"):
        as_pdf(Board(columns=12), "A4")
    assert main(["calibrate", "board", "--out", str(tmp_path / "board.png")]) == 0
    image = cv2.imread(str(tmp_path / "board.png"))
    assert Board().find(image) is not None
    assert main(["calibrate", "board", "--out", str(tmp_path / "board.gif")]) == 2
    assert main(["calibrate", "board", "--columns", "2", "--out", str(tmp_path / "board.png")]) == 2
    assert "expected 3 … 30" in capsys.readouterr().err


def test_of_several_cameras_the_lines_go_into_the_table_of_the_one_that_was_measured(tmp_path):
    numbers = "intrinsics = { fx = 300.0, fy = 300.0, cx = 159.5, cy = 119.5, width = 320, height = 240 }\n"
    text = f'drone.id = 1\n[[camera]]\nsource = "http://a/"\n{numbers}[[ camera ]]\nsource = "http://b/"\n{numbers}'
    path = tmp_path / "drone.toml"
    path.write_text(text)
    write_into(path, ["time_offset_s = 0.1"], 1)
    assert [camera.time_offset_s for camera in load_config(path).cameras] == [None, 0.1]
    write_into(path, ["time_offset_s = 0.2"], 0)
    assert [camera.time_offset_s for camera in load_config(path).cameras] == [0.2, 0.1]


def test_what_is_printed_to_be_pasted_is_a_table_like_those_of_the_config():
    lines = ["body_from_camera = { rpy_deg = [0.0, 0.0, 90.0] }", "time_offset_s = 0.1"]
    one, second = for_the_config(lines, 0, 1), for_the_config(lines, 1, 2)
    assert one.startswith("[camera]\nbody_from_camera")
    assert second.startswith("[[camera]]  # into that of camera 2 of 2\nbody_from_camera")
    # Beside those that are there, "[camera]" would be an error.
    assert tomllib.loads(f'[[camera]]\nsource = "a"\n{second}\n')["camera"][1]["time_offset_s"] == 0.1


def test_a_camera_that_the_config_does_not_have_cannot_be_calibrated(tmp_path, capsys):
    path = tmp_path / "drone.toml"
    path.write_text(
        'drone.id = 1\n[camera]\nsource = "http://127.0.0.1:9/"\n'
        "intrinsics = { fx = 300.0, fy = 300.0, cx = 159.5, cy = 119.5, width = 320, height = 240 }\n"
    )
    assert main(["calibrate", "extrinsics", "--config", str(path), "--camera", "2"]) != 0
    assert "--camera 2: expected 1 to 1" in capsys.readouterr().err
