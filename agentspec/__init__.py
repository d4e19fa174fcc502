"""AgentSpec: embodied LLM agents as typed compositions of modules, run, measured and trained inside their scaffold."""

import os

__version__ = "0.2.0"

# MKL, read when it first multiplies: the same row times the same matrix gives the same bits, however many other rows
# there are. Without it what is sampled depends, by rounding, on who else is in the batch.
os.environ.setdefault("MKL_CBWR", "AUTO,STRICT")
