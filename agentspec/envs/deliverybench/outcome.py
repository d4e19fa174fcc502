"""What the last step left for the next observation."""

from __future__ import annotations

from typing import Any

from agentspec.envs.deliverybench.world.engine import Outcome

MAX_ACTION = 512


class Last:
    """The last step: what was called, what came of it, how long it took, what thinking was charged."""

    __slots__ = ("call", "code", "error", "events", "invalid", "message", "seconds", "thought")

    def __init__(
        self,
        call: str = "",
        code: str = "",
        error: str = "",
        message: str = "",
        invalid: bool = False,
        seconds: float = 0.0,
        events: list[str] | None = None,
        thought: tuple[int, int] = (0, 0),
    ) -> None:
        self.call = call
        self.code = code
        self.error = error
        self.message = message
        self.invalid = invalid
        self.seconds = seconds
        self.events = events or []
        self.thought = thought

    @classmethod
    def of(cls, outcome: Outcome, call: str, problem: str, events: list[str], thought: tuple[int, int]) -> Last:
        """From a step's outcome; `problem` replaces the message of an answer that is no choice of the menu."""
        message = problem or outcome.message
        for settled in outcome.settlements:
            message += f": {settled.stars} stars, ${settled.paid:.2f}"
        failed = outcome.ok is False
        return cls(
            call=call[:MAX_ACTION],
            code=outcome.code,
            error=message if failed else "",
            message=f"failed: {message}" if failed else message,
            invalid=failed,
            seconds=outcome.seconds,
            events=events,
            thought=thought,
        )

    @classmethod
    def after_end(cls, call: str) -> Last:
        """Of a step after the end, which does nothing."""
        message = "the episode is over: call reset()"
        return cls(call[:MAX_ACTION], "ENDED", message, f"failed: {message}", True)

    def dump(self) -> dict[str, Any]:
        """The constructor's arguments as JSON values."""
        return {name: getattr(self, name) for name in self.__slots__}
