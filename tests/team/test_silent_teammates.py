"""A teammate that falls silent keeps its track, however well the motion of others fits."""

from support.crossing import CROSSING
from swarmtrack.benchmarks.identity.recognition import judge
from swarmtrack.benchmarks.virtual_swarm import Said, VirtualSwarm
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.messages import PeerArrived

LEFT_SIDE = {1, 2}
PARTED_S, MET_S, LANDED_S = 9.0, 18.0, 22.0


class Parted(VirtualSwarm):
    """In which the two sides hear nothing of each other for a while."""

    def _deliver(self, sender: int, receiver: int, said: PeerArrived | Said, now: float) -> None:
        if PARTED_S <= now < MET_S and (sender in LEFT_SIDE) != (receiver in LEFT_SIDE):
            return
        super()._deliver(sender, receiver, said, now)


def test_a_pair_that_is_silent_is_not_taken_for_one_that_speaks(tmp_path):
    """All four swing to and fro with about the same period: by some error of the own heading each fits each."""
    path = tmp_path / "crossing.toml"
    path.write_text(CROSSING)
    scenario = load_scenario(path, seed=2)
    score = judge(Parted(scenario, share_hz=7.0), scenario, LANDED_S).score
    assert score.wrong == 0.0
    assert score.correct > 0.98
