"""A swarm on one machine: simulated hardware on real sockets, one real agent process per drone, a radio emulator."""
