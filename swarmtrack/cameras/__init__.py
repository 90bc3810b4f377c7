"""Several cameras on one drone: where they look, how they hand tracks over, whether they sit as the config states."""
