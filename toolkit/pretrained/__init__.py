"""Models of the `transformers` library from local folders, and its one door."""
