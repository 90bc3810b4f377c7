"""What drones say to each other, as bytes: `docs/wire.md` in code, a module per message."""
