"""Learning studies: what is trained and played (`plan`), what that takes (`cost`), and the matrix (`playing`)."""

from eval.study.plan import Arm, Study, read_study

__all__ = ["Arm", "Study", "read_study"]
