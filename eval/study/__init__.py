"""Learning studies: what is trained and played (`plan`), and what that takes (`cost`)."""

from eval.study.plan import Arm, Study, read_study

__all__ = ["Arm", "Study", "read_study"]
