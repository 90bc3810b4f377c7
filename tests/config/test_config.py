"""What a drone may be told, and how it complains."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from support.places import CONFIGS
from swarmtrack.config.drone import DroneConfig, load_config, mount_camera
from swarmtrack.config.toml.layers import key_lines
from swarmtrack.errors import ConfigError, SwarmtrackError
from swarmtrack.geometry.camera import Equidistant, RadTan
from swarmtrack.messages import EgoPose
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.runtime.perception import make_ego_history

CAMERA = """
[camera]
source = "v4l2:///dev/video0"
intrinsics = { fx = 600.0, fy = 600.0, cx = 320.0, cy = 256, width = 640, height = 512 }
"""
MINIMAL = f"[drone]\nid = 7\n{CAMERA}"


@pytest.fixture
def write(tmp_path):
    def write(text, name="drone.toml"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    return write


def problems_of(path):
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    return [problem.removeprefix(f"{path.parent}/") for problem in caught.value.problems]


def test_an_id_a_source_and_a_calibration_are_enough(write):
    config = load_config(write(MINIMAL))
    assert (config.drone.id, config.autopilot.link, config.tracker.name) == (7, "none", "mbm")
    assert (config.network.insecure, config.output.tracks_hz, config.motion.history_s) == (False, 50.0, 2.0)
    mounted = mount_camera(config.camera)
    assert (mounted.camera.fx, mounted.camera.height, mounted.camera.distortion) == (600.0, 512, None)
    assert mounted.time_offset_s == 0.0
    # Not told otherwise, the camera looks along the nose.
    assert np.allclose(mounted.body_from_camera.transform(np.array([[0, 0, 5.0]])), [[5, 0, 0]])


@pytest.mark.parametrize("name", ["drone-1", "drone-2", "replay", "sim"])
def test_the_examples_load(name):
    config = load_config(CONFIGS / f"{name}.toml")
    assert config.camera.simulated == (name == "sim")
    if name.startswith("drone"):
        mounted = mount_camera(config.camera)
        assert config.tracker.parameters == {"p_detection": 0.9, "clutter_per_scan": 1.0}  # of team.toml
        assert isinstance(mounted.camera.distortion, RadTan if name == "drone-1" else Equidistant)


def test_the_team_file_alone_is_no_drone():
    assert [p.split(": ", 1)[1].split(",")[0] for p in problems_of(CONFIGS / "team.toml")] == [
        "camera: missing",
        "drone: missing",
    ]


def test_every_mistake_is_named_at_its_file_and_line(write):
    write('[network]\nteam = "a/b"\n[tracker]\nmeasurement_sigma = "a"\np_detektion = 0.9\n', "team.toml")
    path = write(
        """extends = "team.toml"
[drone]
id = 0
start = { position_m = [0.0, 0.0], from = "gps" }

[camera]
source = "v4l2:///dev/video0"
calibrtion = "cam1.yaml"
imu_rate_hz = 200
time_offset_s = nan
[detector]
threads = true
[identity]
probability = 2
[networc]
"""
    )
    found = problems_of(path)
    expected = [
        "drone.toml:3: drone.id: 0, expected",
        'drone.toml:4: drone.start.from: "gps" without a MAVLink autopilot',
        'drone.toml:4: drone.start.from: "gps" without an origin of the team frame',
        "drone.toml:4: drone.start.position_m[2]: missing",
        'drone.toml:8: camera.calibrtion: unknown key, did you mean "calibration"?',
        "drone.toml:9: camera.imu_rate_hz: unknown key here, expected in [autopilot]",
        "drone.toml:10: camera.time_offset_s: NaN, expected a finite number",
        "drone.toml:12: detector.threads: true, expected",
        "drone.toml:14: identity.probability: 2, expected",
        'drone.toml:15: networc: unknown key, did you mean "network"?',
        'team.toml:2: network.team: "a/b", expected letters',
        'team.toml:4: tracker.measurement_sigma: "a", expected a number',
        'team.toml:5: tracker.p_detektion: unknown key, did you mean "p_detection"?',
    ]
    assert len(found) == len(expected)
    for line, start in zip(sorted(found), sorted(expected), strict=True):
        assert line.startswith(start)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[drone\nid = 1", ":1: "),
        ("[drone]\nid = 1\nid = 2", ":3: Cannot overwrite a value"),
        ("a = '\x80'".encode("latin-1"), ":1: byte 0x80 is not UTF-8"),
        ("# " + "x" * 300_000, ":1: larger than 256 KiB"),
        ("a = " + "[" * 5000, ":1: "),
        ("a = " + "9" * 5000, ":1: Exceeds the limit"),
        (MINIMAL + "time_offset_s = " + "9" * 400, ":7: camera.time_offset_s: "),
        (
            MINIMAL + "[tracker]\nmeasurement_sigma = inf",
            ":8: tracker.measurement_sigma: Infinity, expected a number",
        ),
        (
            MINIMAL + "[identity]\nprofile = 1979-05-27",
            ':8: identity.profile: "1979-05-27", expected a string',
        ),
        (MINIMAL + '[tracker]\nname = "kallman"', 'tracker.name: "kallman", did you mean "kalman"?'),
        (MINIMAL + "[tracker]\np_detection = 1.5", "tracker.p_detection: 1.5, expected a probability"),
        ("tracker = 3\nidentity = 4\n" + MINIMAL, ":1: tracker: 3, expected a table"),
        (f"[drone]\nid = true\n{CAMERA}", ":2: drone.id: true, expected a valid integer"),
        (f'[drone]\nid = "1"\n{CAMERA}', ':2: drone.id: "1", expected a valid integer'),
        ('[drone]\nid = 1\n[camera]\nsource = "0"', ":3: camera: neither calibration nor intrinsics"),
        (MINIMAL + 'calibration = "a.yaml"', ":4: camera: both calibration and intrinsics"),
        (
            MINIMAL.replace("cx = 320.0", "cx = 3200.0"),
            ":6: camera.intrinsics: found cx = 3200, cy = 256, expected an optical axis in the image of 640 x 512",
        ),
        (
            MINIMAL.replace("600.0", "100.0").replace("cx = 320.0", "cx = 900.0")
            + 'distortion = { model = "equidistant", coefficients = [0, 0, 0, 0] }',
            ": camera: intrinsics: found cx = 900, cy = 256, expected an optical axis so near to the image",
        ),
        (MINIMAL + 'distortion = { model = "fov", coefficients = [1] }', ":7: camera.distortion.model"),
        (MINIMAL + 'distortion = { model = "radtan", coefficients = [1, 2] }', "expected finite numbers, 4"),
        (
            '[drone]\nid = 1\nstart = { from = "local", yaw_deg = 3 }' + CAMERA,
            ':3: drone.start: yaw_deg together with from = "local", expected one or the other: offset_m and',
        ),
        (
            '[drone]\nid = 1\nstart = { from = "gps", offset_yaw_deg = 3 }' + CAMERA,
            ':3: drone.start: offset_yaw_deg together with from = "gps", expected a heading from true north',
        ),
        (
            "[drone]\nid = 1\nstart = { offset_yaw_deg = 3 }" + CAMERA,
            ':3: drone.start: offset_yaw_deg without from = "local", expected yaw_deg instead',
        ),
        (MINIMAL + "[network]\nlisten = 7447", ":8: network.listen: 7447, expected a list"),
        ("extends = 3\n" + MINIMAL, ":1: extends: 3, expected a file name"),
        ('extends = ["none.toml"]\n' + MINIMAL, ":1: extends: no file"),
    ],
)
def test_each_kind_of_mistake_has_its_sentence(tmp_path, text, words):
    path = tmp_path / "drone.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert any(words in problem for problem in problems_of(path)), problems_of(path)


def test_a_file_that_is_not_there_is_said_like_any_other_mistake(tmp_path):
    assert problems_of(tmp_path / "none.toml") == [
        "none.toml:1: cannot be read (No such file or directory), expected a config file"
    ]
    assert "Is a directory" in problems_of(tmp_path)[0]


def test_the_nearest_layer_wins_and_tables_are_merged_key_by_key(write):
    write("[output]\ntracks_hz = 10\n[tracker]\np_detection = 0.5\np_survival = 0.8\n", "base.toml")
    write('extends = "base.toml"\n[tracker]\np_detection = 0.6\n', "shared/../team.toml")
    write("[detector]\nthreads = 2\n", "extra.toml")
    path = write('extends = ["team.toml", "extra.toml"]\n' + MINIMAL + "[output]\njsonl = 'a'\n")
    config = load_config(path)
    assert config.tracker.parameters == {"p_detection": 0.6, "p_survival": 0.8}
    assert (config.output.tracks_hz, config.detector.threads) == (10.0, 2)


def test_files_that_extend_each_other_in_a_circle_are_refused(write):
    write('extends = "drone.toml"\n', "team.toml")
    path = write('\nextends = "team.toml"\n' + MINIMAL)
    assert problems_of(path) == [
        "team.toml:1: extends: goes in a circle (drone.toml -> team.toml -> drone.toml), "
        "expected a file that does not lead back here"
    ]


def test_inputs_are_found_beside_the_file_that_names_them(write, tmp_path):
    write('[camera]\ncalibration = "cal/cam.yaml"\n[detector]\nmodel = "own.onnx"\n', "team/team.toml")
    path = write(
        'extends = "team/team.toml"\n[drone]\nid = 1\n[camera]\nsource = "file://clips/a%20b.mp4?pace=fast"\n'
        '[autopilot]\nlink = "tlog:a.tlog"\n[output]\njsonl = "out.jsonl"\n'
    )
    config = load_config(path)
    assert config.camera.calibration == tmp_path / "team/cal/cam.yaml"
    assert config.detector.model == str(tmp_path / "team/own.onnx")
    assert config.camera.source == f"file://{tmp_path}/clips/a%20b.mp4?pace=fast"
    assert config.autopilot.link == f"tlog:{tmp_path}/a.tlog"
    assert config.output.jsonl == Path("out.jsonl")  # what is written: in the working directory


@pytest.mark.parametrize(
    "source", ["/dev/video0", "v4l2:///dev/video0", "rtsp://host/a", "file:///a.mp4", "0"]
)
def test_other_addresses_are_left_as_they_are(write, source):
    assert load_config(write(MINIMAL.replace("v4l2:///dev/video0", source))).camera.source == source


def test_the_mount_is_told_as_the_angles_of_a_body_that_looks_forward(write):
    mount = "body_from_camera = { rpy_deg = [0, 20, 90], position_m = [0.1, 0, 0] }\ntime_offset_s = 0.004\n"
    mounted = mount_camera(load_config(write(MINIMAL + mount)).camera)
    axis = mounted.body_from_camera.rotation @ [0, 0, 1]
    assert np.allclose(axis, [0, np.cos(np.radians(20)), -np.sin(np.radians(20))])  # right, and up
    assert mounted.body_from_camera.position.tolist() == [0.1, 0.0, 0.0]
    assert mounted.time_offset_s == 0.004


def test_a_calibration_made_with_a_flu_imu_is_turned_into_frd_and_the_config_goes_before_the_file(
    write, tmp_path
):
    # Camera z along IMU x (forward), camera x to IMU -y (FLU: right), camera y to IMU -z (down).
    (tmp_path / "cam.yaml").write_text(
        "cam0:\n  camera_model: pinhole\n  intrinsics: [400, 400, 320, 240]\n  resolution: [640, 480]\n"
        "  distortion_model: radtan\n  distortion_coeffs: [0, 0, 0, 0]\n  timeshift_cam_imu: 0.003\n"
        "  T_cam_imu: [[0,-1,0,0], [0,0,-1,0], [1,0,0,-0.1], [0,0,0,1]]\n"
    )
    text = '[drone]\nid = 1\n[camera]\nsource = "0"\ncalibration = "cam.yaml"\nimu_frame = "flu"\n'
    mounted = mount_camera(load_config(write(text)).camera)
    assert np.allclose(mounted.body_from_camera.rotation, [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    assert np.allclose(mounted.body_from_camera.position, [0.1, 0, 0])
    assert mounted.time_offset_s == 0.003
    text += "time_offset_s = 0.0\nbody_from_camera = { position_m = [1, 2, 3] }\n"
    mounted = mount_camera(load_config(write(text)).camera)
    assert mounted.time_offset_s == 0.0
    assert mounted.body_from_camera.position.tolist() == [1.0, 2.0, 3.0]


def test_lines_are_found_through_comments_strings_and_arrays_of_many_lines():
    text = (
        '# [x]\n[a.b]\n"c.d" = """\n[e]\n"""\nf = [\n  1, # ]\n]\n'
        "g.h = { i = 1 }\n[[j]]\nk = 1\r\n[[j]]\nk = 2\n[j.l]\nm = 3\n"
    )
    assert tomllib.loads(text)
    lines = key_lines(text)
    assert lines["a",] == lines["a", "b"] == 2
    assert lines["a", "b", "c.d"] == 3
    assert lines["a", "b", "f"] == 6
    assert lines["a", "b", "g", "h", "i"] == 9
    assert (lines["j",], lines["j", 0, "k"]) == (10, 11)
    assert (lines["j", 1], lines["j", 1, "k"], lines["j", 1, "l", "m"]) == (12, 13, 15)
    assert ("e",) not in lines


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


def toml(value):
    """A value as TOML; None as an empty table."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, float):
        return repr(value)
    return "{}" if value is None else json.dumps(value)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    section=st.sampled_from([*DroneConfig.model_fields, "camera", "extends"]),
    key=st.text(st.sampled_from("abmopd_"), min_size=1) | st.sampled_from(["id", "name", "source", "start"]),
    value=values,
)
def test_whatever_stands_there_the_answer_is_a_config_or_sentences(write, section, key, value):
    path = write(f"{section}.{key} = {toml(value)}\n" if len(key) % 2 else f"{section} = {toml(value)}\n")
    for problem in problems_of(path):
        assert "drone.toml:" in problem
        assert ": " in problem


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200), st.integers(0, 1000), st.booleans())
def test_bytes_of_any_kind_are_answered_with_sentences(tmp_path, garbage, at, into_a_good_one):
    path = tmp_path / "drone.toml"
    good = MINIMAL.encode()
    at %= len(good)
    path.write_bytes(good[:at] + garbage + good[at:] if into_a_good_one else garbage)
    message = ""
    try:
        mount_camera(load_config(path).camera)
    except SwarmtrackError as error:
        message = str(error)
    assert message == "" or message.startswith(str(path))


@pytest.mark.parametrize(
    ("said", "ground", "flight"),
    [
        ("", 3.0, 1.5),
        ("heading_sigma_deg = 2", 2.0, 2.0),
        ("heading_sigma_deg = { ground = 4.0 }", 4.0, 1.5),
        ("heading_sigma_deg = { ground = 1, flight = 0.4 }", 1.0, 0.4),
    ],
)
def test_the_heading_is_as_sure_as_one_number_or_two_say(write, said, ground, flight):
    sigma = load_config(write(f"{MINIMAL}\n[autopilot]\n{said}\n")).autopilot.heading_sigma
    assert np.degrees([sigma.ground, sigma.flight]) == pytest.approx([ground, flight])


@pytest.mark.parametrize(
    ("said", "problem"),
    [
        ('"3"', 'autopilot.heading_sigma_deg: "3", expected degrees, or { ground = 3.0, flight = 1.5 }'),
        ("true", "autopilot.heading_sigma_deg: true, expected degrees"),
        ("{ ground = 0 }", "autopilot.heading_sigma_deg.ground: 0, expected greater than 0"),
        ("{ grund = 3 }", 'autopilot.heading_sigma_deg.grund: unknown key, did you mean "ground"?'),
    ],
)
def test_a_heading_that_is_no_angle_is_named(write, said, problem):
    (found,) = problems_of(write(f"{MINIMAL}\n[autopilot]\nheading_sigma_deg = {said}\n"))
    assert problem in found


def test_what_a_config_says_of_the_widths_of_boxes_overrides_what_the_model_says(write):
    said = BoxWidth(factor=1.2, padding_px=16.0, drone_sigma=0.3)
    section = load_config(
        write(f"{MINIMAL}\n[detector.box_width]\nfactor = 1\nwander_s = 2.5\n")
    ).detector.box_width
    assert section.over(said) == replace(said, factor=1.0, wander_s=2.5)
    assert load_config(write(MINIMAL)).detector.box_width.over(said) == said


@pytest.mark.parametrize(
    ("said", "problem"),
    [
        ("factor = 0", "box_width.factor: found 0.0, expected a number from 0.2 to 5"),
        ('factor = "1"', 'detector.box_width.factor: "1", expected a valid number'),
        ("white = 0.1", "detector.box_width.white: unknown key"),
    ],
)
def test_a_width_of_boxes_that_cannot_be_is_named(write, said, problem):
    (found,) = problems_of(write(f"{MINIMAL}\n[detector.box_width]\n{said}\n"))
    assert problem in found


@pytest.mark.parametrize("span", ["0", "100", "-0.5", "nan"])
def test_a_span_that_no_airframe_has_is_named(write, span):
    (found,) = problems_of(write(f"{MINIMAL}\n[team]\nairframe_span_m = {span}\n"))
    assert found.startswith("drone.toml:")
    assert "team.airframe_span_m: " in found
    assert "expected" in found


# --- several cameras --------------------------------------------------------------------


def cameras(*changes):
    """A config with a [[camera]] for each of these texts, all of one kind but for their sources."""
    tables = [
        CAMERA.replace("[camera]", "[[camera]]").replace("video0", f"video{k}") + change
        for k, change in enumerate(changes)
    ]
    return "[drone]\nid = 7\n" + "".join(tables)


def test_each_camera_has_a_table_of_its_own(write):
    config = load_config(
        write(cameras("max_age_s = 0.2\n", "mounting_sigma_deg = 0.25\ntime_offset_s = 0.01\n"))
    )
    first, second = config.cameras
    assert config.camera is first
    assert [one.source for one in config.cameras] == ["v4l2:///dev/video0", "v4l2:///dev/video1"]
    assert (first.max_age_s, second.max_age_s) == (0.2, 0.5)
    assert (first.mounting_sigma, second.mounting_sigma) == pytest.approx(np.radians([1.0, 0.25]))
    assert mount_camera(second).time_offset_s == 0.01


def test_one_camera_may_be_written_either_way(write):
    one, other = load_config(write(MINIMAL)), load_config(write(cameras("")))
    assert one.model_dump() == other.model_dump()
    assert one.model_dump(mode="json", by_alias=True)["camera"]["source"] == "v4l2:///dev/video0"
    several = load_config(write(cameras("", ""))).model_dump(mode="json", by_alias=True)
    assert [table["source"] for table in several["camera"]] == ["v4l2:///dev/video0", "v4l2:///dev/video1"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (cameras("", "max_age = 0.1\n"), "11: camera[1].max_age: unknown key, did you mean"),
        (cameras("", "max_age_s = -1\n"), "11: camera[1].max_age_s: -1, expected greater than 0"),
        (cameras("", "mounting_sigma_deg = 0\n"), "11: camera[1].mounting_sigma_deg: 0, expected"),
        (cameras("", "distortion = 3\n"), "11: camera[1].distortion: 3, expected a table"),
        (
            cameras("", "").replace("video1", "video0"),
            '9: camera[1].source: "v4l2:///dev/video0" is that of camera[0].source, expected another',
        ),
        (
            cameras("", "").replace("v4l2:///dev/video1", "detections://127.0.0.1:1/a"),
            '9: camera[1].source: "detections://127.0.0.1:1/a", expected pictures: all cameras detect by',
        ),
        (
            cameras("", "").replace("v4l2:///dev/video0", "detections://127.0.0.1:1/a"),
            '9: camera[1].source: "v4l2:///dev/video1", expected detections:// as of the first camera',
        ),
        (cameras("", "").replace("v4l2:///dev/video0", "sim://x"), "9: camera[1].source: "),
        (cameras(*[""] * 9), "camera: found 9 cameras, expected 1 to 8"),
        ("camera = []\n[drone]\nid = 7\n", "camera: found 0 cameras, expected 1 to 8"),
        (
            "camera = 3\n[drone]\nid = 7\n",
            "1: camera: 3, expected a table [camera], or one [[camera]] for each",
        ),
        ("camera = [3]\n[drone]\nid = 7\n", "camera[0]: 3, expected a table"),
    ],
)
def test_a_mistake_in_one_of_several_cameras_names_it(write, text, expected):
    (problem,) = problems_of(write(text))
    assert problem.startswith("drone.toml:")
    assert expected in problem


def test_paths_of_each_camera_begin_at_the_file_that_names_them(write, tmp_path):
    text = '[drone]\nid = 7\n[[camera]]\nsource = "images://left"\ncalibration = "a.yaml"\n'
    text += '[[camera]]\nsource = "images://right"\ncalibration = "b.yaml"\n'
    config = load_config(write(text, "team/drone.toml"))
    assert [camera.source for camera in config.cameras] == [
        f"images://{tmp_path}/team/left",
        f"images://{tmp_path}/team/right",
    ]
    assert [camera.calibration for camera in config.cameras] == [
        tmp_path / "team" / "a.yaml",
        tmp_path / "team" / "b.yaml",
    ]


def test_a_turned_local_frame_reaches_the_pose(write):
    start = 'id = 7\nstart = { from = "local", offset_yaw_deg = 90 }\n'
    linked = '[autopilot]\nlink = "udpin:127.0.0.1:14540"\n'
    config = load_config(write(MINIMAL.replace("id = 7\n", start) + linked))
    ego = make_ego_history(config, None, history_s=2.0)
    ego.append(EgoPose(0.0, np.array([2.0, 0.0, 0.0]), np.eye(3)))
    np.testing.assert_allclose(ego.team_from_local @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
