"""Review of a recorded flight: what was wrong, in the order of importance, on one page."""
