"""Trained agents: played, filmed, shared."""
