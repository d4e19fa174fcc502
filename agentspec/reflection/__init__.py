"""Reflection modules: lessons before a decision, revision after it, insight at the episode's end."""
