"""The city: its map files, its streets as graphs, routes on them, and generated cities."""
