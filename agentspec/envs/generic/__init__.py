"""Any text or discrete Gymnasium environment as one that keeps the contract: text in, text out, a menu of actions."""

from agentspec.envs.generic.adapter import TextAdapter, adapted, keeps_contract

__all__ = ["TextAdapter", "adapted", "keeps_contract"]
