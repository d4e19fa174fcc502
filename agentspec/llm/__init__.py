"""Language models behind one protocol: local transformers, OpenAI-compatible endpoints, scripted; metered and budgeted."""
