"""What is never needed in the air: simulated worlds and autopilots, whole swarms on one machine, scores."""
