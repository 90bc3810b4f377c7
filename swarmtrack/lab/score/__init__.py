"""How good a flight, a clip or an experiment was: pure functions of truths and estimates."""
