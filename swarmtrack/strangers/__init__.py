"""Strangers: drones that are not of the team, located together by all that see them."""
