"""ALFRED: household tasks of seven types from a natural instruction, in 200 steps (Shridhar et al., 2020)."""
