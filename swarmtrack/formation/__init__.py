"""Flying in formation by what a drone sees: laws, barrier and what must hold before a flight. Pure, like the core."""
