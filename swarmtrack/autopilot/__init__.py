"""MAVLink on asyncio: own framing and links around pymavlink's generated dialect, never mavutil."""
