"""Image, depth and geometry metrics. Each number has one definition, named; `protocols` says which belong together."""
