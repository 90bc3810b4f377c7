"""`swarmtrack bench formation` and what it takes from: flights in formation, any states, and what a command costs."""
