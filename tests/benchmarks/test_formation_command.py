"""`swarmtrack bench cost --of command`: what it times is what it says. How long that takes is no test's business."""

from swarmtrack.benchmarks import cost
from swarmtrack.benchmarks.formation import command
from swarmtrack.formation.formation import Formation
from swarmtrack.formation.parameters import FormationParameters
from swarmtrack.formation.setpoint import Why


def test_a_crowd_is_kept_clear_of_while_its_leader_is_followed():
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


def test_every_figure_is_written_beside_its_budget(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "QUICK_REPEATS", 5)
    figures = cost.BENCH.publish(tmp_path, quick=True, of=["command"], states=1000)["command"]
    assert [figure["value"] for figure in figures[-3:]] == [0, 0, 0]
    assert [figure["ok"] for figure in figures[-3:]] == [True, True, True]
    page = (tmp_path / "cost.md").read_text(encoding="utf-8")
    assert "| a command with 10 tracks | " in page
    assert "| of 1000 random states, answers that were not sound | 0  | 0  | ok | – |" in page


def test_states_that_are_not_sound_are_counted(monkeypatch):
    monkeypatch.setattr(command, "wrong_with", lambda *args: "always")
    found = command.soundness(1)
    assert (found.states, found.squeezed, found.unsound) == (1000, 1000, 1000)
    assert found.wrong == ["story 0: always"] * 5
