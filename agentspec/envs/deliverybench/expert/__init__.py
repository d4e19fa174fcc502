"""Scripted couriers: a strong rule-based one, which marks the reach of rules and demonstrates, and a random one."""
