"""The harness: run folders, hyperparameters, checkpoints, and what the commands are made of."""
