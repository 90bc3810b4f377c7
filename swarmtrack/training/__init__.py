"""Training a detector. What is here is known without PyTorch."""

IMAGE_MULTIPLE_PX = 32  # px: images a net sees are a multiple of this
