"""Formation flight from what a drone sees: laws, barrier and checks in advance of a flight. Pure, like the core."""
