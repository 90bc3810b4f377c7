"""TOML files: layered by `extends`, read with the line of each key."""
