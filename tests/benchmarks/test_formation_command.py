"""`swarmtrack bench formation-command`: what it times is what it says. How long that takes is no test's business."""

from swarmtrack.benchmarks.formation import command
from swarmtrack.formation.formation import Formation
from swarmtrack.formation.parameters import FormationParameters
from swarmtrack.formation.setpoint import Why


def test_a_crowd_is_kept_clear_of_while_its_leader_is_followed(tmp_path):
    formation = Formation(
        FormationParameters(
            drone_id=2, leader=1, slots=command.SLOTS, references=(1,), height=command.HEIGHT_M
        )
    )
    states, own, tracks, _ = command.crowd(10)
    for k in range(30):
        setpoint = formation.command(states, own, tracks, 0.1 * k)
    assert setpoint.why is Why.FOLLOW
    assert len(setpoint.clear_of) >= 3


def test_every_figure_is_written(tmp_path):
    result = command.publish(tmp_path, 5, 1)
    assert list(result["cost_ms"]) == ["1", "5", "10", "20"]
    soundness = {
        "states": 1000,
        "squeezed": 1000,
        "answers_unlike": 0,
        "unsound": 0,
        "closing_in": 0,
        "wrong": [],
    }
    assert result["soundness"] == soundness
    assert "10 | " in (tmp_path / "formation-command.md").read_text(encoding="utf-8")
