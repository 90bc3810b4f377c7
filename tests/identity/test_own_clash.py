"""Another process that uses this drone's ID: from the clash on until all but one have departed."""

from swarmtrack.identity.own_clash import OwnClash
from swarmtrack.messages import IdClash, PeerArrived, PeerDeparted

OURS = IdClash(7, ("0000000a", "0000000b", "0000000c"), ours=True)


def test_a_clash_lasts_until_one_process_is_left():
    clash = OwnClash(7)
    assert not clash
    clash.on_membership(OURS)
    assert clash
    clash.on_membership(PeerDeparted(7, "0000000b"))
    assert clash
    clash.on_membership(PeerDeparted(7, "0000000c"))
    assert not clash


def test_what_happens_to_teammates_neither_begins_nor_ends_it():
    clash = OwnClash(7)
    clash.on_membership(IdClash(8, ("0000000a", "0000000b"), ours=False))
    assert not clash
    clash.on_membership(OURS)
    for event in (PeerArrived(8, "0000000d"), PeerDeparted(8, "0000000b"), PeerDeparted(8, "0000000c")):
        clash.on_membership(event)
    assert clash


def test_a_process_that_was_not_part_of_it_ends_nothing():
    clash = OwnClash(7)
    clash.on_membership(IdClash(7, ("0000000a", "0000000b"), ours=True))
    clash.on_membership(PeerDeparted(7, "0000000f"))
    assert clash
