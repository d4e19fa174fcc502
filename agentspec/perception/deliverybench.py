"""DeliveryBench's perception: the four components of the paper.

The environment writes the instruction, the state and the text; perception decides what reaches the prompt. Images are
passed on only when asked for, since a text policy cannot use them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agentspec.declaration import Declaration
from agentspec.types import AgentInput, Task


class DeliveryBenchPerception:
    """Image, Instruction, State Info and Action Schema of a DeliveryBench observation.

    Args:
        images: pass the map picture on (for vision-language policies).
    """

    declaration = Declaration(
        "the four components of DeliveryBench: image, instruction, state, action schema",
    )

    def __init__(self, images: bool = False) -> None:
        self.images = images

    def perceive(self, task: Task, observation: Mapping[str, Any], info: Mapping[str, Any]) -> AgentInput:
        """u_t of one observation."""
        return AgentInput(
            instruction=info["instruction"],
            text=observation["text"],
            action_schema=info["action_schema"],
            state=info["state"],
            images=(observation["image"],) if self.images and "image" in observation else (),
        )
