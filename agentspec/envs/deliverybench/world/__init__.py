"""The world: state, rules and time of a shift, and what the courier's actions do; engine.World takes them as texts."""
