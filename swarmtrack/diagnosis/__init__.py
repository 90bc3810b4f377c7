"""Why does it not work? Facts in, one sentence a fault out, each with what to do."""
