"""The perception of every environment that keeps the contract: the four components of the paper, as they come.

The environment writes the instruction, the state and the text (`agentspec.envs.contract`); perception decides what
reaches the prompt. Pictures are passed on only when asked for, since a text model cannot use them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agentspec.declaration import Declaration
from agentspec.registry import SpecError
from agentspec.types import AgentInput, Task

NEEDED = ("instruction", "action_schema", "state")


class GenericPerception:
    """Image, Instruction, State Info and Action Schema of an observation.

    Args:
        images: pass the observation's `image` on, for models that see.
    """

    declaration = Declaration(
        "image, instruction, state and action schema of any environment that keeps the contract",
        waived={"images": ("images", False)},
        aliases=("deliverybench",),  # its name in specs of earlier versions
    )

    def __init__(self, images: bool = False) -> None:
        self.images = images

    def perceive(self, task: Task, observation: Mapping[str, Any], info: Mapping[str, Any]) -> AgentInput:
        """u_t of one observation.

        Raises:
            SpecError: the environment does not keep the contract, or has no picture where one is asked for.
        """
        missing = [f"info[{name!r}]" for name in NEEDED if name not in info]
        missing += [] if "text" in observation else ["observation['text']"]
        if missing:
            raise SpecError(
                f"{task.env} does not report {', '.join(missing)}; hold it against the contract with "
                "agentspec.envs.check_environment"
            )
        if self.images and "image" not in observation:
            raise SpecError(
                f"perception: {{images: true}}, but {task.env} shows no picture; turn it on in the environment's "
                "options (`images: true`, or `render_mode: rgb_array`), or leave images out"
            )
        return AgentInput(
            instruction=info["instruction"],
            text=observation["text"],
            action_schema=info["action_schema"],
            state=info["state"],
            images=(observation["image"],) if self.images else (),
        )
