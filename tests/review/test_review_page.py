"""The page of a review: whole in one file, whatever the recording says, and soon."""

from __future__ import annotations

import json
import re

import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")

from support.places import ROOT
from support.recorded_swarm import record_swarm
from support.reviewed_flight import Record, fly_healthy, link_of, rewrite
from swarmtrack.agents import main as swarmtrack
from swarmtrack.diagnosis.findings import Level, markdown_table
from swarmtrack.review.checks import FlightFinding, ReviewLine, review
from swarmtrack.review.faults import FLIGHT_FAULTS, flight_fault
from swarmtrack.review.html import as_records, render
from swarmtrack.review.read import read_flight

HOSTILE = "</script><img src=http://192.0.2.1/x onerror=alert(1)>&\u2028"


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    return fly_healthy(tmp_path_factory.mktemp("flown"))


def hostile(drone: int, topic: str, t: float, record: Record) -> Record:
    """Everything that a drone says in words."""
    if topic == "/health":
        for link in record["links"]:
            link["text"] = f"lost: {HOSTILE}"
            link["ok"] = False
        link_of(record, "v4l2")["name"] = HOSTILE[:40]
        record["events"].append(f"we started about {HOSTILE} of the stated start")
        record["noise"] = {"detections": 3.0, "motion": 1.0, "found": HOSTILE, "remedy": HOSTILE}
    return record


def test_hostile_texts_stay_texts(flown, tmp_path):
    flight = read_flight([rewrite(flown, tmp_path / "flight", hostile)])
    flight.team = HOSTILE
    page = render(flight, review(flight))
    assert page.count("<script") == 2
    assert page.count("</script>") == 2
    assert "<img" not in page
    assert "192.0.2.1" in page
    data = re.search(r'id="flight">(.*?)</script>', page, re.DOTALL)
    assert data is not None
    assert json.loads(data[1])["charts"]


def test_the_page_asks_for_nothing(flown, tmp_path):
    flight = read_flight([rewrite(flown, tmp_path / "flight")])
    page = render(flight, review(flight))
    assert "default-src &#x27;none&#x27;" in page
    assert not re.search(r"https?://|<link|<img|@import|url\(|src=|fetch\(|XMLHttp|WebSocket", page)
    assert "No fault was found." in page


def test_the_command_writes_the_page_and_says_the_first_lines(flown, tmp_path, capsys):
    folder, out = rewrite(flown, tmp_path / "flight", hostile), tmp_path / "review.html"
    assert swarmtrack.main(["review", str(folder), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert said.startswith("Team t, 3 drones, ")
    assert "failure" in said
    assert swarmtrack.main(["review", str(folder), "--out", str(out)]) == 2
    assert "already exists" in capsys.readouterr().err
    assert swarmtrack.main(["review", str(folder), "--out", str(out), "--force", "--json"]) == 0
    records = json.loads(capsys.readouterr().out)
    assert {"drone_id", "fault", "found", "remedy", "begin_s", "end_s"} <= records[0].keys()


def test_a_team_that_did_not_record_itself_is_reviewed_by_what_was_heard(tmp_path):
    record_swarm(tmp_path, 40.0, video=False)
    flight = read_flight([tmp_path])
    assert [drone.recorded for drone in flight.drones.values()] == [False] * 3
    assert review(flight)[0].first.finding.fault == "team.gone"
    assert "did not record" in render(flight, review(flight))


def test_lines_are_ordered_by_severity_times_duration():
    def line(name: str, seconds: float) -> ReviewLine:
        words = {
            "seconds": seconds,
            "count": 1,
            "other": 2,
            "share": 0.2,
            "why": "",
            "lag_ms": 1.0,
            "cpu": 1.0,
        }
        return ReviewLine((FlightFinding(1, flight_fault(name, **words), 0.0, seconds, seconds),))

    assert line("camera.gap", 20.0).weight > line("camera.gap", 12.0).weight
    assert line("camera.gap", 1.0).weight > line("team.loss", 600.0).weight > line("team.loss", 60.0).weight
    assert as_records([line("camera.gap", 3.0)])[0]["level"] == Level.FAILURE


def test_the_page_of_documentation_lists_every_sentence():
    table = markdown_table(FLIGHT_FAULTS)
    assert table in (ROOT / "docs" / "review.md").read_text(encoding="utf-8")
