"""Evaluation: policies x scaffolds x tasks on paired seeds, with intervals, tables and plots.

`evaluate` plays the matrix and keeps every finished episode (`eval.store`); `eval.tables` turns rows into means with
intervals (`eval.statistics` says which); `eval.plots` draws them. Only `agentspec` is imported here: any policy that
can act inside a scaffold can be measured, trained by this project or not.
"""

from agentspec.policies import Policy
from eval.matrix import Settings, evaluate
from eval.statistics import Estimate, mean_interval, paired
from eval.store import Store

__all__ = ["Estimate", "Policy", "Settings", "Store", "evaluate", "mean_interval", "paired"]
