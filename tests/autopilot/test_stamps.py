"""Stamps of an autopilot whose messages are of several kinds."""

from dataclasses import dataclass

from swarmtrack.autopilot.boot_clock import StampStep
from swarmtrack.autopilot.senders import SenderWatch
from swarmtrack.autopilot.stamps import AutopilotStamps

WRAP_S = 2**32 * 1e-3
RAW_IMU, HIGHRES_IMU = 27, 105


@dataclass
class Message:
    id: int
    stamp: float
    number: int = 0

    def get_seq(self):
        return self.number

    def get_msgId(self):
        return self.id

    def get_msgbuf(self):
        payload = repr(self.stamp).encode()
        return bytes((0xFE, len(payload), self.number, 1, 1, self.id)) + payload + b"\0\0"


def heard(stamps, t, id, stamp):
    return stamps.step(t, Message(id, stamp), stamp, WRAP_S)[0]


def streaming(begun):
    """After ten seconds of one kind of message, whose last came at 10 s."""
    begins = []
    stamps = AutopilotStamps(
        SenderWatch(), wrapped=lambda: None, begun_again=lambda *news: begins.append(news)
    )
    for k in range(101):
        assert heard(stamps, 0.1 * k, HIGHRES_IMU, begun + 0.1 * k) in (StampStep.NEXT, StampStep.SAME)
    return stamps, begins


def test_after_a_silence_another_kind_of_message_shows_a_reboot():
    """As of ArduPilot, which begins with what it always sends."""
    stamps, begins = streaming(20.0)
    assert heard(stamps, 12.0, RAW_IMU, 0.6) is StampStep.REBOOT
    assert [step for step, *_ in begins] == [StampStep.REBOOT]
    assert heard(stamps, 12.1, RAW_IMU, 0.7) is StampStep.NEXT
    assert heard(stamps, 12.2, HIGHRES_IMU, 0.8) is StampStep.NEXT


def test_another_kind_of_message_with_a_clock_of_its_own_is_no_reboot():
    stamps, begins = streaming(20.0)
    for id, (t, stamp) in enumerate(((10.1, 0.1), (12.0, 0.0), (12.1, 32.1), (15.0, 1e6))):
        heard(stamps, t, id, stamp)
    assert begins == []


def test_a_counter_that_begins_again_in_a_silence_is_no_reboot():
    stamps, begins = streaming(WRAP_S - 10.5)
    assert heard(stamps, 12.0, RAW_IMU, 1.5) is StampStep.NEXT
    assert begins == []
