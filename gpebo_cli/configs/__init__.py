"""Configuration files: where they are, how they are read, what they may say. Knows no Hydra."""
