"""Perception: what the environment shows becomes u_t (image, instruction, state, action schema)."""
