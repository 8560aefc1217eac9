"""Recorded stacks and volumes on disk."""
