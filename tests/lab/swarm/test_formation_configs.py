"""What the agents of a star are told: everybody's slot, and that their pilots may engage them."""

from pathlib import Path

import pytest

from swarmtrack.config.drone import load_config, mount_camera
from swarmtrack.config.formation import fields_of_view
from swarmtrack.formation.plan import view_faults
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.swarm.configs import Sources, write_configs


@pytest.mark.parametrize("name", ["formation-3", "formation-5", "formation-8", "leader-lost", "swapped-id"])
def test_every_agent_of_a_star_may_fly_in_its_slot_and_sees_its_leader_there(
    tmp_path: Path, name: str
) -> None:
    scenario = load_scenario(name)
    star = scenario.star
    assert star is not None
    sources = {
        d: Sources(f"detections://127.0.0.1:9/{d}", f"udpout:127.0.0.1:{5000 + d}") for d in star.slots
    }
    files = write_configs(tmp_path, scenario, team="blue", tracker="mbm", sources=sources, simulator="…")
    for drone_id in scenario.members:
        config = load_config(files[drone_id])
        plan = config.formation.plan()
        assert plan is not None
        assert (plan.leader, plan.height) == (star.leader, star.height_m)
        for other, slot in star.slots.items():
            assert plan.slots[other] == pytest.approx(slot, abs=1e-3)
        assert config.flies_in_formation == (drone_id != star.leader)
        if drone_id == star.leader:
            continue
        mounted = mount_camera(config.camera)
        views = fields_of_view([(mounted.camera, mounted.body_from_camera)])
        assert view_faults(plan, drone_id, views, config.formation.limits.acceleration_m_s2) == []
