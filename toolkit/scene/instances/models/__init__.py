"""Masks from models of the `transformers` library in local folders; nothing is downloaded."""
