"""Kinds of model files that generators are opened from; each module is a `Format` (flows/generation/open.py)."""
