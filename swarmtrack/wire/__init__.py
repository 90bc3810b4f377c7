"""The messages between drones as bytes: `docs/wire.md` in code, one module per message."""
