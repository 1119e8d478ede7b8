"""Hyperparameter searches: studies, their trials, and reports of them."""
