"""What the trainer's mixins are to a type checker: TRL's trainer, which they are mixed into."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from trl import GRPOTrainer as Base
else:
    Base = object

__all__ = ["Base"]
