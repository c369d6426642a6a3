"""What every other package of `flows` is written against: a job, a stage, the scene a job is of, reading its store."""
