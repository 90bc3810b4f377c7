"""What must not break a swarm: a radio that parts or loses, an agent that dies, a clone, a wrong clock, a reboot.

Real agents in network namespaces, hence root only. Faults after which a team can go on befall one team, one after
another: to bring one up costs more than most of them. The partition of 30 s and the loss of 40 s, whose figures
docs/swarm.md publishes, are long forms (`-m long`); the default run has shorter ones. Each test prints what it
measured (`pytest -n 0 -s -m '' tests/live/test_faults.py`). Asserted are generous bounds, for a machine that is busy.
"""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import pytest
import pytest_asyncio

from support.patience import PATIENCE
from support.team_in_the_air import Lines, Look, Team, team_in_the_air
from swarmtrack.lab.swarm.radio import RadioError
from swarmtrack.security import names
from swarmtrack.transport.limits import PACE_LOG_QUIET_S

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")
pytestmark = pytest.mark.asyncio(loop_scope="module")  # as long as the team that they share

# A cut within about a second of the first link may take with it what was said once (docs/swarm.md, "Faults"). It is
# healed by links that are made again, which takes longer than these tests' figures allow for.
SETTLED_S = 3.0
PARTITIONS_S = (
    8.0,
    pytest.param(30.0, marks=pytest.mark.long("the 30 s of docs/swarm.md")),
)  # 4 and 15 leases
LOSSES_S = (8.0, pytest.param(40.0, marks=pytest.mark.long("the 40 s of docs/swarm.md")))  # 4 and 20 leases
CARRIED_S = (5.0, pytest.param(8.0, marks=pytest.mark.long("four leases, not two and a half")))
APART_S = 6.0  # three leases; links are renewed after two
# Tracks of each of three drones on 64 kbit/s; 3.5 to 4.7 were measured, 1.6 beside other tests.
NARROW_LEAST_HZ = 1.0
LISTENING_S = (10.0, pytest.param(25.0, marks=pytest.mark.long("listens for 12 leases, not 5")))
CRASHES = (2, pytest.param(6, marks=pytest.mark.long("six crashes, not two")))
# Of world time. The first that comes after everybody was named is the one that is watched, on however slow a machine.
REBOOTS_AT_S = (12.0, 32.0, 52.0, 92.0, 132.0, 172.0)
REBOOT_S = 2.0
TWO_HOURS = 7200.0
RENEWALS = 28
STANDSTILL_S = 1.0  # half a lease: what an agent that gets no CPU does to the links, no radio need do
NARROW_STANDSTILL_S = 0.5  # where signs of life wait in a full radio's queue besides

TRIANGLE = """\
about = "everybody sees everybody, and the agents cost little"
seconds = 60.0

[formation]
drones = 3
ring = { radius_m = 2.9, heights_m = [3.0, 3.5] }
sway = { amplitude_m = [0.25, 0.25, 0.2], period_s = [6.0, 12.0] }

[camera]
fps = 10.0

[agents]
tracks_hz = 25.0
imu_rate_hz = 50.0
"""
CROSSING = """\
about = "drones cross in the image, again and again"
seconds = 60.0

[formation]
drones = 4
lanes = { gap_m = 5.0, lane_step_m = 2.0, lanes_a_side = 2, spacing_m = 2.4, heights_m = [5.0, 5.4] }
weave = { reach_m = 1.2, period_s = [10.0, 16.0] }

[camera]
fps = 10.0

[agents]
tracks_hz = 25.0
imu_rate_hz = 50.0
"""
RHOMBUS = TRIANGLE.replace("drones = 3", "drones = 4")
REBOOTS = "".join(
    f"""
[[fault]]
kind = "autopilot-reboot"
at_s = {at_s}
seconds = {REBOOT_S}
drones = [1]
"""
    for at_s in REBOOTS_AT_S
)

Gather = Callable[..., Awaitable[Team]]


class OneFlight:
    """A team that flies on from test to test."""

    def __init__(self, folders: pytest.TempPathFactory) -> None:
        self._folders = folders
        self._sky = AsyncExitStack()
        self._team: Team | None = None

    async def team(self) -> Team:
        """In which everybody knows everybody: the one in the air, or another where that does not get over a test."""
        if self._team is not None:
            try:
                await self._team.until_known(self._team.drones, since=time.monotonic())
            except AssertionError:
                await self.land()
        if self._team is None:
            folder = self._folders.mktemp("team")
            self._team = await self._sky.enter_async_context(team_or_skip(TRIANGLE, folder))
            await take_off(self._team)
        return self._team

    def calm(self) -> None:
        """The radio is as good as a cable again, for a team that is still in the air."""
        if self._team is None:
            return
        self._team.emulator.heal()
        self._team.emulator.impair(loss=0.0, latency_s=0.0, jitter_s=0.0, repeated=0.0, disordered=False)
        self._team.emulator.narrow(None)
        self._team.emulator.limit_frames(None)
        self._team.emulator.block_udp(blocked=False)

    async def land(self) -> None:
        self._team = None
        await self._sky.aclose()


@asynccontextmanager
async def team_or_skip(scenario: str, folder: Path, *, secured: bool = True) -> AsyncIterator[Team]:
    try:
        async with team_in_the_air(scenario, folder, secured=secured) as team:
            yield team
    except RadioError as error:
        pytest.skip(str(error))


async def take_off(team: Team) -> dict[int, Lines]:
    """Agents of all drones, which know each other."""
    for drone in team.drones:
        await team.start(drone)
    await team.until_known(team.drones, since=time.monotonic())
    return team.agents


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def flight(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[OneFlight]:
    flight = OneFlight(tmp_path_factory)
    yield flight
    await flight.land()


@pytest_asyncio.fixture(loop_scope="module")
async def team(flight: OneFlight, request: pytest.FixtureRequest) -> AsyncIterator[Team]:
    """The team of all tests that leave it whole; who fails has spent it."""
    failed = request.session.testsfailed
    team = await flight.team()
    await team.until_met()
    await asyncio.sleep(SETTLED_S)
    yield team
    if request.session.testsfailed > failed:
        await flight.land()
    else:
        flight.calm()


@pytest_asyncio.fixture(loop_scope="module")
async def gather(flight: OneFlight, tmp_path: Path) -> AsyncIterator[Gather]:
    """Makes the team of a scenario (`team_in_the_air`), its agents not yet started."""
    await flight.land()  # one at a time
    async with AsyncExitStack() as stack:

        async def make(scenario: str, *, secured: bool = True) -> Team:
            return await stack.enter_async_context(team_or_skip(scenario, tmp_path, secured=secured))

        yield make


def report(claim: str, value: float, unit: str = "s") -> None:
    print(f"\n  {claim}: {value:.3g} {unit}", end="", flush=True)


def on_the_air(team: Team) -> tuple[int, int]:
    """Frames so far, and how many of them were lost on the way to somebody."""
    counters = team.emulator.counters.values()
    return sum(one.frames for one in counters), sum(one.lost for one in counters)


async def readdress(team: Team, drone: int) -> None:
    """Its radio's address is replaced by another of the same network."""
    old = team.emulator.radio_address(drone)
    new = f"{old.rpartition('.')[0]}.{200 + drone}"
    await ip(team, drone, f"addr del {old}/16 dev radio0")
    await ip(team, drone, f"addr add {new}/16 brd + dev radio0")


async def ip(team: Team, drone: int, words: str) -> None:
    """Run ip(8) on the drone."""
    changing = await asyncio.create_subprocess_exec(*team.emulator.wrap(drone, ["ip", *words.split()]))
    assert await changing.wait() == 0


def departures(team: Team, since: float, *drones: int) -> list[float]:
    """When these drones' agents, or all, reported that another is gone."""
    return [t for drone in drones or team.agents for t in team.agents[drone].times("is gone", since)]


def assert_nobody_lost(team: Team, since: float, until: float, standstill_s: float = STANDSTILL_S) -> None:
    """Skips the test where the machine, and not the radio, kept agents silent."""
    gone, silence = departures(team, since), team.longest_silence(since, until)
    report("longest silence on a cable without faults", silence)
    if gone and silence > standstill_s:
        pytest.skip(
            f"this machine is too busy: on a cable without faults an agent was silent for {silence:.1f} s"
        )
    assert [t - since for t in gone] == []


def assert_names_held(team: Team, since: float, least: float = 0.85) -> None:
    """Nobody was given a wrong name, and most looks had all the right ones. least: share of looks."""
    now = time.monotonic()
    right = team.looks_between(team.drones, since, now, Look.is_right)
    report("everybody in view rightly named", 100.0 * sum(right) / len(right), "% of what was published")
    assert sum(right) > least * len(right)
    assert team.wrong(team.drones, since=since, until=now) == 0


# --- one after another, in one flight


@pytest.mark.parametrize("seconds", PARTITIONS_S)
async def test_after_a_partition_everybody_is_met_and_named_again(team: Team, seconds: float) -> None:
    agents = team.agents
    cut = time.monotonic()
    team.emulator.cut({1})
    gone = [await agents[2].until(r"drone 1 is gone", cut), await agents[3].until(r"drone 1 is gone", cut)]
    gone += [await agents[1].until(rf"drone {drone} is gone", cut) for drone in (2, 3)]
    report("the partition was noticed after", max(gone) - cut)
    await asyncio.sleep(cut + seconds - time.monotonic())

    healed = time.monotonic()
    right = team.looks_between(team.drones, cut, healed, Look.is_right)
    report("everybody in view rightly named while parted", 100.0 * sum(right) / len(right), "% of all looks")
    assert sum(right) > 0.85 * len(right)
    team.emulator.heal()
    met = [await agents[drone].until(r"drone 1 announced itself", healed) for drone in (2, 3)]
    met += [await agents[1].until(rf"drone {drone} announced itself", healed) for drone in (2, 3)]
    report("announcements known again, after healing", max(met) - healed)
    named = await team.until_known(team.drones, since=max(met))
    report("identities right again, after healing", named - healed)
    assert agents[2].times(r"drone 3 is gone", cut) == []  # of one side, all the time
    assert team.wrong(team.drones, since=cut, until=named) == 0


@pytest.mark.parametrize("seconds", LOSSES_S)
async def test_a_fifth_of_all_frames_lost_makes_nobody_wrong_or_dead(team: Team, seconds: float) -> None:
    lossy, (frames_before, lost_before) = time.monotonic(), on_the_air(team)
    team.emulator.impair(loss=0.2)
    await asyncio.sleep(seconds)
    frames, lost = on_the_air(team)
    frames, lost = frames - frames_before, lost - lost_before
    assert lost > 0.1 * frames > 50  # they spoke, and the air was bad
    end = time.monotonic()
    right = team.looks_between(team.drones, lossy, end, Look.is_right)
    report(f"of {frames} frames lost", 100.0 * lost / frames, "%")
    report(f"false deaths in {seconds:g} s", len(departures(team, lossy)), "")
    report("everybody in view rightly named", 100.0 * sum(right) / len(right), "% of what was published")
    assert team.wrong(team.drones, since=lossy, until=end) == 0
    assert_nobody_lost(team, lossy, end)


async def test_a_drone_that_hears_and_is_not_heard_is_missed_once_and_keeps_its_name(team: Team) -> None:
    agents, mute = team.agents, time.monotonic()
    team.emulator.deafen((2, 3), (1,))
    missed = [await agents[drone].until(r"drone 1 is gone", mute) for drone in (2, 3)]
    report("it was missed after", max(missed) - mute)
    missing = [await agents[1].until(rf"drone {drone} is gone", mute) for drone in (2, 3)]
    report("it missed the others after", max(missing) - mute)
    await asyncio.sleep(max(0.0, mute + 8.0 - time.monotonic()))
    for drone in team.drones:
        gone = departures(team, mute, drone)
        report(f"departures that drone {drone} reported", len(gone), "")
        assert agents[drone].times("two agents use drone.id", mute) == []
        assert len(gone) <= 4  # no flapping: each of the two twice at most
    assert agents[2].times(r"drone 3 is gone", mute) == []
    healed = time.monotonic()
    team.emulator.heal()
    named = await team.until_known(team.drones, since=healed)
    report("everybody named again, after healing", named - healed)
    assert_names_held(team, mute)


async def test_two_that_do_not_hear_each_other_go_on_with_the_third(team: Team) -> None:
    agents, parted = team.agents, time.monotonic()
    team.emulator.deafen((1,), (2,))
    team.emulator.deafen((2,), (1,))
    missed = [await agents[a].until(f"drone {b} is gone", parted) for a, b in ((1, 2), (2, 1))]
    report("they missed each other after", max(missed) - parted)
    await asyncio.sleep(max(0.0, parted + APART_S - time.monotonic()))
    assert departures(team, parted, 3) == []
    assert [agents[drone].times(r"drone 3 is gone", parted) for drone in (1, 2)] == [[], []]
    healed = time.monotonic()
    team.emulator.heal()
    met = [await agents[a].until(f"drone {b} announced itself", healed) for a, b in ((1, 2), (2, 1))]
    report("announcements known again, after healing", max(met) - healed)
    assert_names_held(team, parted)


@pytest.mark.parametrize("seconds", CARRIED_S)
@pytest.mark.parametrize("fault", ["repeated and disordered frames", "no UDP"])
async def test_a_radio_that_carries_all_that_is_needed_parts_nobody(
    team: Team, fault: str, seconds: float
) -> None:
    began = time.monotonic()
    if fault == "no UDP":
        team.emulator.block_udp()
    else:
        team.emulator.impair(latency_s=0.02, jitter_s=0.02, repeated=0.3, disordered=True)
    await asyncio.sleep(seconds)
    assert_names_held(team, began)
    assert_nobody_lost(team, began, time.monotonic())


async def test_a_radio_that_was_switched_off_is_met_again(team: Team) -> None:
    agents, down = team.agents, time.monotonic()
    await ip(team, 2, "link set dev radio0 down")
    await asyncio.gather(*(agents[drone].until(r"drone 2 is gone", down) for drone in (1, 3)))
    await asyncio.sleep(max(0.0, down + APART_S - time.monotonic()))
    up = time.monotonic()
    await ip(team, 2, "link set dev radio0 up")
    met = [await agents[drone].until(r"drone 2 announced itself", up) for drone in (1, 3)]
    met += [await agents[2].until(rf"drone {drone} announced itself", up) for drone in (1, 3)]
    report("announcements known again, after it was switched on", max(met) - up)
    assert_names_held(team, down)


async def test_an_agent_that_stood_still_is_met_and_named_again(team: Team) -> None:
    agents, frozen = team.agents, time.monotonic()
    agents[2].process.send_signal(signal.SIGSTOP)
    gone = [await agents[drone].until(r"drone 2 is gone", frozen) for drone in (1, 3)]
    report("it was missed after", max(gone) - frozen)
    await asyncio.sleep(max(0.0, frozen + APART_S - time.monotonic()))
    goes_on = time.monotonic()
    agents[2].process.send_signal(signal.SIGCONT)
    met = [await agents[drone].until(r"drone 2 announced itself", goes_on) for drone in (1, 3)]
    report("its announcement known again", max(met) - goes_on)
    named = await team.until_known(team.drones, since=max(met))
    report("everybody named again, also by it", named - goes_on)
    assert team.wrong(team.drones, since=frozen, until=named) == 0


class Listened(NamedTuple):
    """From when and until when somebody listened to all tracks [s], and how many messages came per second and drone."""

    began: float
    end: float
    hz: float


async def listened(team: Team, seconds: float) -> Listened:
    listener = await team.listen("tracks/*")
    assert listener.stdout is not None
    await asyncio.wait_for(listener.stdout.readline(), PATIENCE)
    began, (_, lost_before) = time.monotonic(), on_the_air(team)
    heard = 1
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            while await listener.stdout.readline():
                heard += 1
    end = time.monotonic()
    _, lost = on_the_air(team)
    report("false deaths while somebody listened", len(departures(team, began)), "")
    report("frames that the radio had no room for", lost - lost_before, "")
    hz = heard / (end - began) / len(team.drones)
    report("tracks heard, per second and drone", hz, "")
    assert team.wrong(team.drones, since=began, until=end) == 0
    return Listened(began, end, hz)


@pytest.mark.long("20 s of listening on each of four radios")
@pytest.mark.parametrize(
    ("radio", "least_hz"),
    [("good", 20.0), ("40 % loss", 4.0), ("500 ± 200 ms", 5.0), ("frames of 1000 bytes at most", 20.0)],
)
async def test_a_listener_on_an_odd_radio_is_served_as_well_as_it_can(
    team: Team, radio: str, least_hz: float, flight: OneFlight
) -> None:
    match radio:
        case "40 % loss":
            team.emulator.impair(loss=0.4)
        case "500 ± 200 ms":
            team.emulator.impair(latency_s=0.5, jitter_s=0.2)
        case "frames of 1000 bytes at most":
            team.emulator.limit_frames(1000)
    heard = await listened(team, 20.0)
    if team.longest_silence(heard.began, heard.end) < STANDSTILL_S:
        assert heard.hz > least_hz
        if radio in ("good", "frames of 1000 bytes at most"):
            assert departures(team, heard.began) == []
    await flight.land()


@pytest.mark.parametrize("seconds", LISTENING_S)
async def test_a_listener_on_a_narrow_radio_is_served_slowly_and_parts_nobody(
    team: Team, seconds: float, flight: OneFlight
) -> None:
    """64 kbit/s carry signs of life and a few tracks; 25 Hz of tracks would take three times as much."""
    agents = team.agents
    narrowed = time.monotonic()
    team.emulator.narrow(64.0)
    began, end, hz = await listened(team, seconds)
    assert hz > NARROW_LEAST_HZ
    # It is logged once in a while: a busy machine may have made a radio full shortly before.
    since = narrowed - PACE_LOG_QUIET_S
    assert any(agent.times("tracks are published less often", since) for agent in agents.values())
    assert_nobody_lost(team, began, end, NARROW_STANDSTILL_S)
    await flight.land()  # its pace recovers slowly, which the next test would see


async def test_a_killed_agent_is_missed_and_met_and_named_again_when_it_comes_back(team: Team) -> None:
    agents = team.agents
    killed = await agents[2].end(signal.SIGKILL)
    gone = [await agents[drone].until("drone 2 is gone", killed) for drone in (1, 3)]
    report("kill -9 noticed after", max(gone) - killed)

    restarted = time.monotonic()
    agents[2] = await team.start(2)
    back = [await agents[drone].until("drone 2 announced itself", restarted) for drone in (1, 3)]
    report("its new announcement known, after its start", max(back) - restarted)
    named = await team.until_known(team.drones, since=max(back))
    report("everybody named again, also by the new one, after its start", named - restarted)
    assert team.wrong(team.drones, since=killed, until=named) == 0


@pytest.mark.parametrize("crashes", CRASHES)
async def test_an_agent_that_crashes_again_and_again_is_no_clone_and_keeps_its_name(
    team: Team, crashes: int
) -> None:
    """Each life ends before the links of the one before are missed."""
    agents = team.agents
    began = time.monotonic()
    for _ in range(crashes):
        await agents[2].end(signal.SIGKILL)
        agents[2] = await team.start(2)
        await agents[1].until("drone 2 announced itself", time.monotonic() - 0.1)
    await team.until_known(team.drones, since=time.monotonic())
    ended = time.monotonic()
    for observer in (1, 3):
        assert agents[observer].times("two agents use drone.id", began) == []
        looks = team.looks_between(
            (observer,), began, ended, lambda look: look.calls_somebody(2) or not look.is_judged()
        )
        report(
            f"drone {observer} had no name for it in", 100.0 * (1.0 - sum(looks) / len(looks)), "% of looks"
        )
        # Each new process takes the cores of those that look; a track that is lost by that is found in half a second.
        # In 3 of 9 runs of this whole file, drone 3 has no name for it in 23 to 29 % of looks, else in none; why is
        # not known.
        assert sum(looks) > 0.65 * len(looks)
    assert team.wrong(team.drones, since=began, until=ended) == 0


async def test_an_agent_whose_wall_clock_is_two_hours_off_is_named_and_names_all(team: Team) -> None:
    """Behind, as of a companion without a clock battery."""
    await team.agents[2].end(signal.SIGKILL)
    started = time.monotonic()
    await team.start(2, clock_off_s=-TWO_HOURS)
    await team.agents[1].until("drone 2 announced itself", started)
    named = await team.until_known(team.drones, since=time.monotonic())
    report("everybody named, after the start", named - started)
    await asyncio.sleep(2.0)
    now = time.monotonic()
    right = team.looks_between(team.drones, named, now, Look.is_right)
    report("everybody in view rightly named", 100.0 * sum(right) / len(right), "% of what was published")
    assert team.wrong(team.drones, since=started, until=now) == 0
    assert any(right)


async def test_who_is_revoked_in_flight_loses_its_name_and_nobody_else_does(team: Team) -> None:
    agents = team.agents
    revoked = time.monotonic()
    team.revoke(names.drone(3))
    dropped = [
        await agents[drone].until("drone 3 is no longer in the team's roster", revoked) for drone in (1, 2)
    ]
    report("dropped after", max(dropped) - revoked)
    met = [await agents[a].until(f"drone {b} announced itself", revoked) for a, b in ((1, 2), (2, 1))]
    report("those who stay met again after", max(met) - revoked)
    nameless = await team.until(
        lambda look: not look.calls_somebody(3), (1, 2), max(dropped), "nobody is called drone 3"
    )
    await asyncio.sleep(3.0)
    end = time.monotonic()
    assert not any(team.looks_between((1, 2), nameless, end, lambda look: look.calls_somebody(3)))
    stayed = team.looks_between((1,), revoked, end, lambda look: look.knows(2) or 2 not in look.in_view)
    # A track that is lost and found again takes half a second.
    assert sum(stayed) > 0.9 * len(stayed)
    assert team.wrong((1, 2), since=nameless, until=end) == 0


# --- each in a flight of its own


@pytest.mark.long("half a minute in the air; in the default run, tests/test_onboard.py reboots autopilots")
async def test_an_autopilot_that_reboots_in_flight_costs_no_identity(gather: Gather) -> None:
    team = await gather(TRIANGLE + REBOOTS)
    await take_off(team)

    rebooted = next(team.epoch + at_s for at_s in REBOOTS_AT_S if team.epoch + at_s > time.monotonic())
    await asyncio.sleep(rebooted + REBOOT_S - time.monotonic())
    named = await team.until_known(team.drones, since=time.monotonic())
    report("everybody named, after the autopilot spoke again", named - rebooted - REBOOT_S)
    await asyncio.sleep(4.0)  # what a wrong pose after the reboot would do, it does by now
    assert team.wrong(team.drones, since=rebooted, until=time.monotonic()) == 0
    await team.until_known(team.drones, since=time.monotonic())


@pytest.mark.parametrize(
    "secured",
    [
        pytest.param(True, id="with-keys"),
        pytest.param(False, id="without", marks=pytest.mark.long("once more without keys")),
    ],
)
async def test_while_two_speak_as_one_nobody_is_given_their_name(gather: Gather, secured: bool) -> None:
    """Drone 4 was given the config of drone 3, keys included, all but its sensors and its address.

    With keys the links are those of the team file: 3 and its clone have none between them, whom both dial tells.
    """
    team = await gather(RHOMBUS, secured=secured)
    honest, witnesses = (1, 2, 3), (1, 2)
    agents = {drone: await team.start(drone) for drone in honest}
    await team.until_known(honest, since=time.monotonic())

    cloned = time.monotonic()
    clone = await team.start(4, name=3)
    told = [await agents[drone].until("two agents use drone.id = 3", cloned) for drone in witnesses]
    if not secured:
        told += [
            await agent.until("another agent uses our drone.id = 3", cloned) for agent in (agents[3], clone)
        ]
    report("a clone reported, after its start", max(told) - cloned)
    nameless = await team.until(
        lambda look: not look.calls_somebody(3), witnesses, max(told), "nobody is called drone 3"
    )
    report("nobody called by the doubted name, after the last report", nameless - max(told))
    await asyncio.sleep(3.0)
    used = team.looks_between(witnesses, nameless, time.monotonic(), lambda look: look.calls_somebody(3))
    assert not any(used)

    ended = await clone.end(signal.SIGKILL)
    named = await team.until_known(honest, since=ended)
    report("the honest one named again, after the clone's end", named - ended)
    assert team.wrong(witnesses, since=ended, until=named) == 0


@pytest.mark.long("two minutes; in the default run links are renewed once")
async def test_links_that_are_renewed_again_and_again_leave_nobody_silent(gather: Gather) -> None:
    """All make their links new at once, as after each revocation. Now and then Zenoh does not end its old session."""
    team = await gather(TRIANGLE)
    await take_off(team)
    await asyncio.sleep(SETTLED_S)
    waits = []
    for name in team.issue_monitors(RENEWALS):
        renewed = time.monotonic()
        team.revoke(name)
        await team.agents[1].until("links are renewed", renewed)
        heard = time.monotonic() + 0.5  # what was said before is on its way
        waits.append(await team.until(lambda look: True, team.drones, heard, "all are heard") - renewed)
        await asyncio.sleep(0.5)
    hung = sum(len(agent.times("sockets of its links are closed")) for agent in team.agents.values())
    report(f"sessions of agents that did not end, in {RENEWALS} renewals", hung, "")
    report("all were heard again after, at most", max(waits))
    assert max(waits) < 10.0


@pytest.mark.long("another flight; in the default run a killed agent is missed over the address it had")
async def test_after_a_change_of_its_address_a_drone_hears_what_becomes_of_the_others(gather: Gather) -> None:
    """A new lease, roaming: packets of the old address stay unanswered, and links are made again."""
    team = await gather(TRIANGLE)
    agents = await take_off(team)

    await asyncio.sleep(SETTLED_S)
    changed = time.monotonic()
    await readdress(team, 3)
    await asyncio.sleep(4.0)
    killed = await agents[2].end(signal.SIGKILL)
    missed = [await agents[drone].until(r"drone 2 is gone", changed) for drone in (1, 3)]
    report("drone 2 was missed by 1 after", missed[0] - killed)
    report("drone 2 was missed by 3 after", missed[1] - killed)
    started = time.monotonic()
    await team.start(2)
    met = [await agents[drone].until(r"drone 2 announced itself", started) for drone in (1, 3)]
    report("drone 2 was known to 1 after", met[0] - started)
    report("drone 2 was known to 3 after", met[1] - started)
    assert team.wrong((1, 3), since=changed, until=max(met)) == 0
    assert (
        missed[1] - killed < 6.0
    )  # two seconds on a machine that has the time; ten and more while Zenoh lingers


@pytest.mark.long("another flight; in the default run a fifth is lost")
async def test_a_team_that_starts_where_two_fifths_are_lost_meets(gather: Gather) -> None:
    """Hardware addresses are lost as well, and links that were just made."""
    team = await gather(TRIANGLE)
    team.emulator.impair(loss=0.4)
    started = time.monotonic()
    agents = {drone: await team.start(drone) for drone in team.drones}
    begun = [await agent.until("", started) for agent in agents.values()]
    met = [
        await agents[drone].until(rf"drone {other} announced itself", started)
        for drone in team.drones
        for other in team.drones
        if other != drone
    ]
    report("everybody's announcement was known, after the processes' start", max(met) - started)
    report("after the last agent's first word", max(met) - max(begun))
    named = await team.until_known(team.drones, since=max(met))
    report("everybody named, after the processes' start", named - started)
    assert team.wrong(team.drones, since=started, until=named) == 0


@pytest.mark.long("waits until drones cross, of a team of four; in the default run nobody crosses")
@pytest.mark.parametrize(
    ("parted", "loss", "seconds"),
    [
        pytest.param(True, 0.4, 12.0, id="both"),
        pytest.param(True, 0.0, 30.0, id="partition"),
        pytest.param(False, 0.4, 30.0, id="loss"),
    ],
)
async def test_who_crosses_while_the_radio_fails_keeps_its_name(
    gather: Gather, parted: bool, loss: float, seconds: float
) -> None:
    """Every observer sees the two of the other side cross, while it is parted from them or hears three fifths."""
    team = await gather(CROSSING)
    agents = await take_off(team)

    await asyncio.sleep(SETTLED_S)
    failed = time.monotonic()
    team.emulator.impair(loss=loss)
    if parted:
        team.emulator.cut({1, 2})
    crossed = 0
    while crossed < 2 or time.monotonic() < failed + seconds:
        await asyncio.sleep(1.0)
        crossed = team.crossings(team.drones, failed, time.monotonic())
        assert time.monotonic() < failed + PATIENCE
    if parted:
        assert all(
            agents[a].times(rf"drone {b} is gone", failed) for a, b in ((1, 3), (1, 4), (3, 1), (4, 2))
        )
    team.emulator.heal()
    team.emulator.impair(loss=0.0)
    named = await team.until_known(team.drones, since=time.monotonic())
    judged = team.looks_between(team.drones, failed, named, Look.is_judged)
    right = team.looks_between(team.drones, failed, named, Look.is_right)
    report("times that two crossed", crossed, "")
    report("looks that are judged", sum(judged), f"of {len(judged)}")
    report("everybody in view rightly named", 100.0 * sum(right) / len(right), "% of what was published")
    report("looks with a wrong name", team.wrong(team.drones, since=failed, until=named), "")
    assert any(judged)
    assert team.wrong(team.drones, since=failed, until=named) == 0
