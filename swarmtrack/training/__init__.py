"""Training a detector. What is here is known without PyTorch."""

COARSEST = 32  # px: images a net sees are a multiple of this
