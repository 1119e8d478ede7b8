"""Robots: classes, and an MJCF file each."""
