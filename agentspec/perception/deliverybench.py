"""DeliveryBench's perception: the generic one, under the name that specs of earlier versions use."""

from __future__ import annotations

from agentspec.declaration import Declaration
from agentspec.perception.generic import GenericPerception


class DeliveryBenchPerception(GenericPerception):
    """Image, Instruction, State Info and Action Schema of a DeliveryBench observation (see `GenericPerception`)."""

    declaration = Declaration(
        "the four components of DeliveryBench: image, instruction, state, action schema",
        waived={"images": ("images", False)},
    )
