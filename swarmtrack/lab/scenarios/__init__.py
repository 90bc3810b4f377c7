"""Who flies where, and what goes wrong: scenarios, and the files that they are read from."""
