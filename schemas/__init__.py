"""What is stored and what is asked for: the scene store, the tables of metrics and timings, the configuration."""
