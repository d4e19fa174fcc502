"""Evaluation: policies x scaffolds x tasks on paired seeds, with intervals, tables and plots.

:func:`evaluate` runs the matrix and keeps one JSON line per episode; :mod:`eval.tables` turns the lines into means with
intervals (:mod:`eval.statistics` says which); :mod:`eval.plots` draws them. Only ``agentspec`` is imported here: any
policy that can act inside a scaffold can be measured, trained by this project or not.
"""

from agentspec.policies import Policy
from eval.matrix import evaluate
from eval.results import Results
from eval.statistics import Estimate, mean_interval, paired

__all__ = ["Estimate", "Policy", "Results", "evaluate", "mean_interval", "paired"]
