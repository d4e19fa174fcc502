"""Trainers: episodes run inside the scaffold become exact policy-gradient updates."""
