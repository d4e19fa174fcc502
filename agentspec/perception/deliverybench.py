"""DeliveryBench's perception: the generic one, under the name that specs of earlier versions use."""

from __future__ import annotations

from agentspec.perception.generic import GenericPerception


class DeliveryBenchPerception(GenericPerception):
    """Image, Instruction, State Info and Action Schema of a DeliveryBench observation (see `GenericPerception`)."""
