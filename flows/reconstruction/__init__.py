"""Reconstructors by name, what the store keeps of them, and brief ones to choose views by."""
