"""Grouping by a language model with an OpenAI-compatible endpoint."""
