"""The harness: run folders, hyper-parameters, checkpoints, and what the commands are made of."""
