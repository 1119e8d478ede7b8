"""One training run: hyperparameters, environments, its folder and its checkpoint."""
