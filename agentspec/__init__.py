"""AgentSpec: embodied LLM agents as typed compositions of modules, run, measured and trained inside their scaffold."""

__version__ = "0.1.0"
