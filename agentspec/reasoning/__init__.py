"""Reasoning modules: one file per method, named after it."""
