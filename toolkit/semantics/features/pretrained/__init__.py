"""Loading of `transformers` models from local folders."""
