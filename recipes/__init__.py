"""Recipes: one readable script per experiment. They see everything; nothing imports them."""
